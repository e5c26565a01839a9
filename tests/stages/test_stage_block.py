"""The verb `adjust`: a block of measurements and a problem file, from files to a report."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from georef.cli import app
from georef.estimation.adjustment.campaign.checkpoints import Reached
from georef.io.bal import BalProblem, read_bal, write_bal
from georef.io.poses import read_poses
from georef.stages.solve_files import SOLVES, SolveFiles
from georef.terminal import exit_code
from tests.worlds.aerial import flight, write_flight

_OFFSET = (0.04, 0.03, -0.08)


@pytest.fixture(scope="module")
def adjusted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("flight")
    write_flight(
        flight(2, offset_m=_OFFSET),
        folder,
        control='["P0", "P2", "P4", "P6"]',
        more="hold_out = { control = 4, count = 6 }",
        gnss="offset_sigma_m = [0.1, 0.1, 0.2]",
    )
    assert exit_code(app, ["adjust", str(folder), "-o", str(folder / "out")]) == 0
    return folder / "out" / "epochs" / "flight"


def test_check_points_come_out_as_well_as_measured(adjusted: Path) -> None:
    """Two-sided: errors far below those of marks and survey would mean that check points took part."""
    report = json.loads((adjusted / "report.json").read_text(encoding="utf-8"))
    declared = report["variants"]["as declared"]
    summary = declared["check"]["absolute"]
    assert declared["control"] == ["P0", "P2", "P4", "P6"]
    assert summary["count"] == 4
    assert 0.003 < summary["rmse_horizontal_m"] < 0.03
    assert 0.003 < summary["rmse_h_m"] < 0.06
    assert 0.1 < summary["nees"]["mean_ratio"] < 3.0
    every = report["variants"]["all control"]
    assert len(every["control_residuals_m"]) == 8
    assert every["check"] == {}


def test_the_offset_of_the_positions_is_found_in_two_ways(adjusted: Path) -> None:
    report = json.loads((adjusted / "report.json").read_text(encoding="utf-8"))
    alone, unknowns = report["offset"], report["variants"]["all control"]["shared_unknowns"]
    assert np.abs((np.array(alone["offset_m"]) - _OFFSET) / alone["sigma_m"]).max() < 4.0
    estimated = [next(u for u in unknowns if u["name"] == f"GNSS offset {axis}") for axis in ("east", "north", "up")]
    for unknown, truth in zip(estimated, _OFFSET, strict=True):
        assert abs(abs(unknown["value"]) - abs(truth)) < 4.0 * unknown["sigma"]
        assert 0.001 < unknown["sigma"] < 0.1


def test_an_interrupted_block_goes_on(adjusted: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Stopped in the middle of its solves, it repeats none of their iterations and ends at the same numbers."""
    written: list[str] = []
    write = SolveFiles.write

    def stopping(self: SolveFiles, key: str, reached: Reached) -> None:
        write(self, key, reached)
        written.append(key)
        if len(written) == 9:
            raise KeyboardInterrupt

    monkeypatch.setattr(SolveFiles, "write", stopping)
    command = ["adjust", str(adjusted.parents[2]), "-o", str(tmp_path)]
    assert exit_code(app, command) != 0
    solves = tmp_path / "epochs" / "flight" / SOLVES
    assert len(list(solves.iterdir())) == len(set(written)) > 1
    done, again = set(written[:-1]) - {written[-1]}, len(written)
    assert exit_code(app, command) == 0
    assert not done & set(written[again:])
    assert not solves.exists()
    first, second = (json.loads((f / "report.json").read_text(encoding="utf-8")) for f in (adjusted, solves.parent))
    for report in (first, second):
        del report["timing"]
    assert second["data"] == first["data"]
    assert second["variants"]["all control"]["control_residuals_m"] == [
        pytest.approx(row, abs=1e-9) for row in first["variants"]["all control"]["control_residuals_m"]
    ]


def test_splits_agree_with_an_adjustment(adjusted: Path) -> None:
    hold_out = json.loads((adjusted / "report.json").read_text(encoding="utf-8"))["hold_outs"][0]
    assert len(hold_out["splits"]) == 6
    assert hold_out["first_split_adjusted_differs_m"] < 3e-3
    assert 0.002 < max(hold_out["median_rmse_m"]) < 0.05
    assert 0.3 < hold_out["nees"]["mean_ratio"] < 3.0


def test_poses_and_cameras_are_written(adjusted: Path) -> None:
    truth = flight(2, offset_m=_OFFSET).world_from_cam
    poses = read_poses(adjusted / "poses.csv", crs_kind="local")
    found = np.array([record.position_in_crs for record in poses.records])
    assert len(found) == len(truth)
    assert 0.002 < np.median(np.linalg.norm(found - truth.translation, axis=1)) < 0.3  # the origin is not moved: local
    assert "sigma_focal" in (adjusted / "cameras.csv").read_text(encoding="utf-8")
    assert "splits into 4 control and 4 check points" in (adjusted / "report.txt").read_text(encoding="utf-8")


def test_a_block_is_nothing_to_localize(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = write_flight(flight(), tmp_path / "f")
    assert exit_code(app, ["run", str(folder)]) == 1
    assert "The project has no epochs." in capsys.readouterr().err


def test_the_cost_of_a_problem_file_falls_to_its_noise(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_bal(_disturbed(), tmp_path / "p.txt")
    assert exit_code(app, ["adjust", str(tmp_path / "p.txt"), "-o", str(tmp_path / "out")]) == 0
    said = capsys.readouterr().out
    assert "8 cameras, 150 points, 1200 observations" in said
    cost = float(said.split(" -> ")[1].split(" ")[0])
    expected = 0.5 * (2 * 1200 - 9 * 8 - 3 * 150 + 7)  # of unit noise, the datum free
    assert 0.85 * expected < cost < 1.15 * expected
    again = read_bal(tmp_path / "out" / "p.txt")
    assert np.array_equal(again.xy, read_bal(tmp_path / "p.txt").xy)


def _disturbed() -> BalProblem:
    """Eight cameras about a cloud, observations with noise of 1 px, values that are off by a few percent."""
    from georef.geometry.poses import exp_so3

    rng = np.random.default_rng(5)
    points = rng.uniform(-2, 2, (150, 3))
    rotation = 0.4 * rng.normal(size=(8, 3))
    cameras = np.column_stack([rotation, rng.normal(size=(8, 2)), np.full(8, -10.0), np.full((8, 1), 800.0)])
    cameras = np.column_stack([cameras, np.full(8, -0.05), np.full(8, 0.01)])
    camera, point = (index.ravel() for index in np.indices((8, 150)))
    row = cameras[camera]
    p = np.einsum("nij,nj->ni", exp_so3(row[:, :3]), points[point]) + row[:, 3:6]
    slope = -p[:, :2] / p[:, 2:]
    r2 = np.sum(np.square(slope), axis=1, keepdims=True)
    xy = row[:, 6:7] * (1 + row[:, 7:8] * r2 + row[:, 8:9] * r2**2) * slope + rng.normal(size=(1200, 2))
    off = cameras + rng.normal(size=cameras.shape) * [*[0.01] * 3, *[0.05] * 3, 10.0, 0.01, 0.001]
    return BalProblem(camera, point, xy, off, points + 0.05 * rng.normal(size=points.shape))


def test_the_page_and_the_status_say_what_was_found(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = write_flight(flight(2), tmp_path / "f", control='["P0", "P2", "P4", "P6"]')
    assert exit_code(app, ["status", str(folder)]) == 0
    assert "new      not adjusted yet" in capsys.readouterr().out
    assert exit_code(app, ["adjust", str(folder)]) == 0
    page = (folder / "epochs" / "flight" / "report.html").read_text(encoding="utf-8")
    assert page.count("<svg") == 6  # control, check points, all control, GNSS, ellipses; one camera
    assert "Baarda" in page
    assert "GNSS positions" in page
    assert exit_code(app, ["status", str(folder)]) == 0
    assert "done     28 images" in capsys.readouterr().out
    table = folder / "surveyed.csv"
    table.write_text(table.read_text(encoding="utf-8") + "\n", encoding="utf-8")
    assert exit_code(app, ["status", str(folder)]) == 0
    assert "stale    changed: surveyed.csv" in capsys.readouterr().out
