"""The graph of a block in GTSAM: the same residuals and derivatives as ours, native factors and functions alike."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import gtsam_unstable
import numpy as np
import pytest

from georef.estimation.adjustment.block import Block, Calibration, Distances, PointPriors, State
from georef.estimation.adjustment.equations.constraint_terms import Term, constraint_terms
from georef.estimation.adjustment.equations.reduced import Layout
from georef.estimation.adjustment.gtsam_reference.factors import Lens, custom_observation, native_calibration
from georef.estimation.adjustment.gtsam_reference.graph import BlockGraph, solve_with_gtsam
from georef.geometry.camera import Camera, intrinsic_derivatives
from georef.geometry.projection import linearize
from georef.geometry.rigid import Array
from georef.types.scene import Observations
from tests.worlds.rig_blocks import LEFT, RIGHT, moved, rig_block

_K3 = replace(LEFT, distortion=(-0.05, 0.01, 2e-4, -1e-4, 0.01), estimate=("p1", "k3", "cx", "p2", "cy"))
_RATIONAL = replace(
    LEFT,
    model="rational",
    distortion=(0.2, -0.05, 2e-4, -1e-4, 0.01, 0.3, -0.02, 0.01),
    estimate=("focal", "k1", "k2", "cx", "cy", "aspect", "p1", "p2", "k3", "k4", "k5", "k6"),
)
_WIDE = replace(RIGHT, fx=420.0, fy=421.0, estimate=("k1", "k2", "k3", "k4", "aspect", "cx"))
_LENSES = [(LEFT, RIGHT), (_K3, _WIDE), (_RATIONAL, replace(RIGHT, model="pinhole", distortion=(), estimate=()))]
_IDS = ["brown-fisheye", "k3-wide", "rational-pinhole"]


def _away(block: Block, state: State, seed: int, size: float) -> State:
    rng = np.random.default_rng(seed)
    count = Layout.of(block).size
    return moved(block, state, size * rng.normal(size=count), size * rng.normal(size=block.points.shape))


def _of_terms(terms: list[Term], size: int) -> tuple[Array, Array]:
    """Normal matrix and gradient of constraints."""
    matrix, gradient = np.zeros((size, size)), np.zeros(size)
    for term in terms:
        for k in range(len(term.residual)):
            jacobian = np.zeros((term.residual.shape[1], size))
            for first, by in term.columns:
                if first[k] >= 0:
                    jacobian[:, first[k] : first[k] + by.shape[2]] += by[k]
            matrix += jacobian.T @ jacobian
            gradient += jacobian.T @ term.residual[k]
    return matrix, gradient


def _of_observations(block: Block, state: State) -> tuple[Array, Array]:
    """Normal matrix and gradient of image observations: stations, border, then all points that are not kept."""
    layout, obs, views = Layout.of(block), block.observations, block.views(state)
    lin = linearize(views, obs.view, state.points[obs.point])
    residual = (lin.pixel - obs.pixel) / obs.sigma_px[:, None]
    shown = np.isfinite(residual).all(axis=1)
    in_cam = views.to_cam(obs.view, state.points[obs.point])
    eliminated = np.cumsum(layout.kept_point < 0) - 1
    size = layout.size + 3 * int((layout.kept_point < 0).sum())
    matrix, gradient = np.zeros((size, size)), np.zeros(size)
    for i in np.flatnonzero(shown):
        image, point = obs.view[i], obs.point[i]
        mounting, calibration = int(block.mounting[image]), int(block.calibration[image])
        jacobian = np.zeros((2, size))
        station = 6 * int(block.station[image])
        jacobian[:, station : station + 6] = lin.by_pose[i] @ state.rig_from_cam[mounting].inverse().adjoint()
        if (first := layout.mounting[mounting]) >= 0:
            first += 6 * layout.stations
            jacobian[:, first : first + 6] = lin.by_pose[i]
        if (first := layout.calibration[calibration]) >= 0:
            names = block.calibrations[calibration].camera.estimate
            first += 6 * layout.stations
            by = intrinsic_derivatives(state.cameras[calibration], in_cam[i : i + 1], names)[0]
            jacobian[:, first : first + len(names)] = by
        kept = layout.kept_point[point]
        first = 6 * layout.stations + kept if kept >= 0 else layout.size + 3 * eliminated[point]
        jacobian[:, first : first + 3] = lin.by_point[i]
        jacobian /= obs.sigma_px[i]
        matrix += jacobian.T @ jacobian
        gradient += jacobian.T @ residual[i]
    return matrix, gradient


def _same(ours: tuple[Array, Array], theirs: tuple[Array, Array]) -> None:
    scale = np.sqrt(np.maximum(np.diag(ours[0]), 1e-300))
    np.testing.assert_allclose(ours[0] / scale / scale[:, None], theirs[0] / scale / scale[:, None], atol=1e-9)
    np.testing.assert_allclose(ours[1] / scale, theirs[1] / scale, atol=1e-9 * max(1.0, np.abs(ours[1] / scale).max()))


def _unobserved(block: Block) -> Block:
    return replace(block, observations=Observations.joined([]), point_priors=PointPriors.none())


@pytest.mark.parametrize(("seed", "size"), [(0, 1e-6), (1, 0.02), (2, 0.2)])
def test_constraints_are_those_of_gtsam(seed: int, size: float) -> None:
    right = replace(RIGHT, estimate=("focal", "aspect", "cx", "cy", "k1", "k2"))
    block = _unobserved(rig_block(seed, (LEFT, right)).block)
    state, count = _away(block, block.start(), seed, size), Layout.of(block).size
    terms = constraint_terms(block, state)
    built = BlockGraph(block, state)
    matrix, gradient = built.normal_equations()
    assert len({t.name for t in terms}) == 8
    assert not matrix[count:].any()
    _same(_of_terms(terms, count), (matrix[:count, :count], gradient[:count]))
    cost = 0.5 * sum(float(np.sum(t.residual**2)) for t in terms)
    assert built.graph.error(built.values) == pytest.approx(cost, rel=1e-9)


@pytest.mark.parametrize("cameras", _LENSES, ids=_IDS)
def test_observations_are_those_of_gtsam(cameras: tuple[Camera, Camera]) -> None:
    world = rig_block(3, cameras)
    block = replace(world.block, distances=Distances.none())
    only = replace(
        _unobserved(block),
        observations=block.observations,
        pose_priors=block.pose_priors.take(np.zeros(3, bool)),
        position_priors=block.position_priors.take(np.zeros(12, bool)),
        relative_poses=block.relative_poses.take(np.zeros(2, bool)),
        mountings=tuple(
            m if m.information is None else replace(m, information=np.zeros((6, 6))) for m in block.mountings
        ),
        calibrations=tuple(Calibration(c.camera, 0.0 * c.information) for c in block.calibrations),
        antennas=(),
        drift_information=np.zeros((0, 3, 3)),
    )
    state = _away(only, replace(world.truth, lever_arms_m=np.zeros((0, 3)), drift_m=np.zeros((0, 3))), 4, 1e-3)
    built = BlockGraph(only, state)
    assert built.shown.sum() > 250
    _same(_of_observations(only, state), built.normal_equations())
    if cameras[1].fx < 500:
        depth = only.views(state).to_cam(only.observations.view, state.points[only.observations.point])[:, 2]
        assert (depth[built.shown] < 0).sum() > 5


@pytest.mark.parametrize("free", [False, True], ids=["held mountings", "free mounting"])
@pytest.mark.parametrize("model", ["brown", "pinhole"])
def test_native_factors_and_functions_are_the_same(model: str, free: bool) -> None:
    left = LEFT if model == "brown" else replace(LEFT, model="pinhole", distortion=(), estimate=())
    block = rig_block(5, (replace(left, estimate=()), replace(RIGHT, estimate=()))).block
    if not free:
        block = replace(block, mountings=tuple(replace(m, information=None) for m in block.mountings))
    state = block.start()
    native, functions = BlockGraph(block, state), BlockGraph(block, state, native=False)
    counts = [
        sum(isinstance(g.graph.at(i), gtsam.CustomFactor) for i in range(g.graph.size())) for g in (native, functions)
    ]
    assert counts[1] - counts[0] > 250
    _same(functions.normal_equations(), native.normal_equations())
    assert functions.graph.error(functions.values) == pytest.approx(native.graph.error(native.values), rel=1e-12)


def test_derivatives_by_mounting_and_camera_are_those_of_gtsams_own_self_calibration() -> None:
    camera = replace(LEFT, estimate=("focal", "aspect", "k1", "p2", "cx"))
    block = rig_block(0).block
    pose, mounting = (gtsam.Pose3(p.matrix()) for p in (block.world_from_rig[2], block.mountings[1].rig_from_cam))
    in_cam = np.array([0.6, -0.4, 7.0])
    point, pixel = pose.compose(mounting).transformFrom(in_cam), np.array([1500.0, 1000.0])
    noise = gtsam.noiseModel.Isotropic.Sigma(2, 0.5)
    ours_values, theirs_values = gtsam.Values(), gtsam.Values()
    for values in (ours_values, theirs_values):
        values.insert(0, pose)
        values.insert(1, mounting)
        values.insert(3, point)
    ours_values.insert(2, np.zeros(5))
    calibration = native_calibration(camera)
    assert isinstance(calibration, gtsam.Cal3DS2)
    theirs_values.insert(2, calibration)
    ours = custom_observation(pixel, noise, 0, 1, Lens(camera, 2), 3).linearize(ours_values).jacobian()
    theirs = gtsam_unstable.ProjectionFactorPPPCCal3DS2(pixel, noise, 0, 1, 3, 2).linearize(theirs_values)
    matrix, right = theirs.jacobian()
    order = [*range(12), *range(15, 24), *range(12, 15)]  # its calibration comes last
    if theirs.keys()[2] == 2:
        order = list(range(24))
    matrix = matrix[:, order]
    chain = np.zeros((9, 5))  # of fx, fy, skew, cx, cy, k1, k2, p1, p2
    chain[[0, 1], 0] = camera.fx, camera.fy
    chain[1, 1], chain[5, 2], chain[8, 3], chain[3, 4] = camera.fy, 1.0, 1.0, camera.fx
    expected = np.concatenate([matrix[:, :12], matrix[:, 12:21] @ chain, matrix[:, 21:]], axis=1)
    np.testing.assert_allclose(ours[0], expected, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(ours[1], right, rtol=1e-9)


def test_the_whole_block_is_solved_and_its_errors_fit_its_covariance() -> None:
    """Errors of all reduced unknowns at once: their weighted squares are chi-square of as many degrees of freedom."""
    statistic, freedom = 0.0, 0
    for seed in range(4):
        world = rig_block(seed)
        found = solve_with_gtsam(world.block)
        assert found.converged
        layout = Layout.of(world.block)
        matrix, gradient = BlockGraph(world.block, found.state).reduced()
        assert np.abs(np.linalg.solve(matrix, gradient)).max() < 1e-6
        error = _errors(world.block, found.state, world.truth)
        statistic, freedom = statistic + float(error @ matrix @ error), freedom + layout.size
    assert abs(statistic / freedom - 1.0) < 4.0 * np.sqrt(2.0 / freedom)


def _errors(block: Block, found: State, truth: State) -> Array:
    """Steps (n,) of the reduced unknowns from the solution to the truth."""
    kept = np.flatnonzero(Layout.of(block).kept_point >= 0)
    return np.concatenate(
        [
            found.world_from_rig.local(truth.world_from_rig).ravel(),
            found.rig_from_cam[1].local(truth.rig_from_cam[1]),
            *(t.steps_since(f, f.estimate) for t, f in zip(truth.cameras, found.cameras, strict=True)),
            (truth.lever_arms_m - found.lever_arms_m)[1],
            (truth.drift_m - found.drift_m).ravel(),
            (truth.points - found.points)[kept].ravel(),
        ]
    )


def test_covariances_are_those_of_marginals() -> None:
    world = rig_block(1)
    built = BlockGraph(world.block, world.truth)
    covariances = np.linalg.inv(built.reduced()[0])
    theirs = built.station_covariances()
    for i in range(6):
        np.testing.assert_allclose(covariances[6 * i : 6 * i + 6, 6 * i : 6 * i + 6], theirs[i], rtol=1e-6, atol=1e-12)


def test_a_loss_bounds_what_a_blunder_does() -> None:
    world = rig_block(2, (replace(LEFT, estimate=()), replace(RIGHT, estimate=())))
    block = replace(world.block, mountings=tuple(replace(m, information=None) for m in world.block.mountings))
    pixel = block.observations.pixel.copy()
    pixel[::40] += 60.0
    blundered = replace(block, observations=replace(block.observations, pixel=pixel))
    clean = solve_with_gtsam(block).state
    least, robust = (
        solve_with_gtsam(blundered, clean, cauchy=loss, max_iterations=15).state.world_from_rig
        for loss in (None, {"image observations": 2.0})
    )
    moved_by = [float(np.abs(clean.world_from_rig.local(found)[:, 3:]).max()) for found in (least, robust)]
    assert moved_by[1] < 0.1 * moved_by[0]


def test_a_loss_is_that_of_cauchy_and_weights_by_its_derivative() -> None:
    world = rig_block(2)
    scale, block = 2.0, world.block
    obs = block.observations
    state = _away(block, world.truth, 1, 3e-3)
    plain, robust = BlockGraph(block, state), BlockGraph(block, state, {"image observations": scale})
    projected = block.views(state).project(obs.view, state.points[obs.point])
    square = np.sum(((projected - obs.pixel) / obs.sigma_px[:, None]) ** 2, axis=1)
    expected = 0.5 * np.sum(scale**2 * np.log1p(square / scale**2) - square)
    costs = [g.graph.error(g.values) for g in (plain, robust)]
    assert costs[1] - costs[0] == pytest.approx(expected, rel=1e-9)
    weighted = replace(obs, sigma_px=obs.sigma_px * np.sqrt(1.0 + square / scale**2))
    _same(BlockGraph(replace(block, observations=weighted), state).normal_equations(), robust.normal_equations())
