"""The verb `adjust` for a block of a rig of five cameras: mountings, starts, blunders, covariances."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from georef.cli import app
from georef.geometry.rigid import Rigid3
from georef.io.poses import read_poses
from georef.terminal import exit_code
from tests.worlds.oblique import LEVER_M, NAMES, Oblique, Wrong, nominal, oblique, write_oblique

_CONTROL = '["P0", "P2", "P4", "P6", "P8"]'
_LEVER = f"lever_arm_m = {LEVER_M.tolist()}"


def _adjusted(folder: Path) -> dict[str, Any]:
    assert exit_code(app, ["adjust", str(folder), "-o", str(folder / "out")]) == 0
    return json.loads((folder / "out" / "epochs" / "flight" / "report.json").read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def made() -> Oblique:
    return oblique(3)


@pytest.fixture(scope="module")
def weighted(made: Oblique, tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, Any], Path]:
    """Mountings weighted about the maker's, the rig's camera starts looking down, blunders of all kinds."""
    folder = write_oblique(
        made,
        tmp_path_factory.mktemp("weighted"),
        rig="[blocks.flight.rig]\nfile = \"rig.csv\"\nstation_pattern = '_(\\d+)$'",
        gnss=_LEVER,
        control=_CONTROL,
        wrong=Wrong(0.03, gnss_m=0.6, control_m=0.4),
    )
    return _adjusted(folder), folder


def test_blunders_of_all_kinds_are_named(weighted: tuple[dict[str, Any], Path]) -> None:
    report, _ = weighted
    count = report["data"]["image_observations"] + report["data"]["rejected_observations"]
    assert 0.025 * count < report["data"]["rejected_observations"] < 0.04 * count
    names = [entry["name"] for entry in report["rejected"] if entry["kind"] == "GNSS positions"]
    assert "017" in names
    assert len(names) == len(report["rejected"]) <= 2  # a neighbour may go with it
    declared = report["variants"]["as declared"]
    assert [(entry["kind"], entry["name"]) for entry in declared["rejected"]] == [("control", "P2")]
    assert declared["control"] == ["P0", "P4", "P6", "P8"]
    assert declared["rejected"][0]["statistic"] > 50.0


def test_mountings_come_out_within_their_sigmas(made: Oblique, weighted: tuple[dict[str, Any], Path]) -> None:
    ratios = _mounting_errors(made, weighted[0])
    assert np.abs(ratios).max() < 4.0
    assert 0.3 < np.mean(np.square(ratios)) < 2.2


def test_poses_err_as_their_covariances_say(made: Oblique, weighted: tuple[dict[str, Any], Path]) -> None:
    assert 0.35 < _pose_nees(made, weighted[1]) < 2.0


def test_check_points_err_as_predicted(weighted: tuple[dict[str, Any], Path]) -> None:
    summary = weighted[0]["variants"]["as declared"]["check"]["absolute"]
    assert summary["count"] == 4
    assert 0.004 < summary["rmse_horizontal_m"] < 0.04
    assert 0.1 < summary["nees"]["mean_ratio"] < 3.0


def test_control_is_reported_point_by_point(weighted: tuple[dict[str, Any], Path]) -> None:
    declared = weighted[0]["variants"]["as declared"]
    row = declared["control_points"][0]
    assert row["point_id"] == "P0"
    assert all(0.1 < r < 1.0 for r in row["redundancy"])
    assert all(4.13 * 0.01 < d < 0.3 for d in row["detectable_m"])
    assert 0.7 < declared["components"]["tie points"]["factor"] < 1.1
    assert 0.6 < declared["components"]["mountings"]["factor"] < 1.7
    text = (weighted[1] / "out" / "epochs" / "flight" / "report.txt").read_text(encoding="utf-8")
    assert "rejected: control P2" in text
    assert "rejected: GNSS positions 017" in text


def test_free_mountings_start_from_attitudes(tmp_path: Path) -> None:
    """Pix4D's own tie points; no table of mountings, positions of each image, exposures by their time."""
    made = oblique(5, 3, 6)
    folder = write_oblique(
        made,
        tmp_path,
        form="pix4d",
        rig='[blocks.flight.rig]\nreference = "N"\nstation_within_s = 0.1',
        gnss=_LEVER,
        attitudes="all",
        by_image=True,
    )
    report = _adjusted(folder)
    assert report["data"]["stations"] == 18
    assert report["data"]["images"] == 90
    poses = read_poses(folder / "out" / "epochs" / "flight" / "poses.csv", crs_kind="local")
    assert len(poses.records) == 90
    assert 0.35 < _pose_nees(made, folder) < 2.0


def test_images_without_a_rig_are_exposures_of_their_own(tmp_path: Path) -> None:
    """Lever arms by camera; each image starts from its own attitude."""
    made = oblique(6, 2, 5)
    levers = {name: (made.rig_from_cam[name].inverse().apply(LEVER_M[None])[0]).round(5).tolist() for name in NAMES}
    text = ", ".join(f"{name} = {lever}" for name, lever in levers.items())
    folder = write_oblique(made, tmp_path, gnss=f"lever_arm_m = {{ {text} }}", attitudes="all", by_image=True)
    report = _adjusted(folder)
    assert report["data"]["stations"] == 50
    assert len(report["variants"]["as declared"]["control"]) == 9
    assert 0.2 < _pose_nees(made, folder) < 2.5


def _mounting_errors(made: Oblique, report: dict[str, Any]) -> np.ndarray:
    """Errors of all mountings over their sigmas."""
    unknowns = {u["name"]: u for u in report["variants"]["as declared"]["shared_unknowns"]}
    out = []
    for name in NAMES[1:]:
        turn = [unknowns[f"boresight of {name} about camera {axis}"] for axis in "xyz"]
        shift = [unknowns[f"mounting of {name} along camera {axis}"] for axis in "xyz"]
        truth = nominal(name).local(made.rig_from_cam[name])
        truth[:3] = np.degrees(truth[:3])
        out.append([(u["value"] - t) / u["sigma"] for u, t in zip([*turn, *shift], truth, strict=True)])
    return np.array(out)


def _pose_nees(made: Oblique, folder: Path) -> float:
    """Mean NEES over 6 of all images."""
    records = read_poses(folder / "out" / "epochs" / "flight" / "poses.csv", crs_kind="local").records
    ratios = []
    for record in records:
        found = Rigid3(np.asarray(record.axes_from_cam), np.asarray(record.position_in_crs))
        error = made.world_from_cam(record.image_id).local(found)
        assert record.cov is not None
        ratios.append(error @ np.linalg.solve(record.cov, error) / 6.0)
    return float(np.mean(ratios))
