"""Stage `stations`: what was localized image by image, posed together: exposures of a rig, and short sequences."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from georef.config import Config
from georef.estimation.candidates import overlap
from georef.geometry.projection import Views
from georef.io.items import item_ids, item_path, write_outcome
from georef.stages.base import StageContext, StageSummary
from georef.stages.localize import ITEMS, make_task, read_outcomes
from georef.stages.station_tasks import Pair, StationTask, TieTask, Window, WindowTask
from georef.stages.survey import Survey
from georef.types.campaign import Campaign, Image
from georef.types.results import Localized, Outcome

EXPOSURES = "exposures"


def wanted(config: Config, survey: Survey) -> bool:
    """Whether anything of an epoch belongs together: else its images stay as they were localized."""
    together = config.stations.together
    return together == "sequence" or (together == "station" and bool(survey.epoch.mountings))


def final_results(context: StageContext) -> Path:
    """The folder of the stage that posed images last before the adjustment: stations where wanted, else localize."""
    return context.before.get("stations", context.before["localize"])


def final_outcomes(context: StageContext) -> Iterator[Outcome]:
    """The outcome of every image before the adjustment, in the order of the epoch, one by one."""
    return read_outcomes(final_results(context), context.survey.epoch)


def groups_of(epoch: Campaign) -> list[list[Image]]:
    """The images of each exposure, in the order of the epoch; an image without a mounting is one by itself."""
    groups: dict[str, list[Image]] = {}
    for image in epoch.images:
        together = image.station is not None and image.image_id in epoch.mountings
        groups.setdefault(f"station {image.station}" if together else f"image {image.image_id}", []).append(image)
    return list(groups.values())


def run(context: StageContext) -> StageSummary:
    """Poses every exposure, then every sequence where asked for, storing each outcome as it comes."""
    epoch, config = context.survey.epoch, context.config.stations
    alone = {o.image_id: o for o in read_outcomes(context.before["localize"], epoch)}
    task = StationTask(make_task(context), dict(epoch.mountings), alone)
    groups, last = groups_of(epoch), context.folder / ITEMS
    first = context.folder / EXPOSURES if config.together == "sequence" else last
    computed = _store(context, task, groups, first)
    if config.together == "sequence":
        together = {o.image_id: o for o in read_outcomes(context.folder, epoch, EXPOSURES)}
        task = StationTask(make_task(context), dict(epoch.mountings), together)  # a fresh one travels to processes
        windows = windows_of(groups, task.outcomes, config.length, config.max_gap_m)
        done = item_ids(last)
        pending = [w for w in windows if not _all_there(done, w[0][w[1]])]
        computed = sum(len(w[0][w[1]]) for w in pending)
        pairs = neighbouring_pairs(pending, task.outcomes, config.tie_neighbours)
        task.ties = dict(context.executor.map_items(TieTask(task), pairs, "tie points"))
        for outcomes in context.executor.map_items(WindowTask(task), pending, "sequences"):
            _write(last, outcomes)
    return _summary(alone, list(read_outcomes(context.folder, epoch)), groups, computed)


def _store(context: StageContext, task: StationTask, groups: list[list[Image]], folder: Path) -> int:
    """Poses the exposures that are not stored yet; the number of their images."""
    done = item_ids(folder)
    pending = [group for group in groups if not _all_there(done, group)]
    for outcomes in context.executor.map_items(task, pending, "stations"):
        _write(folder, outcomes)
    return sum(map(len, pending))


def _all_there(done: set[str], group: Sequence[Image]) -> bool:
    return all(image.image_id in done for image in group)


def _write(folder: Path, outcomes: Sequence[Outcome]) -> None:
    for outcome in outcomes:
        write_outcome(item_path(folder, outcome.image_id), outcome)


def windows_of(groups: list[list[Image]], outcomes: dict[str, Outcome], length: int, max_gap_m: float) -> list[Window]:
    """For each exposure the sequence about it, of those that follow each other closely, and its place in that."""
    positions = [_position(group, outcomes) for group in groups]

    def reaches(i: int, step: int, count: int) -> Iterator[int]:
        for k in range(i + step, i + step * (count + 1), step):
            here, before = (positions[n] if 0 <= n < len(groups) else None for n in (k, k - step))
            if here is None or before is None or np.linalg.norm(here - before) > max_gap_m:
                return
            yield k

    out = []
    for i in range(len(groups)):
        earlier = sorted(reaches(i, -1, (length - 1) // 2))
        later = list(reaches(i, 1, length - 1 - (length - 1) // 2))
        out.append(([groups[k] for k in (*earlier, i, *later)], len(earlier)))
    return out


def _position(group: Sequence[Image], outcomes: dict[str, Outcome]) -> NDArray[np.float64] | None:
    found = (outcomes[image.image_id] for image in group)
    return next((o.world_from_cam.translation for o in found if isinstance(o, Localized)), None)


def neighbouring_pairs(
    windows: Sequence[Window], outcomes: dict[str, Outcome], neighbours: int
) -> list[tuple[Image, Image]]:
    """Pairs of images of one window, each image with those that see most of the points that it was localized from."""
    chosen: dict[Pair, tuple[Image, Image]] = {}
    for groups, _ in windows if neighbours else ():
        images = [image for group in groups for image in group if not image.camera.estimate]
        found = [(i, o) for i in images if isinstance(o := outcomes[i.image_id], Localized)]
        shared = _shared_points(found)
        for i, (image, _outcome) in enumerate(found):
            for j in np.argsort(-shared[i], kind="stable")[:neighbours]:
                a, b = (image, found[j][0]) if i < j else (found[j][0], image)
                if shared[i, j] > 0:
                    chosen[a.image_id, b.image_id] = (a, b)
    return list(chosen.values())


def _shared_points(found: Sequence[tuple[Image, Localized]]) -> NDArray[np.int64]:
    """How many of the points of each of M images each other one can see, or the other way round (M, M)."""
    views = Views.of([o.world_from_cam for _, o in found], [image.camera for image, _ in found])
    sizes = np.array([[image.camera.width, image.camera.height] for image, _ in found], dtype=float)
    seen = np.zeros((len(found), len(found)), np.int64)
    for i, (_, outcome) in enumerate(found):
        directions = outcome.points_in_world - outcome.world_from_cam.translation
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        seen[i] = overlap(outcome.points_in_world, directions, views, sizes)
        seen[i, i] = 0
    return np.maximum(seen, seen.T)


def _summary(
    alone: dict[str, Outcome], outcomes: list[Outcome], groups: list[list[Image]], computed: int
) -> StageSummary:
    stations = sum(len(group) > 1 for group in groups)
    changed = [o for o in outcomes if isinstance(o, Localized) and o.notes != alone[o.image_id].notes]
    rescued = [o for o in changed if not isinstance(alone[o.image_id], Localized)]
    line = f"{stations} stations of several images; {len(changed)} poses from them or from sequences"
    if rescued:
        line += f", {len(rescued)} of images that were rejected alone"
    data = {"stations": stations, "posed": len(changed), "rescued": [o.image_id for o in rescued]}
    return StageSummary(line, data, computed, len(outcomes))
