"""Posterior covariances: against gtsam.Marginals, and what the references' errors add against Monte Carlo."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from georef.estimation.adjustment.posterior import posterior, posteriors
from georef.estimation.adjustment.solve import Solution, solve

from georef.errors import GeorefError
from georef.estimation.adjustment.problem import Problem, control_observations
from georef.geometry.rigid import Array
from tests.worlds.blocks import Block, block, control, gnss, orientations, pose_priors, without_gcps


def solved(problem: Problem) -> Solution:
    solution = solve(problem, cauchy_scale=None, max_iterations=30)
    assert solution.converged
    return solution


def marginals(problem: Problem, solution: Solution) -> gtsam.Marginals:
    """The same problem built factor by factor, without any of the house's code for graphs."""
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    images, points = len(problem.image_ids), len(problem.points)
    for first, obs in ((images, problem.observations), (images + points, control_observations(problem))):
        for point, view, pixel, sigma in zip(obs.point, obs.view, obs.pixel, obs.sigma_px, strict=True):
            camera = problem.cameras[view]
            lens = gtsam.Cal3DS2(camera.fx, camera.fy, 0.0, camera.cx, camera.cy, *camera.distortion)
            noise = gtsam.noiseModel.Isotropic.Sigma(2, sigma)
            graph.add(gtsam.GenericProjectionFactorCal3DS2(pixel, noise, int(view), int(first + point), lens))
    full = gtsam.noiseModel.Gaussian.Covariance
    gcps = problem.gcps
    for point, position, cov in zip(gcps.point, gcps.position, gcps.cov, strict=True):
        graph.add(gtsam.PriorFactorPoint3(int(images + point), position, full(cov)))
    for i, given in problem.orientations.items():
        graph.add(gtsam.PriorFactorPose3(i, gtsam.Pose3(given.world_from_cam.matrix()), full(given.cov)))
    for i, prior in problem.pose_priors.items():
        graph.add(gtsam.PriorFactorPose3(i, gtsam.Pose3(prior.world_from_cam.matrix()), full(prior.cov)))
    for i, prior in problem.position_priors.items():
        graph.add(gtsam.GPSFactor(i, prior.position_in_world, full(prior.cov)))
    for i, pose in enumerate(solution.world_from_cams):
        values.insert(i, gtsam.Pose3(pose.matrix()))
    for i, point in enumerate(solution.points):
        values.insert(images + i, point)
    for i, point in enumerate(problem.control):
        graph.add(gtsam.PriorFactorPoint3(images + points + i, point.point_in_world, full(point.cov)))
        values.insert(images + points + i, solution.control_points[i])
    return gtsam.Marginals(graph, values)


def constrained(kind: str) -> Problem:
    made, rng = block(3, points=60, queries=3), np.random.default_rng(3)
    surveyed, positions = control(made.world, rng, count=4), gnss(made.world, rng, 0.05)
    return {
        "automatic GCPs": lambda: made.problem,
        "everything": lambda: replace(
            made.problem, control=surveyed, position_priors=positions, pose_priors=pose_priors(made.world, rng)
        ),
        "control points and GNSS": lambda: replace(
            without_gcps(made.problem), control=surveyed, position_priors=positions
        ),
        "orientations": lambda: replace(
            without_gcps(made.problem), orientations=orientations(made.world, rng, 0.01, 3e-4)
        ),
    }[kind]()


@pytest.mark.parametrize("kind", ["automatic GCPs", "everything", "control points and GNSS", "orientations"])
def test_cofactors_agree_with_gtsam(kind: str) -> None:
    problem = constrained(kind)
    solution = solved(problem)
    problem = at_solution(problem, solution)
    ours, theirs = posteriors(problem, solution)[0], marginals(problem, solution)
    images, points = len(problem.image_ids), len(problem.points)
    for i in range(images):
        assert relative(ours.pose(i), theirs.marginalCovariance(i)) < 1e-6
    keys = gtsam.KeyVector([0, 2])
    assert relative(ours.joint([0, 2]), theirs.jointMarginalCovariance(keys).fullMatrix()) < 1e-6
    for i in range(len(problem.control)):
        assert relative(ours.control_points[i], theirs.marginalCovariance(images + points + i)) < 1e-6


def at_solution(problem: Problem, solution: Solution) -> Problem:
    """Pose priors without residual: at one, gtsam takes the derivative of Log for the identity, and we do not."""
    poses = solution.world_from_cams
    return replace(
        problem,
        orientations={i: replace(given, world_from_cam=poses[i]) for i, given in problem.orientations.items()},
        pose_priors={i: replace(prior, world_from_cam=poses[i]) for i, prior in problem.pose_priors.items()},
    )


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
    solution = solved(made.problem)
    cofactors, full = posteriors(made.problem, solution)
    added = full.poses - cofactors.poses
    runs = 250
    errors = []
    for _ in range(runs):
        moved = solve(with_moved_gcps(made, rng), cauchy_scale=None, max_iterations=5)
        pairs = zip(solution.world_from_cams, moved.world_from_cams, strict=True)
        errors.append(np.concatenate([before.local(after) for before, after in pairs]))
    values, vectors = np.linalg.eigh(added / np.outer(*[np.sqrt(np.diag(added))] * 2))
    scaled = np.array(errors) / np.sqrt(np.diag(added))
    sample = np.mean(np.square(scaled @ vectors) / values, axis=0)  # variances along the principal axes, of 1 each
    assert np.trace(added) > 0.3 * np.trace(cofactors.poses)
    assert 0.9 < sample.mean() < 1.1, sample
    assert sample.min() > 0.65
    assert sample.max() < 1.4


def test_reference_part_is_symmetric_and_only_where_there_are_gcps() -> None:
    made = block(5, points=60)
    cofactors, full = posteriors(made.problem, solved(made.problem))
    np.testing.assert_array_equal(full.poses, full.poses.T)
    assert np.linalg.eigvalsh(full.poses - cofactors.poses)[0] > -1e-12
    priors = replace(without_gcps(made.problem), pose_priors=pose_priors(made.world, np.random.default_rng(5)))
    cofactors, full = posteriors(priors, solved(priors))
    np.testing.assert_array_equal(full.poses, cofactors.poses)


def test_no_datum_is_an_error_that_says_so() -> None:
    problem = without_gcps(block(6, points=60).problem)
    start = Solution(problem.world_from_cams, problem.points, np.zeros((0, 3)), 0, False)
    with pytest.raises(GeorefError, match="no datum"):
        posterior(problem, start)


def test_an_image_without_observations_is_named() -> None:
    problem = block(7, points=60).problem
    blind = problem.restricted(problem.observations.view != 2, np.ones(len(problem.gcps), bool))
    start = Solution(blind.world_from_cams, blind.points, np.zeros((0, 3)), 0, False)
    with pytest.raises(GeorefError, match="q2") as caught:
        posterior(blind, start)
    assert "q1" not in str(caught.value)
