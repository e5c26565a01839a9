"""The main job on real photographs, end to end, inside two-sided bounds: too good means that truth has leaked in."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from georef.errors import WeightsError
from georef.evaluation.pose_errors import TruthSigmas
from georef.executor import Executor
from georef.features.weights import locate
from georef.pipeline import run_pipeline
from georef.project import open_project
from georef.stages.evaluate import evaluate

_PROJECT = Path(__file__).parents[2] / "projects" / "castle"
_TRUTH_SIGMA = TruthSigmas(0.01 / np.sqrt(3.0), np.radians(0.02) / np.sqrt(3.0))  # per axis, of what the data state


@pytest.mark.accuracy
def test_castle_without_surveyed_control(georef_data: Path, tmp_path: Path) -> None:
    try:
        locate("aliked-n16")
        locate("aliked_lightglue")
    except WeightsError as error:
        pytest.skip(f"weights: {error}")
    project = open_project(_PROJECT, data=georef_data, output=tmp_path)
    results = list(run_pipeline(project, "new_epoch", Executor(threads=2)))
    assert [result.stage for result in results] == ["features", "network", "index", "localize", "adjust", "report"]
    published = tmp_path / "epochs" / "new_epoch"
    report = json.loads((published / "report.json").read_text())
    assert report["images"]["localized"] == report["images"]["total"] == 9

    truth = georef_data / "castle" / "truth_new_epoch_eo.csv"
    after = evaluate(published / "poses.csv", truth, truth_sigmas=_TRUTH_SIGMA).errors
    before = evaluate(published / "localization.csv", truth, truth_sigmas=_TRUTH_SIGMA).errors
    assert 0.004 < after.position_m.median < 0.014
    assert 0.004 < after.rotation_deg.median < 0.025
    assert after.position_m.maximum_estimated < 0.05
    assert (
        after.position_m.median < before.position_m.median + 0.003
    )  # a third of the truth's sigma: no worse, as far as it tells
    assert after.nees.mean_ratio is not None
    assert 0.4 < after.nees.mean_ratio < 2.0

    check, check_before = report["check_points"], report["check_points_after_pnp"]
    assert check["count"] == 40
    assert 0.003 < check["rmse_3d_m"] < 0.011
    assert check["rmse_3d_m"] < check_before["rmse_3d_m"] + 0.0005
    assert 0.5 < check["nees_with_estimated_mark_sigma"]["mean_ratio"] < 2.0
