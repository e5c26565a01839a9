"""The demo's street as a project: its pipeline works without the truth, and comes close to it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from georef.errors import ConfigError
from georef.executor import Executor
from georef.pipeline import run_pipeline
from georef.project import Project, open_project
from georef.simulate.project_files import TRUTH, write_images, write_project
from georef.simulate.world import StreetWorld, WorldOptions
from georef.stages.demo import against_truth, demo_options, render_missing, survey_files
from georef.stages.evaluate import evaluate

SMALL = WorldOptions(0, 40.0, max_stations=5, scale=0.5)


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Project:
    """Run while the truth was somewhere else."""
    folder = tmp_path_factory.mktemp("street")
    data, aside = folder / "data", folder / "aside"
    write_project(StreetWorld(SMALL), data)
    (data / TRUTH).rename(aside)
    project = open_project(
        data, data=data, output=folder / "results", preset="sift", settings=("report.recording=false",)
    )
    for epoch in project.file.epochs:
        list(run_pipeline(project, epoch, Executor()))
    assert not (data / TRUTH).exists()
    aside.rename(data / TRUTH)
    return project


def test_the_pipeline_needs_no_truth_and_comes_close_to_it(finished: Project) -> None:
    """Two-sided: an error far below the noise of pictures and survey would mean that the truth leaked."""
    for epoch in finished.file.epochs:
        truth = finished.data(TRUTH) / f"{epoch}_eo_relative.csv"
        errors = evaluate(finished.published(epoch) / "poses.csv", truth).errors
        assert len(errors.failed) <= 1
        assert 0.0003 < errors.position_m.median_estimated < 0.03
        assert 0.0003 < errors.rotation_deg.median_estimated < 0.1  # half the resolution of the demo
        assert len(against_truth(finished, epoch)) == 2
    report = json.loads((finished.published("second") / "report.json").read_text(encoding="utf-8"))
    assert report["check_points"]["count"] >= 3
    assert 0.002 < report["check_points"]["rmse_3d_m"] < 0.04


def test_an_interrupted_rendering_goes_on_and_another_call_renders_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("GEOREF_CACHE", str(tmp_path))
    options = WorldOptions(3, 40.0, max_stations=1, scale=0.15)
    folder = survey_files(options)
    count = render_missing(options, folder, Executor()).computed
    pictures = {path: path.read_bytes() for path in folder.rglob("*.jpg")}
    assert count == len(pictures) == 5
    lost = sorted(pictures)[2]
    lost.unlink()
    assert render_missing(options, survey_files(options), Executor()).computed == 1
    assert {path: path.read_bytes() for path in folder.rglob("*.jpg")} == pictures
    assert write_images(StreetWorld(options), folder) == []


def test_a_change_outside_its_range_is_refused() -> None:
    for change in (-0.1, 1.5, np.nan):
        with pytest.raises(ConfigError, match="--change"):
            demo_options(0, change, large=False)
