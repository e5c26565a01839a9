"""A reference that is worse than it was: its estimated sigma says so, and the sigmas of new poses follow."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from georef.comparison.truth import read_truth
from georef.errors import WeightsError
from georef.evaluation.pose_errors import TruthSigmas, compare_poses
from georef.executor import Executor
from georef.features.weights import locate
from georef.pipeline import run_pipeline
from georef.project import open_project
from georef.stages.localize import make_task
from georef.stages.network import read_noise
from georef.types.results import Localized, Outcome, ReferenceNoise

_PROJECT = Path(__file__).parents[2] / "projects" / "castle"
_DISTURBED_M = 0.02  # per axis
_QUERIES = ("b0003.jpg", "b0009.jpg", "b0015.jpg")
_TRUTH_SIGMA = TruthSigmas(0.01 / np.sqrt(3.0), np.radians(0.02) / np.sqrt(3.0))


def disturbed_orientation(path: Path, to: Path) -> Path:
    """The table of exterior orientations with errors of the positions, independent from image to image."""
    lines = path.read_text(encoding="utf-8").splitlines()
    comments = [line for line in lines if line.startswith("#")]
    rows = list(csv.DictReader(line for line in lines if not line.startswith("#")))
    rng = np.random.default_rng(5)
    for row in rows:
        for name in ("easting", "northing", "height"):
            row[name] = f"{float(row[name]) + _DISTURBED_M * rng.normal():.4f}"
    body = [",".join(rows[0]), *(",".join(row.values()) for row in rows)]
    to.write_text("\n".join([*comments, *body]) + "\n", encoding="utf-8")
    return to


def localized(data: Path, output: Path, *settings: str) -> tuple[ReferenceNoise, list[Outcome], float]:
    """The estimated noise of the reference, three new images, and their NEES / 6 against the truth."""
    settings = ("network.max_images=16", *settings)
    project = open_project(_PROJECT, data=data / "castle", output=output, settings=settings)
    last = list(run_pipeline(project, "new_epoch", Executor(threads=2), last="index"))[-1].context
    context = replace(last, before={**last.before, "index": last.folder})
    task = make_task(context)
    outcomes = [task(context.survey.epoch[name]) for name in _QUERIES]
    truth = read_truth(data / "castle" / "truth_new_epoch_eo.csv", project, "new_epoch", _TRUTH_SIGMA)
    found = {o.image_id: (o.world_from_cam, o.world_from_cam_cov) for o in outcomes if isinstance(o, Localized)}
    poses = truth.in_world(context.survey.world).poses
    errors = compare_poses(found, poses, truth_sigmas=_TRUTH_SIGMA, expected=_QUERIES)
    assert errors.nees.mean_ratio is not None
    return read_noise(context.before["network"])[0], outcomes, errors.nees.mean_ratio


@pytest.mark.accuracy
def test_positions_disturbed_by_two_centimetres_are_noticed(georef_data: Path, tmp_path: Path) -> None:
    try:
        locate("aliked-n16")
        locate("aliked_lightglue")
    except WeightsError as error:
        pytest.skip(f"weights: {error}")
    table = disturbed_orientation(georef_data / "castle" / "reference_eo.csv", tmp_path / "disturbed_eo.csv")
    before, as_given, _ = localized(georef_data, tmp_path / "out")
    after, disturbed, nees = localized(georef_data, tmp_path / "out", f'reference.exterior_orientation="{table}"')
    expected = np.hypot(before.position_sigma_m[0], _DISTURBED_M)
    assert 0.75 * expected < after.position_sigma_m[0] < 1.3 * expected
    for given, other in zip(as_given, disturbed, strict=True):
        assert isinstance(given, Localized)
        assert isinstance(other, Localized)
        ratio = np.trace(other.world_from_cam_cov[3:, 3:]) / np.trace(given.world_from_cam_cov[3:, 3:])
        grown = (after.position_sigma_m[0] / before.position_sigma_m[0]) ** 2
        assert 0.5 * grown < ratio < 2.0 * grown
    assert 0.1 < nees < 2.5
