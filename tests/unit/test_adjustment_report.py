"""The report of an adjustment: true to its numbers, whole in its tables, JSON throughout."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path
from typing import get_args

import numpy as np
import pytest

from georef.config import DATUM_FINDINGS
from georef.crs import CrsDefinition, WorldFrame
from georef.estimation.adjustment.adjust_block import AdjustedBlock, BlockOptions, adjust_block
from georef.estimation.adjustment.block import Block
from georef.estimation.adjustment.equations.cofactors import cofactors
from georef.estimation.adjustment.equations.eliminate import normal_equations
from georef.estimation.adjustment.quality.correlations import shared_unknowns, strong_correlations
from georef.estimation.adjustment.solver import solve_block
from georef.estimation.datum.types import Kind
from georef.stages.adjustment_report import adjustment_data, all_reliability
from georef.stages.adjustment_tables import write_tables
from tests.unit.test_weak_focal import flight
from tests.worlds.rig_blocks import rig_block

WORLD = WorldFrame.create(CrsDefinition("local", None), (0.0, 0.0, 0.0))
Adjusted = tuple[Block, AdjustedBlock]


@pytest.fixture(scope="module")
def adjusted() -> Adjusted:
    """A block with one control point 0.3 m off."""
    block = rig_block(seed=2).block
    position = block.point_priors.position.copy()
    position[1, 0] += 0.3
    wrong = replace(block, point_priors=replace(block.point_priors, position=position))
    return wrong, adjust_block(wrong, BlockOptions.of(2.0))


def test_numbers_of_the_report_are_plain_and_complete(adjusted: Adjusted) -> None:
    given, result = adjusted
    checked = all_reliability(result, WORLD)
    data = json.loads(json.dumps(adjustment_data(given, result, checked), allow_nan=False))
    assert {"control_points", "gnss", "pose_priors"} <= set(data["reliability"])
    (rejected,) = (r for r in data["rejected_constraints"] if r["kind"] == "control_points")
    assert rejected["name"] == "GCP1"
    assert rejected["statistic"] > 100.0
    assert rejected["dof"] == 3
    redundancy = data["redundancy"]
    total = sum(c["redundancy"] for c in data["variance_components"].values())
    assert 0 < total < redundancy["redundancy"]  # weights of lens, mounting, antenna and drift are in it as well
    assert redundancy["sigma0"] == pytest.approx(1.0, abs=0.2)
    control = {c["point"]: c for c in data["control"]}
    assert set(control) == {f"GCP{i}" for i in range(6)} - {"GCP1"}
    assert control["GCP2"]["sigma_m"][2] is None
    assert control["GCP2"]["redundancy"][2] is None
    assert control["GCP4"]["dof"] == 1
    summary = data["reliability"]["control_points"]
    worst = max(b for c in control.values() for b in c["detectable_m"] if b is not None)
    assert max(summary["detectable_m"][axis]["greatest"] for axis in "enh") == pytest.approx(worst)
    assert summary["weakest"][0]["name"] in control


def test_tables_hold_every_constraint(adjusted: Adjusted, tmp_path: Path) -> None:
    _, result = adjusted
    checked = all_reliability(result, WORLD)
    names = {path.name for path in write_tables(tmp_path, result, checked, WORLD)}
    expected = {"control", "pose_priors", "gnss", "rejected"}
    assert names == {f"adjustment_{kind}.csv" for kind in expected}
    rows = _rows(tmp_path / "adjustment_control.csv")
    found = checked["control"]
    assert [row["name"] for row in rows] == list(found.ids)
    for k, row in enumerate(rows):
        for axis, label in enumerate("enh"):
            cell = row[f"detectable_{label}_m"]
            value = found.detectable[k, axis]
            assert cell == "" if np.isnan(value) else float(cell) == pytest.approx(value, rel=1e-4)
    poses = _rows(tmp_path / "adjustment_pose_priors.csv")
    assert float(poses[0]["sigma_rot_e_deg"]) == pytest.approx(np.degrees(checked["localized"].sigma[0, 0]), rel=1e-4)
    assert [row["name"] for row in _rows(tmp_path / "adjustment_rejected.csv")] == [r.name for r in result.rejected]


def _rows(path: Path) -> list[dict[str, str]]:
    lines = [line for line in path.read_text(encoding="utf-8").splitlines() if not line.startswith("#")]
    return list(csv.DictReader(lines))


def test_correlations_are_those_of_the_dense_inverse() -> None:
    block = rig_block(seed=4).block
    state = solve_block(block).state
    lin = normal_equations(block, state)
    found = cofactors(lin.reduced)
    dense = np.asarray(np.linalg.inv(lin.reduced.dense()))
    edge = 6 * len(block.station_ids)
    pairs = {(c.first, c.second): c.value for c in strong_correlations(block, state, found, least=0.0)}
    up = np.zeros(len(dense))
    up[:edge].reshape(-1, 6)[:, 3:] = state.world_from_rig.rotation[:, 2] / len(block.station_ids)
    at = edge + int(found.layout.antenna[1])
    expected = dense[at] @ up / np.sqrt(dense[at, at] * (up @ dense @ up))
    assert pairs["lever arm of mast x", "mean position of the stations up"] == pytest.approx(expected, abs=1e-9)
    turn = np.zeros(len(dense))
    turn[:edge].reshape(-1, 6)[:, :3] = state.rig_from_cam[1].rotation[:, 1] / len(block.station_ids)
    at = edge + int(found.layout.mounting[1]) + 1
    expected = dense[at] @ turn / np.sqrt(dense[at, at] * (turn @ dense @ turn))
    name = "boresight of right about camera y", "mean attitude of the stations about right y"
    assert pairs[name] == pytest.approx(expected, abs=1e-9)
    unknowns = {u.name: u for u in shared_unknowns(block, state, found)}
    at = edge + int(found.layout.calibration[0])
    assert unknowns["focal of left"].sigma == pytest.approx(np.sqrt(dense[at, at]) * state.cameras[0].fx)


@pytest.mark.parametrize(("relief_m", "low", "high"), [(0.2, 0.998, 1.0), (15.0, 0.5, 0.98)])
def test_over_flat_ground_the_focal_length_goes_with_the_distance(relief_m: float, low: float, high: float) -> None:
    block = flight(relief_m=relief_m)
    state = block.start()
    found = cofactors(normal_equations(block, state).reduced)
    partners = ("distance of aerial to its scene", "mean position of the stations up")
    every = strong_correlations(block, state, found, least=0.5)
    values = [c.value for c in every if c.first == "focal of aerial" and c.second in partners]
    assert len(values) == 2
    assert all(low < value < high for value in values)  # longer and farther


def test_findings_that_can_be_accepted_are_those_of_the_sentinel() -> None:
    assert set(DATUM_FINDINGS) == set(get_args(Kind))
