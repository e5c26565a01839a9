"""Constraints of a block: residuals as they are written down, derivatives as those of differences."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from georef.estimation.adjustment.block import Antenna, Block, Calibration, Distances, State
from georef.estimation.adjustment.equations.constraint_terms import Term, constraint_terms, root
from georef.estimation.adjustment.equations.reduced import Layout
from georef.geometry.pose_jacobians import inverse_right_jacobians
from georef.geometry.poses import Poses
from georef.geometry.rigid import Array
from tests.worlds.rig_blocks import LEFT, RIGHT, moved, rig_block

_KINDS = (
    "pose priors",
    "GNSS positions",
    "relative poses",
    "distances",
    "mountings",
    "calibrations",
    "lever arms",
    "drift",
)


def _dense(term: Term, size: int) -> Array:
    """Jacobian (K m, size) of a term."""
    count, rows = term.residual.shape
    out = np.zeros((count, rows, size))
    for first, by in term.columns:
        assert by.shape[:2] == (count, rows)
        for k in np.flatnonzero(first >= 0):
            out[k, :, first[k] : first[k] + by.shape[2]] += by[k]
    return out.reshape(count * rows, size)


def _away(block: Block, seed: int, size: float) -> State:
    """A state some way from the start in all unknowns."""
    rng = np.random.default_rng(seed)
    count = Layout.of(block).size
    return moved(block, block.start(), size * rng.normal(size=count), size * rng.normal(size=block.points.shape))


def _by_name(block: Block, state: State) -> dict[str, Term]:
    terms = constraint_terms(block, state)
    assert len({t.name for t in terms}) == len(terms)
    return {t.name: t for t in terms}


@pytest.mark.parametrize(("seed", "size"), [(0, 1e-9), (1, 0.01), (2, 0.1), (3, 0.5)])
def test_derivatives_are_those_of_differences(seed: int, size: float) -> None:
    right = replace(RIGHT, estimate=("focal", "aspect", "cx", "cy", "k1", "k2"))
    block = rig_block(seed, (LEFT, right)).block
    state, count, step = _away(block, seed, size), Layout.of(block).size, 1e-6
    terms = constraint_terms(block, state)
    assert {term.name for term in terms} == set(_KINDS)
    ours = np.concatenate([_dense(term, count) for term in terms])
    for column in range(count):
        change = step * np.eye(count)[column]
        more, less = (
            np.concatenate([t.residual.ravel() for t in constraint_terms(block, moved(block, state, sign * change))])
            for sign in (1.0, -1.0)
        )
        scale = 1.0 + np.abs(ours[:, column]).max()
        np.testing.assert_allclose(ours[:, column] / scale, (more - less) / (2 * step) / scale, atol=2e-7)


@pytest.mark.parametrize("size", [1e-9, 1e-3, 0.3, 1.0, 1.7])
def test_inverse_right_jacobian_undoes_the_right_one(size: float) -> None:
    xi = np.random.default_rng(0).normal(size=(50, 6)) * [size, size, size, 3.0, 3.0, 3.0]
    xi = xi[np.linalg.norm(xi[:, :3], axis=1) < 3.1]
    ours, step = inverse_right_jacobians(xi), 1e-6
    for axis in range(6):
        change = np.tile(step * np.eye(6)[axis], (len(xi), 1))
        difference = (Poses.exp(xi) @ Poses.exp(change)).log() - (Poses.exp(xi) @ Poses.exp(-change)).log()
        np.testing.assert_allclose(ours[:, :, axis], difference / (2 * step), atol=1e-8 * (1 + np.abs(ours).max()))


def test_residuals_are_estimated_minus_reference_in_sigmas() -> None:
    world = rig_block(4)
    block, state = world.block, _away(world.block, 5, 0.02)
    terms = _by_name(block, state)
    positions, drift = block.position_priors, state.drift_m
    for k in range(len(positions)):
        pose, lever = state.world_from_rig[positions.station[k]], state.lever_arms_m[positions.antenna[k]]
        error = pose.apply(lever) - positions.position[k]
        if positions.drift_node[k, 0] >= 0:
            error = error + positions.drift_weight[k] @ drift
        squared = error @ np.linalg.solve(positions.cov[k], error)
        assert np.sum(terms["GNSS positions"].residual[k] ** 2) == pytest.approx(squared)
    for k, image in enumerate(block.pose_priors.image):
        error = block.pose_priors.world_from_cam[k].local(block.world_from_cam(state)[image])
        squared = error @ np.linalg.solve(block.pose_priors.cov[k], error)
        assert np.sum(terms["pose priors"].residual[k] ** 2) == pytest.approx(squared)
    between = np.linalg.norm(state.points[0] - state.points[3])
    expected = (between - block.distances.distance_m[0]) / block.distances.sigma_m[0]
    assert terms["distances"].residual[0, 0] == pytest.approx(expected)
    motion = state.world_from_rig[3].inverse() @ state.world_from_rig[5]
    error = block.relative_poses.a_from_b[1].local(motion)
    squared = error @ np.linalg.solve(block.relative_poses.cov[1], error)
    assert np.sum(terms["relative poses"].residual[1] ** 2) == pytest.approx(squared)


def test_at_the_truth_squares_are_as_many_as_residuals() -> None:
    squares, counts = 0.0, 0
    for seed in range(20):
        world = rig_block(seed)
        for term in constraint_terms(world.block, world.truth):
            if term.name in ("pose priors", "GNSS positions", "relative poses", "distances"):
                squares, counts = squares + float(np.sum(term.residual**2)), counts + term.residual.size
    assert abs(squares / counts - 1.0) < 4.0 * np.sqrt(2.0 / counts)


def test_weights_are_zero_at_what_was_given_and_steps_are_measured_from_there() -> None:
    block = rig_block(0).block
    start = _by_name(block, block.start())
    for name in ("mountings", "calibrations", "lever arms", "drift"):
        np.testing.assert_allclose(start[name].residual, 0.0, atol=1e-12)
    step = np.array([0.02, -0.01])
    cameras = tuple(c.camera.changed(c.camera.estimate, step) for c in block.calibrations)
    found = _by_name(block, replace(block.start(), cameras=cameras))["calibrations"]
    np.testing.assert_allclose(np.sum(found.residual**2, axis=1), np.sum((step / 0.01) ** 2))
    assert found.row.tolist() == [0, 1]
    assert start["mountings"].row.tolist() == start["lever arms"].row.tolist() == [1]


@pytest.mark.parametrize("names", [("focal",), ("cx", "k2", "focal", "cy", "aspect", "k1")])
def test_steps_since_a_camera_are_those_that_changed_it(names: tuple[str, ...]) -> None:
    steps = np.random.default_rng(0).normal(size=len(names)) * 0.05
    for camera in (LEFT, RIGHT):
        np.testing.assert_allclose(camera.changed(names, steps).steps_since(camera, names), steps, atol=1e-14)


def test_what_is_held_or_absent_has_no_column() -> None:
    block = rig_block(0).block
    terms = _by_name(block, block.start())
    layout = Layout.of(block)
    poses, positions = terms["pose priors"].columns, terms["GNSS positions"].columns
    mounting = block.mounting[block.pose_priors.image]
    np.testing.assert_array_equal(poses[1][0] >= 0, mounting == 1)
    np.testing.assert_array_equal(positions[1][0] >= 0, block.position_priors.antenna == 1)
    np.testing.assert_array_equal(positions[2][0] >= 0, block.position_priors.antenna == 0)
    assert terms["distances"].columns[0][0].tolist() == [
        6 * layout.stations + layout.kept_point[0],
        6 * layout.stations + layout.kept_point[7],
    ]
    held = replace(
        block,
        mountings=tuple(replace(m, information=None) for m in block.mountings),
        calibrations=tuple(Calibration.held(c.camera) for c in block.calibrations),
        antennas=tuple(Antenna(a.name, a.lever_arm_m) for a in block.antennas),
        distances=Distances.none(),
    )
    assert set(_by_name(held, held.start())) == {"pose priors", "GNSS positions", "relative poses", "drift"}


def test_a_constant_drift_and_a_node_named_twice_are_the_same() -> None:
    block = rig_block(0).block
    priors, state = block.position_priors, _away(block, 1, 0.05)
    once = replace(priors, drift_node=np.tile([0, -1], (12, 1)), drift_weight=np.tile([1.0, 0.0], (12, 1)))
    twice = replace(priors, drift_node=np.tile([0, 0], (12, 1)), drift_weight=np.tile([0.3, 0.7], (12, 1)))
    count = Layout.of(block).size
    a, b = (_by_name(replace(block, position_priors=p), state)["GNSS positions"] for p in (once, twice))
    np.testing.assert_allclose(a.residual, b.residual)
    np.testing.assert_allclose(_dense(a, count), _dense(b, count))
    ends = [first for first, _ in b.columns]
    assert all((ends[i] != ends[j]).all() or (ends[i] == -1).all() for i in range(4) for j in range(i))


def test_the_root_of_a_singular_weight() -> None:
    w = np.random.default_rng(0).normal(size=(4, 2, 6))
    information = np.concatenate([np.swapaxes(w, 1, 2) @ w, np.zeros((1, 6, 6))])
    found = root(information)
    np.testing.assert_allclose(np.swapaxes(found, 1, 2) @ found, information, atol=1e-12)
