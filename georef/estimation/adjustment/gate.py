"""Gates: which observations and priors contradict the rest, by chi-square tests of their residuals.

The statistic of a group is r' Qvv^- r with Qvv = S - A Qxx A' and the rank of Qvv as degrees of freedom: testing
against the prior covariance alone is too lenient where redundancy is low.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from georef.estimation.adjustment.posterior import Posterior
from georef.estimation.adjustment.problem import Problem
from georef.estimation.adjustment.solve import Solution, solution_views
from georef.geometry.covariance import position_cov_in_world
from georef.geometry.projection import linearize
from georef.geometry.rigid import Array
from georef.geometry.triangulation import segment_sum

_RANK_TOLERANCE = 0.05
_MEDIAN = np.array([np.nan, *chi2.ppf(0.5, [1, 2])])  # of chi-square, by degrees of freedom


@dataclass(frozen=True)
class GateCount:
    """How many of a group were tested, and which were rejected."""

    tested: int = 0
    rejected: int = 0
    rejected_ids: tuple[str, ...] = field(default=())

    def then(self, later: GateCount) -> GateCount:
        """Both rounds of a gate together: those of the first that the later one rejected as well."""
        return GateCount(self.tested, self.rejected + later.rejected, self.rejected_ids + later.rejected_ids)


def residual_scale(problem: Problem, solution: Solution) -> float:
    """How large image residuals are against their sigmas, by the median: wrong observations do not count."""
    return _Tested.at(problem, solution).scale if len(problem.observations) else 1.0


def variance_ratios(problem: Problem, solution: Solution) -> Array:
    """Squared residuals of the image observations (n,) against their variances, of median 1 where the sigmas are true.

    NaN where an observation is not checked by others.
    """
    return _Tested.at(problem, solution).variance_ratio


def gate_observations(problem: Problem, solution: Solution, probability: float) -> tuple[Problem, int]:
    """The problem without image observations and automatic GCPs that contradict their point, and how many were dropped.

    Qvv holds the poses at their solution; the scale of the residuals is taken from their median.
    """
    obs, gcps = problem.observations, problem.gcps
    if not len(obs):
        return problem, 0
    tested = _Tested.at(problem, solution)
    limit = chi2.ppf(probability, np.array([1, 1, 2, 3])) * tested.scale**2
    good = (tested.statistic <= limit[tested.rank]) & tested.usable
    whitener = np.linalg.inv(np.linalg.cholesky(gcps.cov))
    off = np.einsum("kij,kj->ki", whitener, solution.points[gcps.point] - gcps.position)
    cofactor = np.eye(3) - whitener @ tested.point_inverse[gcps.point] @ np.swapaxes(whitener, 1, 2)
    statistic, rank = _statistic(off, cofactor)
    gated = problem.with_poses(solution.world_from_cams, solution.points).restricted(good, statistic <= limit[rank])
    return gated, len(obs) - len(gated.observations)


@dataclass(frozen=True, eq=False)
class _Tested:
    """The statistics of all image observations against their points, poses held at their solution."""

    statistic: Array  # (n,)
    rank: NDArray[np.int64]  # (n,)
    usable: NDArray[np.bool_]  # (n,) in front of the camera, and of a point that is determined
    variance_ratio: Array  # (n,) statistic over its median where the sigmas are true; NaN where unchecked
    scale: float  # of the residuals, by the median
    point_inverse: Array  # (P, 3, 3)

    @staticmethod
    def at(problem: Problem, solution: Solution) -> _Tested:
        obs, count = problem.observations, len(problem.points)
        lin = linearize(solution_views(problem, solution), obs.view, solution.points[obs.point])
        behind = ~np.isfinite(lin.pixel).all(axis=1)
        by_point = np.nan_to_num(lin.by_point) / obs.sigma_px[:, None, None]
        residual = np.nan_to_num((lin.pixel - obs.pixel) / obs.sigma_px[:, None], nan=1e6)
        normal = segment_sum(np.swapaxes(by_point, 1, 2) @ by_point, obs.point, count)
        normal = normal + problem.gcps.information(count)
        singular = np.linalg.cond(normal) > 1e12
        normal[singular] = np.eye(3)
        inverse: Array = np.linalg.inv(normal).astype(np.float64)
        statistic, rank = _statistic(residual, np.eye(2) - by_point @ inverse[obs.point] @ np.swapaxes(by_point, 1, 2))
        checked = (rank > 0) & ~behind
        ratio = np.where(checked, statistic / _MEDIAN[rank], np.nan)
        scale2 = float(np.nanmedian(ratio)) if checked.any() else 1.0
        scale = float(np.sqrt(max(scale2, 1e-12)))
        return _Tested(statistic, rank, ~behind & ~singular[obs.point], ratio, scale, inverse)


def gate_priors(
    problem: Problem, solution: Solution, cofactors: Posterior, posterior: Posterior, probability: float
) -> tuple[Problem, dict[str, GateCount]]:
    """The problem without pose priors, position priors and control points that contradict the rest.

    `posterior` has what the references' own errors add, which a prior may differ by as well.
    """
    shared = Posterior(posterior.poses - cofactors.poses, posterior.control_points - cofactors.control_points)
    gates: dict[str, GateCount] = {}
    bad_poses = []
    for index, prior in problem.pose_priors.items():
        residual = prior.world_from_cam.local(solution.world_from_cams[index])
        if not _consistent(residual, prior.cov + shared.pose(index), cofactors.pose(index), probability):
            bad_poses.append(index)
    bad_positions = []
    for index, prior in problem.position_priors.items():
        pose = solution.world_from_cams[index]
        fitted, more = (position_cov_in_world(pose, part.pose(index)) for part in (cofactors, shared))
        if not _consistent(pose.translation - prior.position_in_world, prior.cov + more, fitted, probability):
            bad_positions.append(index)
    bad_control = [
        index
        for index, point in enumerate(problem.control)
        if not _consistent(
            solution.control_points[index] - point.point_in_world,
            point.cov + shared.control_points[index],
            cofactors.control_points[index],
            probability,
        )
    ]
    names = problem.image_ids
    gates["pose_priors"] = _count(len(problem.pose_priors), [names[i] for i in bad_poses])
    gates["gnss"] = _count(len(problem.position_priors), [names[i] for i in bad_positions])
    gates["control_points"] = _count(len(problem.control), [problem.control[i].point_id for i in bad_control])
    kept = replace(
        problem,
        pose_priors={i: p for i, p in problem.pose_priors.items() if i not in bad_poses},
        position_priors={i: p for i, p in problem.position_priors.items() if i not in bad_positions},
        control=tuple(p for i, p in enumerate(problem.control) if i not in bad_control),
    )
    return kept, gates


def worst_orientation(problem: Problem, solution: Solution, cofactors: Posterior, probability: float) -> int | None:
    """The given exterior orientation that contradicts the rest most, by its index; None if all pass."""
    statistics = {}
    for index, given in problem.orientations.items():
        residual = given.world_from_cam.local(solution.world_from_cams[index])
        statistic, rank = _prior_statistic(residual, given.cov, cofactors.pose(index))
        if rank > 0 and statistic > chi2.ppf(probability, rank):
            statistics[index] = statistic
    return max(statistics, key=lambda index: statistics[index]) if statistics else None


def _count(tested: int, rejected: list[str]) -> GateCount:
    return GateCount(tested, len(rejected), tuple(rejected))


def _consistent(residual: Array, prior_cov: Array, fitted_cov: Array, probability: float) -> bool:
    """Whether r' (S - A Qxx A')^- r stays below the chi-square limit of its rank."""
    statistic, rank = _prior_statistic(residual, prior_cov, fitted_cov)
    return bool(rank == 0 or statistic <= chi2.ppf(probability, rank))


def _prior_statistic(residual: Array, prior_cov: Array, fitted_cov: Array) -> tuple[float, int]:
    whitener = np.linalg.inv(np.linalg.cholesky(prior_cov))
    cofactor = np.eye(len(residual)) - whitener @ fitted_cov @ whitener.T
    statistic, rank = _statistic((whitener @ residual)[None], cofactor[None])
    return float(statistic[0]), int(rank[0])


def _statistic(residual: Array, cofactor: Array) -> tuple[Array, NDArray[np.int64]]:
    """r' Q^- r (n,) of whitened residuals (n, k) and cofactors (n, k, k), and the ranks (n,)."""
    if not len(residual):
        return np.zeros(0), np.zeros(0, np.int64)
    values, vectors = np.linalg.eigh(cofactor)
    usable = values > _RANK_TOLERANCE
    along = np.einsum("nki,nk->ni", vectors, residual)
    statistic = np.where(usable, np.square(along) / np.where(usable, values, 1.0), 0.0).sum(axis=1)
    return statistic, usable.sum(axis=1)
