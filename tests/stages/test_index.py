"""Stage `index`: references in the vector database, once for all epochs, and localization by what it finds."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from georef.errors import StageError
from georef.stages.index import STATE, DescribeTask, open_vectors
from georef.stages.survey import load_survey
from tests.stages.bench import Bench
from tests.worlds.tiny import EPOCH


def task_of(bench: Bench) -> tuple[DescribeTask, Path]:
    project, folder = bench.open(), bench.states()["index"].folder
    return DescribeTask(project.config, next(project.feature_folder.iterdir()), folder / STATE), folder


def test_all_references_are_in_the_database_where_they_are(finished: Bench) -> None:
    task, folder = task_of(finished)
    vectors = open_vectors(folder, task.descriptor)
    reference = load_survey(finished.open(), EPOCH).reference.images
    assert vectors.keys() == {f"reference/{image.image_id}" for image in reference}
    for image in reference:
        row, pose = task(image), image.world_from_cam
        assert row is not None
        assert pose is not None
        found = vectors.nearest(row, 1, centre=pose.translation, half_side_m=0.01)
        assert found.keys == (f"reference/{image.image_id}",)
        assert found.distances[0] == pytest.approx(0.0, abs=1e-4)
        heading = np.arctan2(pose.rotation[0, 2], pose.rotation[1, 2])
        turned = vectors.nearest(
            row, 1, centre=pose.translation, half_side_m=0.01, heading_rad=heading + np.pi, heading_window_deg=90.0
        )
        assert turned.keys == ()


def test_the_index_is_the_reference_s_own(finished: Bench) -> None:
    """Another epoch finds it done: neither index nor network lie in the folder of an epoch."""
    assert task_of(finished)[1].parent.parent == finished.output / "work" / "reference"


def test_a_shortlist_of_everything_gives_what_votes_give(copied: Callable[..., Bench], finished: Bench) -> None:
    bench = copied()
    results = bench.run("candidates.ranking=votes")
    assert "index" not in results
    assert results["localize"].summary.computed == 3
    assert bench.published("localization.csv") == finished.published("localization.csv")


def test_by_global_descriptors_alone(copied: Callable[..., Bench], finished: Bench) -> None:
    bench = copied()
    results = bench.run("candidates.ranking=global", "candidates.count=4")
    assert results["localize"].summary.line.startswith("3 of 3 images localized")
    assert bench.published("localization.csv") != finished.published("localization.csv")


def test_a_damaged_state_names_its_file(copied: Callable[..., Bench]) -> None:
    bench = copied()
    _, folder = task_of(bench)
    state = folder / STATE
    state.write_bytes(state.read_bytes()[:100])
    shutil.rmtree(bench.states()["localize"].folder)
    with pytest.raises(StageError, match=r"(?s)damaged.*descriptor\.safetensors"):
        bench.run()


def test_one_damaged_file_of_features_leaves_the_others_in(copied: Callable[..., Bench]) -> None:
    bench = copied()
    task, folder = task_of(bench)
    damaged = next(task.store_folder.glob("reference*.safetensors"))
    damaged.write_bytes(damaged.read_bytes()[:200])
    project = bench.open()
    survey = load_survey(project, EPOCH)
    rows = [task(image) for image in survey.reference.images]
    assert sum(row is None for row in rows) == 1
    assert folder.is_dir()
