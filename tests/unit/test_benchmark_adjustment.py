"""The benchmark of the adjustment at toy size: both ways solve the same problem."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from georef.benchmarks import adjustment, adjustment_report
from georef.benchmarks.adjustment import Ceres
from georef.benchmarks.adjustment_problem import Size, image_cost, read_problem, write_problem
from georef.benchmarks.measure import Cost
from georef.cli import app
from georef.terminal import exit_code


def _here(work, *arguments) -> Cost:
    """As `measured`, in this process."""
    return Cost(work(*arguments), 1.0, 1.0, 1.0)


@pytest.mark.parametrize(("cameras", "free"), [(5, False), (11, True)])
def test_both_ways_find_the_same(cameras, free: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(adjustment, "measured", _here)
    result = adjustment.run(Size(60, cameras, 30_000, free), tmp_path, [Ceres("direct"), Ceres("iterative", 2)])
    assert json.loads(json.dumps(result)) == result
    ours, ceres = result["ways"]["georef"], result["ways"]["Ceres, direct"]
    assert ours["converged"]
    assert ceres["converged"]
    assert ours["cost"] == pytest.approx(ceres["cost"], rel=1e-6)
    assert result["ways"]["Ceres, iterative"]["iterations"] <= 2
    assert list(result["between"]) == ["Ceres, direct"]
    assert result["between"]["Ceres, direct"]["position_m"] < 1e-4
    assert ours["points_s"] + ours["reduced_s"] == pytest.approx(ours["iteration_s"])
    assert 1e-4 < ours["rmse_m"] < 0.01
    unknowns = 6 * (60 - result["held_stations"]) + 3 * result["points"] + (5 * cameras if free else 0)
    assert 2.0 * ours["cost"] / (2 * result["observations"] - unknowns) == pytest.approx(1.0, abs=0.03)
    assert result["start_cost"] > 10.0 * ours["cost"]
    assert sum("Ceres, iterative" in line for line in adjustment_report.describe(result)) == 2


def test_several_sizes_and_how_they_grow(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(adjustment, "measured", _here)
    result = adjustment.run_all(tmp_path, (), (Size(20, 5, 4000), Size(40, 5, 8000)))
    assert [one["stations"] for one in result["sizes"]] == [20, 40]
    assert not list(tmp_path.rglob("*.npz"))
    lines = adjustment_report.describe(result)
    assert sum("power that georef grows with" in line for line in lines) == 1
    adjustment_report.picture(result, tmp_path / "growth.png")
    assert (tmp_path / "growth.png").read_bytes()[:4] == b"\x89PNG"


def test_a_problem_comes_back_from_its_file(tmp_path: Path) -> None:
    size = Size(20, 5, 4000)
    write_problem(tmp_path, size)
    block = read_problem(tmp_path, size)
    assert len(block.observations) >= 4000
    assert len(block.pose_priors) == len(size.held) == 2
    state = block.start()
    pixel = block.views(state).project(block.observations.view, state.points[block.observations.point])
    squares = np.square(pixel - block.observations.pixel).sum()
    assert image_cost(block, state, chunk=700) == pytest.approx(0.5 * squares, rel=1e-12)


def test_the_verb_without_ceres(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(adjustment, "measured", _here)
    arguments = ["benchmark", "adjustment", "--stations", "20", "--observations", "4000", "--no-ceres"]
    assert exit_code(app, [*arguments, "-o", str(tmp_path / "out.json")]) == 0
    assert "20 stations, 100 images" in capsys.readouterr().out
    assert list(json.loads((tmp_path / "out.json").read_text())["ways"]) == ["georef"]
    assert exit_code(app, ["benchmark", "adjustment", "--cameras", "7"]) == 2
