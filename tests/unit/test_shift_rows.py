"""Shifts of given poses and points against the plain way: all observation equations in one dense matrix."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from georef.estimation.adjustment.block import Block, Indices, PointPriors, State
from georef.estimation.adjustment.blunders.shift_rows import ShiftRows, shift_rows, shift_system, stations_of_points
from georef.estimation.adjustment.blunders.shift_system import ShiftSystem
from georef.estimation.adjustment.equations.cofactors import cofactors
from georef.estimation.adjustment.equations.eliminate import IMAGE_OBSERVATIONS, normal_equations
from georef.estimation.adjustment.equations.given_points import GivenRays
from georef.estimation.adjustment.equations.reduced import Layout
from georef.geometry.rigid import Array
from tests.worlds.dense_normals import Equations, equations
from tests.worlds.rig_blocks import rig_block

_SIGMA_M = 0.02


def _with_gcps(block: Block, truth: State, seed: int, count: int = 24) -> Block:
    """Automatic GCPs beside the surveyed points, their covariances turned and correlated."""
    rng = np.random.default_rng(seed)
    taken = np.union1d(block.point_priors.point, np.concatenate([block.distances.a, block.distances.b]))
    point = np.setdiff1d(np.arange(len(block.points)), taken)[:count]
    root = _SIGMA_M * (np.eye(3) + 0.5 * rng.normal(size=(count, 3, 3)))
    position = truth.points[point] + np.einsum("kij,kj->ki", root, rng.normal(size=(count, 3)))
    given, names = block.point_priors, tuple(f"A{i}" for i in range(count))
    weight = np.asarray(np.linalg.inv(root @ np.swapaxes(root, 1, 2)), dtype=np.float64)
    return replace(
        block,
        point_priors=PointPriors(
            np.concatenate([given.point, point]),
            np.concatenate([given.position, position]),
            np.concatenate([given.information, weight]),
            np.concatenate([given.kind, np.ones(count, np.int64)]),
            (*given.point_ids, *names),
        ),
    )


@pytest.fixture(scope="module")
def world() -> tuple[Block, State]:
    made = rig_block(seed=5)
    return _with_gcps(made.block, made.truth, 1), made.truth


def _rows(block: Block) -> ShiftRows:
    """All that can be tested."""
    pose = np.flatnonzero(block.pose_priors.kind == 0)
    point = np.flatnonzero(block.point_priors.kind == 1)
    at_point = stations_of_points(block)[block.point_priors.point[point]]
    order = np.argsort(at_point, kind="stable")
    return ShiftRows(pose, block.station[block.pose_priors.image[pose]], point[order], at_point[order])


def _system(block: Block, state: State, rows: ShiftRows, losses: dict[str, float] | None = None) -> ShiftSystem:
    lin = normal_equations(block, state, losses=losses)
    return shift_system(block, state, cofactors(lin.reduced), lin.reduced.gradient, rows, losses)


def _dense_design(block: Block, found: Equations, system: ShiftSystem) -> Array:
    """What shifts of the segments do to the residuals (n, 3 segments)."""
    out = np.zeros((len(found.residual), 3 * len(system)))
    for row, segment in zip(system.points.row, system.points.segment, strict=True):
        lines, at = found.rows("points", int(row)), found.point[block.point_priors.point[row]]
        out[lines, 3 * segment : 3 * segment + 3] = -found.design[lines, at : at + 3]
    for row, segment in zip(system.poses.row, system.poses.segment, strict=True):
        lines, station = found.rows("pose priors", int(row)), 6 * block.station[block.pose_priors.image[row]]
        rotation = block.world_from_rig.rotation[block.station[block.pose_priors.image[row]]]
        # A step of the station's position in world axes does the opposite.
        out[lines, 3 * segment : 3 * segment + 3] = -found.design[lines, station + 3 : station + 6] @ rotation.T
    return out


def test_equations_of_shifts_are_those_of_the_whole_block(world: tuple[Block, State]) -> None:
    block, state = world
    state = replace(state, points=state.points + 0.001)  # not at the minimum: the gradient counts
    block = replace(block, world_from_rig=state.world_from_rig)
    found, system = equations(block, state), _system(block, state, _rows(block))
    design = _dense_design(block, found, system)
    fitted = found.design @ found.inverse @ found.design.T
    checked = np.eye(len(found.residual)) - fitted
    points = slice(3 * system.spans[0][1], None)
    scale = np.sqrt(np.diag(design.T @ checked @ design))
    off = (system.information - design.T @ checked @ design) / scale[:, None] / scale
    assert np.abs(off[points, points]).max() < 1e-7
    assert np.abs(off).max() < 0.02  # rotations of given poses are linearised at their residuals
    right = design.T @ checked @ found.residual / scale
    assert np.abs(system.right / scale - right)[points].max() < 1e-4 * np.abs(right).max()


@pytest.mark.parametrize("losses", [None, {IMAGE_OBSERVATIONS: 1.0}])
def test_a_planted_shift_is_estimated(world: tuple[Block, State], losses: dict[str, float] | None) -> None:
    block, state = world
    rows, planted = _rows(block), np.array([0.3, -0.2, 0.1])
    before = _system(block, state, rows, losses)
    segment = before.spans[1][0]
    chosen = before.points.row[before.points.segment == segment]
    position = block.point_priors.position.copy()
    position[chosen] += planted
    moved = replace(block, point_priors=replace(block.point_priors, position=position))
    design = np.eye(len(before))[:, [segment]]
    (shift,), cov, _ = before.estimate(design)
    (after,), _, _ = _system(moved, state, rows, losses).estimate(design)
    assert np.allclose(after - shift, planted, atol=1e-9)
    assert shift @ np.linalg.solve(cov, shift) < 16.3


def test_segments_joined_are_their_sum(world: tuple[Block, State]) -> None:
    block, state = world
    system = _system(block, state, _rows(block))
    group = np.where(np.arange(len(system)) % 3 == 2, -1, np.arange(len(system)) % 3)
    joined = system.grouped(group, 2)
    design = np.column_stack([group == 0, group == 1]).astype(np.float64)
    for ours, theirs in zip(joined.estimate(np.eye(2)), system.estimate(design), strict=True):
        assert np.allclose(ours, theirs, rtol=1e-6)
    assert joined.members.tolist() == [system.members[group == k].sum() for k in (0, 1)]


def test_coupling_of_given_points_is_that_of_the_dense_equations(world: tuple[Block, State]) -> None:
    """Stations, mountings and calibrations: one block after another."""
    block, state = world
    found, layout = equations(block, state), Layout.of(block)
    rows = np.flatnonzero(block.point_priors.kind == 1)
    rays = GivenRays.of(block, state, layout, rows)
    whole = np.asarray(
        rays.coupled(np.tile(np.eye(3), (len(rows), 1, 1)), layout.size, np.arange(len(rows)), len(rows)).todense()
    )
    images = [i for i, group in enumerate(found.group) if group == "image"]
    for k, row in enumerate(rows):
        at = found.point[block.point_priors.point[row]]
        by_point = found.design[images, at : at + 3]
        expected = found.design[images, : layout.size].T @ by_point
        assert np.allclose(whole[:, 3 * k : 3 * k + 3], expected, atol=1e-7 * np.abs(expected).max())
        assert np.allclose(rays.normal[k], by_point.T @ by_point)
        assert np.allclose(rays.slope[k], by_point.T @ found.residual[images])


def test_single_blunders_are_not_tested(world: tuple[Block, State]) -> None:
    block, state = world
    layout, losses = Layout.of(block), {"automatic": 2.0}
    good = shift_rows(block, state, layout, losses)
    assert len(good.point) >= 23
    position = block.point_priors.position.copy()
    wrong: Indices = good.point[[3, 12]]
    position[wrong] += [[0.4, 0.0, 0.1], [0.0, -0.5, 0.2]]
    spoilt = replace(block, point_priors=replace(block.point_priors, position=position))
    assert np.setdiff1d(good.point, shift_rows(spoilt, state, layout, losses).point).tolist() == sorted(wrong.tolist())
