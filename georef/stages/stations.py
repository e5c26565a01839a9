"""Stage `stations`: what was localized image by image, posed together: exposures of a rig, and short sequences."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from georef.estimation.epoch_problem import tie_pairs
from georef.estimation.guided import GuidedOptions, PosedFeatures, guided_matches
from georef.estimation.stations import StationImage, localize_station, localize_window
from georef.estimation.tracks import PairMatches
from georef.geometry.rigid import Rigid3
from georef.io.items import item_ids, item_path, write_outcome
from georef.stages.base import StageContext, StageSummary, feature_id, open_features
from georef.stages.failures import internal_failure
from georef.stages.localize import ITEMS, LocalizeTask, make_task, read_outcomes
from georef.types.campaign import Campaign, Image, Mounting
from georef.types.results import Localized, Outcome

EXPOSURES = "exposures"
_SEEN_TOGETHER = "posed together"
Pair = tuple[str, str]


def final_outcomes(context: StageContext) -> list[Outcome]:
    """The outcome of every image before the adjustment: of its station where stations are posed, else its own."""
    folder = context.before.get("stations", context.before["localize"])
    return read_outcomes(folder, context.survey.epoch)


def groups_of(epoch: Campaign) -> list[list[Image]]:
    """The images of each exposure, in the order of the epoch; an image without a mounting is one by itself."""
    groups: dict[str, list[Image]] = {}
    for image in epoch.images:
        together = image.station is not None and image.image_id in epoch.mountings
        groups.setdefault(f"station {image.station}" if together else f"image {image.image_id}", []).append(image)
    return list(groups.values())


@dataclass
class StationTask:
    """Poses stations or windows; what goes wrong with one leaves its images as they were."""

    localize: LocalizeTask
    mountings: dict[str, Mounting]
    outcomes: dict[str, Outcome]
    ties: dict[Pair, NDArray[np.int32]] = field(default_factory=dict)

    def __call__(self, group: list[Image]) -> list[Outcome]:
        """The images of one exposure, together."""
        if len(group) < 2:
            return [self.outcomes[image.image_id] for image in group]
        return self._guarded(group, lambda: self._exposure(group))

    def _exposure(self, group: list[Image]) -> list[Outcome]:
        config = self.localize.config
        images = [self.station_image(image) for image in group if self._readable(image)]
        found = localize_station(images, self.localize.map, config.stations, config.localize)
        by_id = {outcome.image_id: outcome for outcome in found}
        return [by_id.get(image.image_id, self.outcomes[image.image_id]) for image in group]

    def _readable(self, image: Image) -> bool:
        return feature_id(image) not in self.localize.failed

    def _guarded(self, group: list[Image], compute: Callable[[], list[Outcome]]) -> list[Outcome]:
        try:
            return compute()
        except Exception as error:
            _, detail = internal_failure(error, f"the station of {group[0].image_id}")
            before = [self.outcomes[image.image_id] for image in group]
            return [replace(o, notes=(*o.notes, f"not posed together: {detail}")) for o in before]

    @cached_property
    def _bearings(self) -> dict[str, PosedFeatures]:
        return {}

    def station_image(self, image: Image) -> StationImage:
        """An image with its features and its mounting; one that is a station by itself is its own rig."""
        known = self._bearings.get(image.image_id)
        if known is None:
            features = open_features(self.localize.store_folder).read(feature_id(image))
            known = PosedFeatures.of(features, image.camera, Rigid3.identity())
            self._bearings[image.image_id] = known
        mounting = self.mountings.get(image.image_id, Mounting("its own", Rigid3.identity()))
        return StationImage(image, known, mounting, self.outcomes[image.image_id])

    def posed(self, image: Image) -> PosedFeatures:
        outcome = self.outcomes[image.image_id]
        assert isinstance(outcome, Localized)
        return self.station_image(image).features.posed(outcome.world_from_cam)

    def __getstate__(self) -> dict[str, object]:
        return {key: value for key, value in self.__dict__.items() if key != "_bearings"}


@dataclass
class TieTask:
    """Matches two images of neighbouring exposures along their epipolar lines."""

    stations: StationTask

    def __call__(self, pair: tuple[Image, Image]) -> tuple[Pair, NDArray[np.int32]]:
        config = self.stations.localize.config.localize
        options = GuidedOptions(config.guided_gate, config.guided_min_similarity, config.guided_ratio)
        a, b = (self.stations.posed(image) for image in pair)
        return (pair[0].image_id, pair[1].image_id), guided_matches(a, b, options).indices


@dataclass
class WindowTask:
    """The middle exposure of a sequence, posed with the others."""

    stations: StationTask

    def __call__(self, window: tuple[list[list[Image]], int]) -> list[Outcome]:
        groups, middle = window
        return self.stations._guarded(groups[middle], lambda: self._window(groups, middle))

    def _window(self, groups: list[list[Image]], middle: int) -> list[Outcome]:
        task, config = self.stations, self.stations.localize.config
        usable = [[s for s in map(task.station_image, group) if s.usable] for group in groups]
        kept = [k for k, group in enumerate(usable) if group]
        before = [task.outcomes[image.image_id] for image in groups[middle]]
        if len(kept) < 2 or middle not in kept:
            return before
        chosen = [usable[k] for k in kept]
        names = [s.image.image_id for group in chosen for s in group]
        ties = _ties_among(names, task.ties)
        found = localize_window(chosen, kept.index(middle), ties, task.localize.map, config.stations, config.localize)
        by_id = {outcome.image_id: outcome for outcome in found}
        return [by_id.get(outcome.image_id, outcome) for outcome in before]


def _ties_among(names: Sequence[str], ties: dict[Pair, NDArray[np.int32]]) -> list[PairMatches]:
    place = {name: i for i, name in enumerate(names)}
    return [PairMatches(place[a], place[b], m) for (a, b), m in ties.items() if a in place and b in place]


def run(context: StageContext) -> StageSummary:
    """Poses every exposure, then every sequence where asked for, storing each outcome as it comes."""
    epoch, config = context.survey.epoch, context.config.stations
    alone = {o.image_id: o for o in read_outcomes(context.before["localize"], epoch)}
    task = StationTask(make_task(context), dict(epoch.mountings), alone)
    groups, last = groups_of(epoch), context.folder / ITEMS
    first = context.folder / EXPOSURES if config.together == "sequence" else last
    _store(context, task, groups, first, "stations")
    if config.together == "sequence":
        task.outcomes = {o.image_id: o for o in read_outcomes(context.folder, epoch, EXPOSURES)}
        windows = windows_of(groups, task.outcomes, config.length, config.max_gap_m)
        pending = [w for w in windows if not _all_there(last, w[0][w[1]])]
        pairs = neighbouring_pairs(task, pending, config.tie_neighbours)
        task.ties = dict(context.executor.map_items(TieTask(task), pairs, "tie points"))
        for outcomes in context.executor.map_items(WindowTask(task), pending, "sequences"):
            _write(last, outcomes)
    return _summary(alone, read_outcomes(context.folder, epoch), groups)


def _store(context: StageContext, task: StationTask, groups: list[list[Image]], folder: Path, label: str) -> None:
    pending = [group for group in groups if not _all_there(folder, group)]
    for outcomes in context.executor.map_items(task, pending, label):
        _write(folder, outcomes)


def _all_there(folder: Path, group: Sequence[Image]) -> bool:
    done = item_ids(folder)
    return all(image.image_id in done for image in group)


def _write(folder: Path, outcomes: Sequence[Outcome]) -> None:
    for outcome in outcomes:
        write_outcome(item_path(folder, outcome.image_id), outcome)


def windows_of(
    groups: list[list[Image]], outcomes: dict[str, Outcome], length: int, max_gap_m: float
) -> list[tuple[list[list[Image]], int]]:
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
    task: StationTask, windows: Sequence[tuple[list[list[Image]], int]], neighbours: int
) -> list[tuple[Image, Image]]:
    """Pairs of images of one window, each image with those that see most of its points."""
    chosen: dict[Pair, tuple[Image, Image]] = {}
    for groups, _ in windows if neighbours else ():
        images = [image for group in groups for image in group if task.station_image(image).usable]
        localized = [o for o in (task.outcomes[i.image_id] for i in images) if isinstance(o, Localized)]
        for i, j in tie_pairs([task.posed(image) for image in images], localized, neighbours):
            chosen[images[i].image_id, images[j].image_id] = (images[i], images[j])
    return list(chosen.values())


def _summary(alone: dict[str, Outcome], outcomes: list[Outcome], groups: list[list[Image]]) -> StageSummary:
    stations = sum(len(group) > 1 for group in groups)
    changed = [o for o in outcomes if isinstance(o, Localized) and o.notes != alone[o.image_id].notes]
    rescued = [o for o in changed if not isinstance(alone[o.image_id], Localized)]
    line = f"{stations} stations of several images; {len(changed)} poses from them or from sequences"
    if rescued:
        line += f", {len(rescued)} of images that were rejected alone"
    data = {"stations": stations, "posed": len(changed), "rescued": [o.image_id for o in rescued]}
    return StageSummary(line, data, len(outcomes), len(outcomes))
