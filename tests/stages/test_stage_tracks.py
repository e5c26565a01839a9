"""The stage of reference tracks: only what is new or changed is matched, and localization rests on it."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from georef.executor import Executor
from georef.pipeline import StageResult, run_pipeline
from georef.stages import tracks
from georef.stages.localize import read_outcomes
from georef.types.results import Localized
from tests.stages.bench import Bench
from tests.worlds.tiny import EPOCH

METHOD = "localize.method=tracks"


@pytest.fixture
def matched(monkeypatch: pytest.MonkeyPatch) -> list[tuple[float, float]]:
    """Pairs of references that were matched since, as the first coordinates of where they stand."""
    calls: list[tuple[float, float]] = []
    original = tracks.guided_matches

    def counted(a, b, options):
        calls.append((a.world_from_cam.translation[0], b.world_from_cam.translation[0]))
        return original(a, b, options)

    monkeypatch.setattr(tracks, "guided_matches", counted)
    return calls


def localized(bench: Bench, *settings: str) -> dict[str, StageResult]:
    """The pipeline up to localization."""
    results = run_pipeline(bench.open(METHOD, *settings), EPOCH, Executor(), last="localize")
    return {result.stage: result for result in results}


def test_only_what_is_new_or_changed_is_matched(
    copied: Callable[..., Bench], matched: list[tuple[float, float]]
) -> None:
    bench = copied(data=True)
    few = localized(bench, "tracks.neighbours=2")["tracks"].summary.data["pairs"]
    assert len(matched) == few > 4
    first = set(matched)
    matched.clear()
    results = localized(bench, "tracks.neighbours=4")
    every = results["tracks"].summary.data["pairs"]
    assert every > few
    assert len(matched) == every - few
    assert not first & set(matched)
    matched.clear()
    assert localized(bench, "tracks.neighbours=4")["tracks"].reused
    picture = sorted((bench.data / "reference").iterdir())[0]
    os.utime(picture, ns=(1, 1))
    localized(bench, "tracks.neighbours=4")
    assert 0 < len(matched) < every
    assert set.intersection(*(set(pair) for pair in matched))  # all with the one image
    outcomes = read_outcomes(results["localize"].context.folder, results["localize"].context.survey.epoch)
    assert all(isinstance(outcome, Localized) for outcome in outcomes)


def test_a_lost_structure_is_made_again_and_the_same(copied: Callable[..., Bench]) -> None:
    bench = copied()
    folder = localized(bench)["tracks"].context.folder
    before = points_of(folder)
    sorted((folder / "structure").glob("*.npz"))[0].unlink()
    (folder / "stage.json").unlink()
    again = localized(bench)["tracks"]
    assert again.summary.computed == 0
    after = points_of(folder)
    assert before.keys() == after.keys()
    assert all(np.array_equal(before[name], after[name]) for name in before)
    assert sum(map(len, before.values())) > 500


def points_of(folder: Path) -> dict[str, np.ndarray]:
    return {path.name: np.load(path)["points"] for path in (folder / "structure").glob("*.npz")}
