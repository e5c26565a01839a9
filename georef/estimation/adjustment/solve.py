"""The factor graph of a problem and its solution by GTSAM's Levenberg-Marquardt."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import partial

import gtsam
import numpy as np

from georef.estimation.adjustment.problem import Problem, control_observations
from georef.estimation.adjustment.projection_factors import add_observations
from georef.geometry.projection import Views
from georef.geometry.rigid import Array, Rigid3
from georef.geometry.triangulation import triangulate

_STEP_TOLERANCE = 1e-7
_LAMBDA_INITIAL = 1e-6
_KNOWN_DEPTH = 0.1  # of its distance: a control point whose marks say less starts at its coordinates


@dataclass(frozen=True, eq=False)
class Solution:
    world_from_cams: tuple[Rigid3, ...]
    points: Array  # (P, 3)
    control_points: Array  # (C, 3) adjusted
    iterations: int
    converged: bool


def solve(problem: Problem, *, cauchy_scale: float | None, max_iterations: int) -> Solution:
    """Minimises the weighted squares of all residuals; image observations and priors with a Cauchy loss if a scale
    (in sigmas) is given.

    Plain integer keys: images, then points, then control points (bulk insertion passes keys as floats).
    """
    images, points = len(problem.image_ids), len(problem.points)
    graph = gtsam.NonlinearFactorGraph()
    robust = partial(_robust, cauchy_scale=cauchy_scale)
    add_observations(graph, problem.cameras, problem.observations, images, robust)
    add_observations(graph, problem.cameras, control_observations(problem), images + points, robust)
    _add_pose_priors(graph, problem, cauchy_scale)
    gcps = problem.gcps
    _add_point_priors(graph, images + gcps.point, gcps.position, gcps.cov, cauchy_scale)
    control = problem.control
    keys = images + points + np.arange(len(control))
    _add_point_priors(graph, keys, [c.point_in_world for c in control], [c.cov for c in control], cauchy_scale)
    values = _initial_values(problem, images, points)
    return _optimize(graph, values, problem, max_iterations)


def _add_pose_priors(graph: gtsam.NonlinearFactorGraph, problem: Problem, cauchy_scale: float | None) -> None:
    for index, given in problem.orientations.items():
        graph.add(gtsam.PriorFactorPose3(index, _pose3(given.world_from_cam), _gaussian(given.cov)))
    for index, prior in problem.pose_priors.items():
        model = _robust(_gaussian(prior.cov), cauchy_scale)
        graph.add(gtsam.PriorFactorPose3(index, _pose3(prior.world_from_cam), model))
    for index, prior in problem.position_priors.items():
        graph.add(gtsam.GPSFactor(index, prior.position_in_world, _robust(_gaussian(prior.cov), cauchy_scale)))


def _add_point_priors(
    graph: gtsam.NonlinearFactorGraph,
    keys: Iterable[int],
    positions: Iterable[Array],
    covs: Iterable[Array],
    cauchy_scale: float | None,
) -> None:
    for key, position, cov in zip(keys, positions, covs, strict=True):
        graph.add(gtsam.PriorFactorPoint3(int(key), position, _robust(_gaussian(cov), cauchy_scale)))


def _gaussian(cov: Array) -> gtsam.noiseModel.Gaussian:
    return gtsam.noiseModel.Gaussian.Covariance(cov)


def _robust(model: gtsam.noiseModel.Base, cauchy_scale: float | None) -> gtsam.noiseModel.Base:
    if cauchy_scale is None:
        return model
    return gtsam.noiseModel.Robust.Create(gtsam.noiseModel.mEstimator.Cauchy.Create(cauchy_scale), model)


def _initial_values(problem: Problem, images: int, points: int) -> gtsam.Values:
    values = gtsam.Values()
    for index, pose in enumerate(problem.world_from_cams):
        values.insert(index, _pose3(pose))
    for index, point in enumerate(problem.points):
        values.insert(images + index, point)
    for index, position in enumerate(control_start(problem)):
        values.insert(images + points + index, position)
    return values


def control_start(problem: Problem) -> Array:
    """Where control points (C, 3) start: intersected from their marks, so that a robust loss can tell wrong coordinates
    from wrong marks; at their coordinates where the marks do not say."""
    marks, given = control_observations(problem), np.array([c.point_in_world for c in problem.control]).reshape(-1, 3)
    if not len(marks):
        return given
    found = triangulate(problem.views, marks.point, marks.view, marks.pixel, marks.sigma_px, len(given))
    sigma = np.sqrt(np.trace(np.nan_to_num(found.cov), axis1=1, axis2=2))
    nearest = np.full(len(given), np.inf)
    np.minimum.at(
        nearest, marks.point, np.linalg.norm(found.points[marks.point] - problem.views.centres[marks.view], axis=1)
    )
    known = np.isfinite(found.points).all(axis=1) & (sigma < _KNOWN_DEPTH * nearest)
    return np.where(known[:, None], found.points, given)


def _optimize(
    graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, problem: Problem, max_iterations: int
) -> Solution:
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setlambdaInitial(_LAMBDA_INITIAL)
    parameters.setLinearSolverType("MULTIFRONTAL_CHOLESKY")
    optimizer = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters)
    images, points = len(problem.image_ids), len(problem.points)
    before = _poses(values, images)
    converged = False
    for _ in range(max_iterations):
        optimizer.iterate()
        after = _poses(optimizer.values(), images)
        # LM's own test stops early along weak datum modes: the largest change of a pose decides.
        step = float(np.abs(after - before).max(initial=0.0))  # m, and rad to first order
        before = after
        if step < _STEP_TOLERANCE:
            converged = True
            break
    solved = optimizer.values()
    return Solution(
        world_from_cams=tuple(Rigid3.from_matrix(matrix) for matrix in before),
        points=np.array([solved.atPoint3(images + i) for i in range(points)]).reshape(-1, 3),
        control_points=np.array([solved.atPoint3(images + points + i) for i in range(len(problem.control))]).reshape(
            -1, 3
        ),
        iterations=int(optimizer.iterations()),
        converged=converged,
    )


def _poses(values: gtsam.Values, images: int) -> Array:
    """world_from_cam of all images (M, 4, 4)."""
    return np.array([values.atPose3(index).matrix() for index in range(images)]).reshape(-1, 4, 4)


def _pose3(pose: Rigid3) -> gtsam.Pose3:
    return gtsam.Pose3(pose.matrix())


def solution_views(problem: Problem, solution: Solution) -> Views:
    return Views.of(solution.world_from_cams, problem.cameras)
