"""Least squares of a station problem: Gauss-Newton with the points eliminated, gates, and the joint covariance.

The steps are those of the pose of a single image: Cauchy weights,
a chi-square gate on residuals against their own covariance, a refit without a robust loss. Eliminating a point that has
a position from the references weights its observation as sigma^2 + B C B', as the single image does.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from georef.estimation.reference_map import ReferenceMap
from georef.estimation.station_problem import StationProblem
from georef.estimation.station_system import (
    State,
    System,
    chains,
    inverse_of,
    linearized,
    member_poses,
    mounting_places,
    started,
)
from georef.geometry.covariance import symmetric
from georef.geometry.rigid import Array, Rigid3
from georef.geometry.triangulation import segment_sum

_ITERATIONS, _ROBUST_ITERATIONS = 12, 6
_CONVERGED, _NEARLY = 1e-6, 1e-4  # largest step, rad and m: of a solution, and of the robust one that starts it
_CAUCHY_SCALE = 2.0
_GATE_ROUNDS = 3
_RANK_TOLERANCE = 1e-3  # of the redundancy of an observation: below it, nothing checks it in that direction
_MEDIAN_OF_2D = 1.1774
_SCALE_TOLERANCE = 0.02


@dataclass(frozen=True, eq=False)
class SolvedStations:
    """Stations and mountings with the covariance of their image noise and what reference poses add."""

    problem: StationProblem  # its sigmas as the residuals show them
    state: State
    inliers: NDArray[np.bool_]  # (n,) of the observations
    cofactors: Array  # (U, U) image noise and calibration: against the reference as it is published
    references: NDArray[np.int64]  # (R,) indices in the reference map of those that the points rest on
    gains: Array  # (R, U, 6) of the errors of their poses
    sigma0: float  # a-posteriori over a-priori standard deviation of an observation

    def poses(self) -> list[Rigid3]:
        """world_from_cam (M) of all members."""
        return member_poses(self.problem, self.state)

    def covs(self, reference: ReferenceMap) -> tuple[Array, Array]:
        """Pose covariances (M, 6, 6) of the members: with the errors of the reference, and without them."""
        by_unknowns = chains(self.problem, self.state)
        shared = reference.errors([int(i) for i in self.references]).propagated(self.gains)
        both = (by_unknowns @ cov @ np.swapaxes(by_unknowns, 1, 2) for cov in (self.cofactors + shared, self.cofactors))
        return symmetric(next(both)), symmetric(next(both))


def solve_stations(problem: StationProblem, gate_probability: float = 0.999) -> SolvedStations | None:
    """The stations of a problem, on what passes the gate. None where observations do not fix them."""
    state = started(problem)
    everything = np.ones(len(problem.observations), bool)
    found = _iterate(problem, state, everything, robust=True)
    if found is None:
        return None
    state, inliers = found, everything
    for _ in range(_GATE_ROUNDS):
        gated = _gate(problem, state, inliers, gate_probability)
        if gated is None:
            return None
        gated &= _checked_ties(problem, gated)
        settled = np.array_equal(gated, inliers)
        found = _iterate(problem, state, gated, robust=False)
        if found is None:
            return None
        state, inliers = found, gated
        if settled:
            break
    return _with_covariance(problem, state, inliers)


def _moved(problem: StationProblem, state: State, step: Array, points: Array) -> State:
    rigs = tuple(pose.retract(step[6 * i : 6 * i + 6]) for i, pose in enumerate(state.world_from_rigs))
    cams = list(state.rig_from_cams)
    for index, place in mounting_places(problem).items():
        cams[index] = cams[index].retract(step[place : place + 6])
    return State(rigs, tuple(cams), points)


def _iterate(problem: StationProblem, state: State, selected: NDArray[np.bool_], *, robust: bool) -> State | None:
    """Gauss-Newton on the selected observations, with Cauchy weights at the scale that residuals show where robust."""
    for _ in range(_ROBUST_ITERATIONS if robust else _ITERATIONS):
        weight = selected.astype(float)
        if robust:
            weight = weight * _cauchy(problem, state)
        system = System.at(problem, state, weight)
        inverse = inverse_of(system.normal)
        if inverse is None:
            return None
        step = -inverse @ system.gradient
        back = np.einsum("pik,i->pk", system.mixed, step)
        points = state.points - np.einsum("pij,pj->pi", system.point_inverse, system.point_gradient + back)
        state = _moved(problem, state, step, points)
        if float(np.abs(step).max()) < (_NEARLY if robust else _CONVERGED):
            break
    return state


def _cauchy(problem: StationProblem, state: State) -> Array:
    """Weights (n,): distances of points with a position are those of this position, with its covariance."""
    obs = problem.observations
    points = np.where(problem.free[:, None], state.points, problem.given)
    lin = linearized(problem, state, points)
    by_point = np.nan_to_num(lin.by_point)
    cov = np.square(obs.sigma_px)[:, None, None] * np.eye(2)
    cov = cov + by_point @ problem.prior_cov[obs.point] @ np.swapaxes(by_point, 1, 2)
    residual = np.nan_to_num(lin.pixel - obs.pixel, nan=1e6)
    distance = np.sqrt(np.einsum("ni,ni->n", residual, np.linalg.solve(cov, residual[:, :, None])[:, :, 0]))
    scale = _CAUCHY_SCALE * max(float(np.median(distance)) / _MEDIAN_OF_2D, 1e-6)
    return 1.0 / (1.0 + np.square(distance / scale))


def _gate(
    problem: StationProblem, state: State, inliers: NDArray[np.bool_], probability: float
) -> NDArray[np.bool_] | None:
    """Observations whose residual r passes r' Qvv^+ r / s0^2 <= chi2 of the rank of Qvv; see pnp for a single image."""
    obs, system = problem.observations, System.at(problem, state, inliers.astype(float))
    cofactors = inverse_of(system.normal)
    if cofactors is None:
        return None
    lin = linearized(problem, state, state.points)
    by_point = np.nan_to_num(lin.by_point)
    reduced = system.by_unknown - by_point @ np.swapaxes(system.solved[obs.point], 1, 2)
    fitted = reduced @ cofactors @ np.swapaxes(reduced, 1, 2)
    fitted = fitted + by_point @ system.point_inverse[obs.point] @ np.swapaxes(by_point, 1, 2)
    fitted /= np.square(obs.sigma_px)[:, None, None]
    values, vectors = np.linalg.eigh(np.eye(2) + np.where(inliers[:, None, None], -fitted, fitted))
    checked = values > _RANK_TOLERANCE
    residual = np.nan_to_num(lin.pixel - obs.pixel, nan=1e6) / obs.sigma_px[:, None]
    along = np.einsum("nki,nk->ni", vectors, residual)
    statistic = np.where(checked, np.square(along) / np.where(checked, values, 1.0), 0.0).sum(axis=1)
    rank = checked.sum(axis=1)
    whole = inliers & (rank == 2)
    scale2 = float(np.median(statistic[whole])) / chi2.ppf(0.5, 2) if whole.any() else 1.0
    limit = np.array([0.0, chi2.ppf(probability, 1), chi2.ppf(probability, 2)])[rank]
    return np.asarray(statistic <= max(scale2, 1e-12) * limit)


def _checked_ties(problem: StationProblem, inliers: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Observations (n,) of points with a position, and of free ones that three rays at least still see."""
    obs = problem.observations
    rays = np.bincount(obs.point[inliers], minlength=len(problem.given))
    return ~problem.free[obs.point] | (rays[obs.point] >= 2)


def _with_covariance(problem: StationProblem, state: State, inliers: NDArray[np.bool_]) -> SolvedStations | None:
    """The solution for image noise as large as the residuals show, with its covariance."""
    sigma0 = 1.0
    for _ in range(2):
        factor = _variance_factor(problem, state, inliers)
        if abs(np.sqrt(factor) - 1.0) < _SCALE_TOLERANCE:
            break
        problem, sigma0 = problem.scaled(float(np.sqrt(factor))), sigma0 * float(np.sqrt(factor))
        found = _iterate(problem, state, inliers, robust=False)
        if found is None:
            return None
        state = found
    system = System.at(problem, state, inliers.astype(float))
    cofactors = inverse_of(system.normal)
    if cofactors is None:
        return None
    references, gains = _reference_gains(problem, system, cofactors)
    return SolvedStations(problem, state, inliers, symmetric(cofactors), references, gains, sigma0)


def _variance_factor(problem: StationProblem, state: State, inliers: NDArray[np.bool_]) -> float:
    """A-posteriori variance of unit weight."""
    obs, count = problem.observations, len(problem.given)
    lin = linearized(problem, state, state.points)
    squares = np.square((lin.pixel - obs.pixel) / obs.sigma_px[:, None]).sum(axis=1)[inliers].sum()
    seen = np.bincount(obs.point[inliers], minlength=count) > 0
    known = seen & ~problem.free
    off = (state.points - problem.given)[known]
    squares += np.einsum("pi,pi->", off, np.einsum("pij,pj->pi", problem.prior_information[known], off))
    for index in mounting_places(problem):
        given = problem.mountings[index]
        assert given.cov is not None
        step = given.rig_from_cam.local(state.rig_from_cams[index])
        squares += step @ np.linalg.solve(given.cov, step)
    unknowns = 6 * len(problem.world_from_rigs)  # each mounting has as many observations as unknowns
    redundancy = 2 * int(inliers.sum()) - 3 * int((seen & problem.free).sum()) - unknowns
    return float(squares) / max(redundancy, 1)


def _reference_gains(problem: StationProblem, system: System, cofactors: Array) -> tuple[NDArray[np.int64], Array]:
    """Gains (R, U, 6) of the errors of reference poses: dx = -Q E N_pp^-1 C^-1 dX, dX = sum over rays of B e.

    With the given positions' covariance C; free points do not depend on references.
    """
    used, place = np.unique(problem.ray_reference, return_inverse=True)
    pulled = system.solved @ problem.prior_information  # (P, U, 3)
    by_ray = pulled[problem.ray_point] @ problem.by_reference_pose
    return used, -cofactors @ segment_sum(by_ray, place.ravel(), len(used))
