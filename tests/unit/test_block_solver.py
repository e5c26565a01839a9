"""The fast way through a block: its normal equations entry by entry, its solution, what it does with lost points."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from georef.errors import GeorefError
from georef.estimation.adjustment.block import (
    Block,
    PointPriors,
    PosePriors,
    PositionPriors,
    RelativePoses,
    State,
)
from georef.estimation.adjustment.equations.eliminate import normal_equations, total_cost
from georef.estimation.adjustment.equations.prepared import Prepared
from georef.estimation.adjustment.gtsam_reference.graph import BlockGraph, solve_with_gtsam
from georef.estimation.adjustment.solver import Iteration, SolverOptions, solve_block
from georef.geometry.camera import Camera
from georef.geometry.rigid import Array
from georef.types.scene import Observations
from tests.worlds.rig_blocks import LEFT, RIGHT, moved, rig_block

_RATIONAL = replace(
    LEFT,
    model="rational",
    distortion=(0.2, -0.05, 2e-4, -1e-4, 0.01, 0.3, -0.02, 0.01),
    estimate=("focal", "k1", "cx", "cy", "aspect", "p1", "p2", "k3", "k4"),
)
_WIDE = replace(RIGHT, fx=420.0, fy=421.0, estimate=("k1", "k2", "k3", "k4", "aspect", "cx"))
_HELD = replace(LEFT, model="pinhole", distortion=(), estimate=())
_LENSES = {
    "brown-fisheye": (LEFT, RIGHT),
    "rational-wide": (_RATIONAL, _WIDE),
    "held": (_HELD, replace(RIGHT, estimate=())),
}
_LOSSES = {"image observations": 2.0, "pose priors": 3.0, "GNSS positions": 3.0}


def _away(block: Block, state: State, size: float) -> State:
    rng = np.random.default_rng(1)
    count = Prepared.of(block).layout.size
    return moved(block, state, size * rng.normal(size=count), size * rng.normal(size=block.points.shape))


def _difference(found: Array, expected: Array, scale: Array) -> float:
    """Largest difference of matrices or vectors in units of the diagonal."""
    whitened = (found - expected) / (np.outer(scale, scale) if found.ndim == 2 else scale)
    return float(np.abs(whitened).max())


@pytest.mark.parametrize("lenses", _LENSES)
@pytest.mark.parametrize("losses", [{}, _LOSSES], ids=["squares", "cauchy"])
def test_normal_equations_are_those_of_gtsam(lenses: str, losses: dict[str, float]) -> None:
    world = rig_block(0, _LENSES[lenses])
    state = _away(world.block, world.truth, 1e-3)
    found = normal_equations(world.block, state, losses=losses)
    matrix, gradient = BlockGraph(world.block, state, losses or None).reduced()
    scale = np.sqrt(np.diag(matrix))
    assert _difference(found.reduced.dense(), matrix, scale) < 1e-8
    assert _difference(found.reduced.gradient, gradient, scale) < 1e-7 * np.abs(gradient / scale).max()
    cost, hidden = total_cost(world.block, state, losses=losses)
    assert cost == pytest.approx(found.cost, rel=1e-12)
    assert hidden == found.hidden


def test_solution_is_that_of_gtsam() -> None:
    block = rig_block(3).block
    found = solve_block(block)
    expected = solve_with_gtsam(block, max_iterations=20)
    assert found.converged
    assert found.hidden == 0
    assert found.cost == pytest.approx(expected.cost, rel=1e-7)
    off = found.state.world_from_rig.local(expected.state.world_from_rig)
    assert np.abs(off).max() < 1e-5
    assert np.abs(found.state.points - expected.state.points).max() < 1e-4


def test_robust_solution_is_a_minimum_to_gtsam() -> None:
    block = rig_block(3).block
    found = solve_block(block, losses=_LOSSES)
    matrix, gradient = BlockGraph(block, found.state, _LOSSES).reduced()
    assert found.converged
    assert found.cost < solve_block(block).cost
    assert np.abs(gradient / np.sqrt(np.diag(matrix))).max() < 1e-3


def test_errors_are_as_large_as_sigmas_say() -> None:
    """Twice the cost at the solution is chi-squared with the redundancy as degrees of freedom."""
    world = rig_block(5)
    block = world.block
    solution = solve_block(block)
    start, _ = total_cost(block, block.start())
    truth, _ = total_cost(block, world.truth)
    assert solution.cost < truth < start
    constraints = 3 * 6 + 12 * 3 + 2 * 6 + 2 + 2 * 3 + 2 * 2 + 2 * 1 + (6 + 4 + 3 + 3)
    layout = Prepared.of(block).layout
    redundancy = 2 * len(block.observations) + constraints - layout.size - 3 * int((layout.kept_point < 0).sum())
    assert abs(2.0 * solution.cost - redundancy) < 4.0 * np.sqrt(2.0 * redundancy)


def test_order_of_observations_does_not_matter() -> None:
    block = rig_block(0).block
    shuffled = block.observations.take(np.random.default_rng(0).permutation(len(block.observations)))
    state = block.start()
    one = normal_equations(block, state).reduced
    other = normal_equations(replace(block, observations=shuffled), state).reduced
    assert _difference(one.dense(), other.dense(), np.sqrt(np.diag(one.dense()))) < 1e-11
    order = Prepared.of(replace(block, observations=shuffled)).order
    assert np.array_equal(np.sort(order), np.arange(len(order)))


def _added(block: Block, point: Array, views: list[int], pixels: Array) -> Block:
    """The block with another point and its observations."""
    new, count = len(block.points), len(views)
    extra = Observations(
        np.full(count, new), np.array(views), pixels, np.full(count, 0.5), np.full(count, -1, dtype=np.int64)
    )
    points = np.concatenate([block.points, point[None]])
    return replace(block, points=points, observations=Observations.joined([block.observations, extra]))


def test_observations_out_of_sight_take_no_part() -> None:
    """A point behind a camera is counted, and changes nothing."""
    world = rig_block(0, (_HELD, replace(RIGHT, estimate=())))
    block, state = world.block, world.block.start()
    behind = block.world_from_cam(state)[0].apply(np.array([[0.3, 0.1, -5.0]]))[0]
    more = _added(block, behind, [0], np.array([[100.0, 100.0]]))
    before, after = normal_equations(block, state), normal_equations(more, more.start())
    assert (before.hidden, after.hidden, after.undetermined) == (0, 1, 1)
    assert after.cost == before.cost
    assert np.array_equal(after.reduced.dense(), before.reduced.dense())
    assert np.isfinite(after.reduced.gradient).all()
    cost, hidden = total_cost(more, more.start(), hidden_square=50.0)
    assert (cost - before.cost, hidden) == (pytest.approx(25.0), 1)


def test_one_ray_says_nothing() -> None:
    """A point of a single ray is undetermined; its station gains nothing, its residual vanishes."""
    block = rig_block(0, disturbed=0.0).block
    state = block.start()
    point = block.world_from_cam(state)[0].apply(np.array([[0.3, 0.1, 7.0]]))[0]
    more = _added(block, point, [0], np.array([[1700.0, 1000.0]]))
    before, after = normal_equations(block, state), normal_equations(more, more.start())
    assert (before.undetermined, after.undetermined) == (0, 1)
    scale = np.sqrt(np.diag(before.reduced.dense()))
    assert _difference(after.reduced.dense(), before.reduced.dense(), scale) < 1e-8
    solution, plain = solve_block(more), solve_block(block)
    assert solution.cost == pytest.approx(plain.cost, abs=1e-6)


def test_an_interrupted_adjustment_goes_on() -> None:
    block = rig_block(1).block
    seen: list[Iteration] = []
    whole = solve_block(block, on_iteration=seen.append)
    assert [i.number for i in seen] == list(range(1, whole.iterations + 1))
    assert seen[-1].step < 1e-7
    rest = solve_block(block, start=seen[1].state)
    assert rest.iterations < whole.iterations
    assert np.abs(rest.state.world_from_rig.local(whole.state.world_from_rig)).max() < 1e-7
    short = solve_block(block, options=SolverOptions(max_iterations=2))
    assert (short.iterations, short.converged) == (2, False)


def _without_datum(block: Block) -> Block:
    return replace(
        block,
        pose_priors=PosePriors.none(),
        position_priors=PositionPriors.none(),
        point_priors=PointPriors.none(),
        relative_poses=RelativePoses.none(),
        antennas=(),
        drift_information=np.zeros((0, 3, 3)),
    )


def test_a_network_without_datum_is_refused_or_held_by_damping() -> None:
    world = rig_block(0)
    block = _without_datum(world.block)
    with pytest.raises(GeorefError, match="no unique solution"):
        solve_block(block)
    free = solve_block(block, options=SolverOptions(free_gauge=True, cost_tolerance=1e-9))
    assert free.converged
    truth = replace(world.truth, lever_arms_m=np.zeros((0, 3)), drift_m=np.zeros((0, 3)))
    assert free.cost < total_cost(block, truth)[0]


def test_far_off_approximate_values_are_reached() -> None:
    """Damping leads there where a plain step would not: five times the usual errors."""
    near, far = rig_block(2).block, rig_block(2, disturbed=5.0).block
    expected, found = solve_block(near), solve_block(far)
    assert found.converged
    assert found.cost == pytest.approx(expected.cost, rel=1e-6)
    assert found.hidden == 0


def _camera_names() -> set[str]:
    return {camera.model for pair in _LENSES.values() for camera in pair if isinstance(camera, Camera)}


def test_all_lens_models_take_part() -> None:
    assert _camera_names() == {"pinhole", "brown", "fisheye", "rational"}


def test_prepared_for_less_is_as_prepared_anew() -> None:
    """Fewer observations (a point loses all of its own, a prior keeps another), fewer constraints, other sigmas."""
    block = rig_block(2).block
    given = block.point_priors
    alone = np.flatnonzero(~np.isin(np.arange(len(block.points)), given.point))[3]
    kept = np.random.default_rng(0).random(len(block.observations)) < 0.8
    kept &= (block.observations.point != alone) & (block.observations.point != given.point[0])
    less = replace(
        block,
        observations=block.observations.take(kept).scaled(1.3),
        pose_priors=block.pose_priors.take(np.arange(len(block.pose_priors)) > 0),
        point_priors=given.take(np.arange(len(given)) != 1),
    )
    whole = Prepared.of(block)
    ordered = whole.pattern
    found, anew = whole.restricted(less, kept), Prepared.of(less)
    assert found.pattern is ordered
    assert np.array_equal(found.order[np.argsort(found.order)], np.arange(len(less.observations)))
    assert set(found.tracks.point) == set(anew.tracks.point)
    state = _away(less, less.start(), 1e-3)
    one, other = (normal_equations(less, state, prepared=p) for p in (found, anew))
    scale = np.sqrt(np.diag(other.reduced.dense()))
    assert _difference(one.reduced.dense(), other.reduced.dense(), scale) < 1e-11
    assert (one.cost, one.undetermined) == (pytest.approx(other.cost, rel=1e-12), other.undetermined)
    again = solve_block(less, prepared=found).state.world_from_rig
    assert np.abs(again.local(solve_block(less).state.world_from_rig)).max() < 1e-7


def test_prepared_for_fewer_distances_eliminates_their_ends() -> None:
    block = rig_block(2).block
    assert len(block.distances)
    less = replace(block, distances=block.distances.take(np.zeros(len(block.distances), bool)))
    found = Prepared.of(block).restricted(less)
    assert (found.tracks.kept < 0).all()
    assert found.layout.border == Prepared.of(less).layout.border < Prepared.of(block).layout.border
