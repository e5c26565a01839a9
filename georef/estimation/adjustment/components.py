"""Variance components: how large the residuals of each group are against what their sigmas promise.

sigma^2 = v' P v / r with the group's redundancy r = n - tr(A Qxx A' P), as in Foerstner's simplified estimator; the
redundancies add up to that of the whole adjustment.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from georef.estimation.adjustment.posterior import Posterior
from georef.estimation.adjustment.problem import Problem, control_observations
from georef.estimation.adjustment.solve import Solution, solution_views
from georef.geometry.rigid import Array

_LEAST_REDUNDANCY = 3.0


@dataclass(frozen=True)
class Component:
    """One group of observations."""

    observations: int  # number of scalar observations
    redundancy: float
    squares: float  # v' P v

    @property
    def factor(self) -> float | None:
        """Estimated over stated 1-sigma; None where the redundancy is too small to tell."""
        return float(np.sqrt(self.squares / self.redundancy)) if self.redundancy >= _LEAST_REDUNDANCY else None

    @property
    def factor_sigma(self) -> float | None:
        """1-sigma of the factor, for normal errors: s / sqrt(2 r)."""
        return self.factor / float(np.sqrt(2.0 * self.redundancy)) if self.factor is not None else None


def variance_components(problem: Problem, solution: Solution, posterior: Posterior) -> dict[str, Component]:
    """Components of the groups that are there: image_observations, reference_position, reference_rotation, gnss,
    pose_priors, control_points."""
    groups: dict[str, Component] = {}
    _orientation_groups(groups, problem, solution, posterior)
    _prior_groups(groups, problem, solution, posterior)
    groups["image_observations"] = _image_group(problem, solution, groups)
    return groups


def _orientation_groups(
    groups: dict[str, Component], problem: Problem, solution: Solution, posterior: Posterior
) -> None:
    if not problem.orientations:
        return
    squares, trace = np.zeros(2), np.zeros(2)
    for index, given in problem.orientations.items():
        pose = solution.world_from_cams[index]
        offset = pose.translation - given.world_from_cam.translation
        turn = given.world_from_cam.local(pose)[:3]
        cov = posterior.pose(index)
        position_cov = pose.rotation @ cov[3:, 3:] @ pose.rotation.T
        squares += [np.sum((offset / given.position_sigma_m) ** 2), np.sum((turn / given.rotation_sigma_rad) ** 2)]
        trace += [
            np.sum(np.diag(position_cov) / given.position_sigma_m**2),
            np.sum(np.diag(cov)[:3] / given.rotation_sigma_rad**2),
        ]
    count = 3 * len(problem.orientations)
    groups["reference_position"] = Component(count, count - float(trace[0]), float(squares[0]))
    groups["reference_rotation"] = Component(count, count - float(trace[1]), float(squares[1]))


def _prior_groups(groups: dict[str, Component], problem: Problem, solution: Solution, posterior: Posterior) -> None:
    rows: dict[str, list[tuple[Array, Array, Array]]] = {"pose_priors": [], "gnss": [], "control_points": []}
    for index, prior in problem.pose_priors.items():
        residual = prior.world_from_cam.local(solution.world_from_cams[index])
        rows["pose_priors"].append((residual, prior.cov, posterior.pose(index)))
    for index, prior in problem.position_priors.items():
        pose = solution.world_from_cams[index]
        fitted = pose.rotation @ posterior.pose(index)[3:, 3:] @ pose.rotation.T
        rows["gnss"].append((pose.translation - prior.position_in_world, prior.cov, fitted))
    for index, point in enumerate(problem.control):
        residual = solution.control_points[index] - point.point_in_world
        rows["control_points"].append((residual, point.cov, posterior.control_points[index]))
    for name, entries in rows.items():
        if entries:
            count = sum(len(residual) for residual, _, _ in entries)
            squares = sum(float(r @ np.linalg.solve(cov, r)) for r, cov, _ in entries)
            trace = sum(float(np.trace(np.linalg.solve(cov, fitted))) for _, cov, fitted in entries)
            groups[name] = Component(count, count - trace, squares)


def _image_group(problem: Problem, solution: Solution, others: dict[str, Component]) -> Component:
    """Keypoints, automatic GCPs (condensed keypoints of the reference) and marks: the rest of the redundancy."""
    views = solution_views(problem, solution)
    squares, count = 0.0, 0
    for obs, points in (
        (problem.observations, solution.points),
        (control_observations(problem), solution.control_points),
    ):
        if len(obs):
            residual = views.project(obs.view, points[obs.point]) - obs.pixel
            squares += float(np.sum(np.square(residual / obs.sigma_px[:, None])))
            count += 2 * len(obs)
    gcps = problem.gcps
    off = solution.points[gcps.point] - gcps.position
    squares += float(np.einsum("ki,kij,kj->", off, np.linalg.inv(gcps.cov), off))
    count += 3 * len(gcps)
    unknowns = 6 * len(problem.image_ids) + 3 * len(problem.points) + 3 * len(problem.control)
    total = count + sum(group.observations for group in others.values()) - unknowns
    return Component(count, total - sum(group.redundancy for group in others.values()), squares)
