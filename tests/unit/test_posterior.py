"""Posterior covariances: against gtsam.Marginals, and what the references' errors add against Monte Carlo."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from georef.errors import GeorefError
from georef.estimation.adjustment import block as adjustment
from georef.estimation.adjustment.adjust_block import quality
from georef.estimation.adjustment.gtsam_reference.graph import BlockGraph
from georef.estimation.adjustment.problem import Problem
from georef.estimation.adjustment.solver import SolverOptions, solve_block
from georef.geometry.rigid import Array
from tests.worlds.adjusted import Solved, images_alone
from tests.worlds.blocks import (
    Block,
    block,
    control,
    gnss,
    orientations,
    pose_priors,
    with_orientations,
    without_gcps,
)


def constrained(kind: str) -> adjustment.Block:
    made, rng = block(3, points=60, queries=3), np.random.default_rng(3)
    surveyed, positions = control(made.world, rng, count=4), gnss(made.world, rng, 0.05)
    alone = without_gcps(made.problem)
    if kind == "orientations":
        return with_orientations(images_alone(alone), orientations(made.world, rng, 0.01, 3e-4), range(3))
    return images_alone(
        {
            "automatic GCPs": lambda: made.problem,
            "everything": lambda: replace(
                made.problem, control=surveyed, position_priors=positions, pose_priors=pose_priors(made.world, rng)
            ),
            "control points and GNSS": lambda: replace(alone, control=surveyed, position_priors=positions),
        }[kind]()
    )


@pytest.mark.parametrize("kind", ["automatic GCPs", "everything", "control points and GNSS", "orientations"])
def test_cofactors_agree_with_gtsam(kind: str) -> None:
    whole = constrained(kind)
    state = Solved.of(whole).state
    whole = at_solution(whole, state)
    ours, graph = Solved(whole, state, quality(whole, state)), BlockGraph(whole, state)
    theirs = gtsam.Marginals(graph.graph, graph.values)
    for i in range(len(whole.image_ids)):
        assert relative(ours.quality.cofactors.stations[i], theirs.marginalCovariance(i)) < 1e-6
    joint = theirs.jointMarginalCovariance(gtsam.KeyVector([0, 2])).fullMatrix()
    assert relative(ours.quality.cofactors.joint_stations(np.array([0, 2])), joint) < 1e-6
    for point in whole.point_priors.point:
        expected = theirs.marginalCovariance(graph.variables.point(int(point)))
        assert relative(ours.quality.images.points[point], expected) < 1e-5


def at_solution(whole: adjustment.Block, state: adjustment.State) -> adjustment.Block:
    """Pose priors without residual: at one, gtsam takes the derivative of Log for the identity, and we do not."""
    given = whole.world_from_cam(state).take(whole.pose_priors.image)
    return replace(whole, pose_priors=replace(whole.pose_priors, world_from_cam=given))


def relative(ours: Array, theirs: Array) -> float:
    """The largest difference in units of the standard deviations."""
    sigma = np.sqrt(np.diag(theirs))
    return float(np.abs((ours - theirs) / np.outer(sigma, sigma)).max())


def with_moved_gcps(made: Block, rng: np.random.Generator) -> Problem:
    """The problem as other errors of the reference poses would have made it: all GCPs of a reference move together."""
    gcps = made.problem.gcps
    error = gcps.reference_errors.draw(rng)
    moved = np.einsum("nij,nj->ni", gcps.by_reference_pose, error[gcps.ray_reference])
    position = gcps.position.copy()
    np.add.at(position, gcps.ray_gcp, moved)
    return replace(made.problem, gcps=replace(gcps, position=position))


def test_shared_reference_part_against_monte_carlo() -> None:
    made, rng = block(4, points=80, queries=2), np.random.default_rng(4)
    found = Solved.of(images_alone(made.problem))
    added, few = found.reference_part, SolverOptions(max_iterations=5)
    runs = 150
    errors = []
    for _ in range(runs):
        moved = images_alone(with_moved_gcps(made, rng))
        state = solve_block(moved, options=few, start=found.state).state
        errors.append(found.state.world_from_rig.local(state.world_from_rig).ravel())
    values, vectors = np.linalg.eigh(added / np.outer(*[np.sqrt(np.diag(added))] * 2))
    scaled = np.array(errors) / np.sqrt(np.diag(added))
    sample = np.mean(np.square(scaled @ vectors) / values, axis=0)  # variances along the principal axes, of 1 each
    assert np.trace(added) > 0.3 * np.trace(found.cofactors)
    assert 0.9 < sample.mean() < 1.1, sample
    assert sample.min() > 0.6
    assert sample.max() < 1.5


def test_reference_part_is_symmetric_and_only_where_there_are_gcps() -> None:
    made = block(5, points=60)
    added = Solved.of(images_alone(made.problem)).reference_part
    np.testing.assert_allclose(added, added.T, rtol=1e-12, atol=1e-15)
    assert np.linalg.eigvalsh(added)[0] > -1e-12
    assert np.trace(added) > 0.0
    priors = replace(without_gcps(made.problem), pose_priors=pose_priors(made.world, np.random.default_rng(5)))
    assert Solved.of(images_alone(priors)).quality.references is None


def test_no_datum_is_an_error_that_says_so() -> None:
    whole = images_alone(without_gcps(block(6, points=60).problem))
    with pytest.raises(GeorefError, match="no datum"):
        quality(whole, whole.start())


def test_an_image_without_observations_is_named() -> None:
    problem = block(7, points=60).problem
    blind = problem.restricted(problem.observations.view != 2, np.ones(len(problem.gcps), bool))
    whole = images_alone(blind)
    with pytest.raises(GeorefError, match="q2") as caught:
        quality(whole, whole.start())
    assert "q1" not in str(caught.value)
