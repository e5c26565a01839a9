"""The stage `stations`: sequences of the small world, what is kept, and which images belong together."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from georef.executor import Executor
from georef.geometry.camera import Camera
from georef.geometry.rigid import Rigid3
from georef.io.items import item_path
from georef.pipeline import StageResult, run_pipeline
from georef.stages.localize import ITEMS, read_outcomes
from georef.stages.stations import groups_of, windows_of
from georef.types.campaign import Campaign, Image, Mounting
from georef.types.results import Localized, Outcome, Rejected, RejectReason
from tests.stages.bench import Bench
from tests.worlds.tiny import EPOCH

SEQUENCE = "stations.together=sequence"


def to_stations(bench: Bench, executor: Executor | None = None, *settings: str) -> StageResult:
    project = bench.open(SEQUENCE, *settings)
    return {r.stage: r for r in run_pipeline(project, EPOCH, executor or Executor(), last="stations")}["stations"]


def outcomes(result: StageResult) -> list[Outcome]:
    return list(read_outcomes(result.context.folder, result.context.survey.epoch))


def test_no_stage_where_nothing_belongs_together(finished: Bench) -> None:
    assert "stations" not in finished.states()
    assert finished.states(SEQUENCE)["stations"].state == "new"


def test_a_sequence_is_posed_kept_and_taken_up_where_it_ended(copied: Callable[..., Bench]) -> None:
    bench = copied()
    first = to_stations(bench)
    assert (first.summary.computed, first.summary.total) == (3, 3)
    posed = outcomes(first)
    for outcome in posed:
        assert isinstance(outcome, Localized)
        assert "posed in a sequence of 3" in outcome.notes[-1] or "posed in a sequence of 2" in outcome.notes[-1]
        assert outcome.cpu_s["sequence"] > 0
    assert to_stations(bench).reused
    lost = item_path(first.context.folder / ITEMS, posed[1].image_id)
    lost.unlink()
    again = to_stations(bench)
    assert (again.reused, again.summary.computed) == (False, 1)
    mended = outcomes(again)[1]
    assert isinstance(mended, Localized)
    assert isinstance(posed[1], Localized)
    assert np.array_equal(mended.world_from_cam.matrix(), posed[1].world_from_cam.matrix())


def test_two_workers_give_the_same(copied: Callable[..., Bench], tmp_path: Path) -> None:
    bench = copied()
    one = outcomes(to_stations(bench, None, "stations.tie_neighbours=1"))
    folder = to_stations(bench, None, "stations.tie_neighbours=1").context.folder
    for path in folder.rglob("*.npz"):
        path.unlink()
    two = outcomes(to_stations(bench, Executor(workers=2, threads=1), "stations.tie_neighbours=1"))
    for a, b in zip(one, two, strict=True):
        assert isinstance(a, Localized)
        assert isinstance(b, Localized)
        assert np.allclose(a.world_from_cam.matrix(), b.world_from_cam.matrix(), atol=1e-9)


CAMERA = Camera("c", 10, 10, 10.0, 10.0, 5.0, 5.0)


def image(name: str, station: str | None = None) -> Image:
    return Image(name, Path(name), CAMERA, EPOCH, station=station)


def at(name: str, x: float | None) -> Outcome:
    if x is None:
        return Rejected(name, RejectReason.FEW_MATCHES, "")
    pose = Rigid3(np.eye(3), np.array([x, 0.0, 0.0]))
    none = np.zeros(0, np.int64)
    return Localized(name, pose, np.eye(6), np.eye(6), 0, 1.0, (), np.zeros((0, 3)), none)


def test_images_of_a_station_belong_together_where_their_rig_is_known() -> None:
    images = (image("a", "1"), image("b", "2"), image("c", "1"), image("d"), image("e", "3"), image("f", "3"))
    mounted = {name: Mounting(name, Rigid3.identity()) for name in "abc"}
    groups = groups_of(replace(Campaign(EPOCH, images), mountings=mounted))
    assert [[i.image_id for i in group] for group in groups] == [["a", "c"], ["b"], ["d"], ["e"], ["f"]]


def test_a_sequence_ends_at_a_gap_and_at_an_image_without_a_pose() -> None:
    places = {"a": 0.0, "b": 5.0, "c": 9.0, "d": 40.0, "e": 44.0, "f": None, "g": 48.0}
    groups = [[image(name)] for name in places]
    windows = windows_of(groups, {name: at(name, x) for name, x in places.items()}, 3, 15.0)
    names = [("".join(g[0].image_id for g in found), found[middle][0].image_id) for found, middle in windows]
    assert names == [("ab", "a"), ("abc", "b"), ("bc", "c"), ("de", "d"), ("de", "e"), ("f", "f"), ("g", "g")]
    longer = windows_of(groups, {name: at(name, x) for name, x in places.items()}, 4, 15.0)
    assert "".join(g[0].image_id for g in longer[0][0]) == "abc"  # one before, two after
