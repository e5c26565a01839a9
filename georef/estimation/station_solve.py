"""Least squares of a station problem: Gauss-Newton with the points eliminated, gates, and the joint covariance.

Unknowns are the stations (world_from_rig, 6 each) and, where a calibration has a covariance, the mountings
(rig_from_cam, 6 each), all as right perturbations. The steps are those of the pose of a single image: Cauchy weights,
a chi-square gate on residuals against their own covariance, a refit without a robust loss. Eliminating a point that has
a position from the references weights its observation as sigma^2 + B C B', as the single image does.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from georef.estimation.reference_map import ReferenceMap
from georef.estimation.station_problem import StationProblem
from georef.geometry.covariance import symmetric
from georef.geometry.projection import Linearized, Views, linearize
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
class State:
    """Values of all unknowns."""

    world_from_rigs: tuple[Rigid3, ...]
    rig_from_cams: tuple[Rigid3, ...]
    points: Array  # (P, 3)


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


def started(problem: StationProblem) -> State:
    mountings = tuple(m.rig_from_cam for m in problem.mountings)
    return State(problem.world_from_rigs, mountings, problem.given)


def member_poses(problem: StationProblem, state: State) -> list[Rigid3]:
    """world_from_cam (M) of all members."""
    return [
        state.world_from_rigs[member.station] @ state.rig_from_cams[mounting]
        for member, mounting in zip(problem.members, problem.mounting_of, strict=True)
    ]


def chains(problem: StationProblem, state: State) -> Array:
    """Derivatives (M, 6, U) of the members' poses by stations and uncertain mountings."""
    places = _mounting_places(problem)
    size = 6 * (len(problem.world_from_rigs) + len(places))
    out = np.zeros((len(problem.members), 6, size))
    for i, (member, mounting) in enumerate(zip(problem.members, problem.mounting_of, strict=True)):
        here = 6 * member.station
        out[i, :, here : here + 6] = state.rig_from_cams[mounting].inverse().adjoint()
        if int(mounting) in places:
            there = places[int(mounting)]
            out[i, :, there : there + 6] = np.eye(6)
    return out


def _mounting_places(problem: StationProblem) -> dict[int, int]:
    """First unknown of each mounting that is not exact."""
    uncertain = [i for i, mounting in enumerate(problem.mountings) if mounting.cov is not None]
    return {i: 6 * (len(problem.world_from_rigs) + k) for k, i in enumerate(uncertain)}


@dataclass(frozen=True, eq=False)
class _System:
    """The normal equations at a state, points eliminated."""

    lin: Linearized
    by_unknown: Array  # (n, 2, U)
    residual: Array  # (n, 2) projected minus observed
    information: Array  # (n,) 1 / px^2 of each coordinate; 0 where an observation takes no part
    point_inverse: Array  # (P, 3, 3)
    mixed: Array  # (P, U, 3)
    solved: Array  # (P, U, 3) mixed @ point_inverse
    point_gradient: Array  # (P, 3)
    normal: Array  # (U, U)
    gradient: Array  # (U,)

    @staticmethod
    def at(problem: StationProblem, state: State, weight: Array) -> _System:
        obs, count = problem.observations, len(problem.given)
        lin = _linearized(problem, state, state.points)
        by_pose, by_point = np.nan_to_num(lin.by_pose), np.nan_to_num(lin.by_point)
        in_front = np.isfinite(lin.pixel).all(axis=1)
        residual = np.nan_to_num(lin.pixel - obs.pixel)
        information = weight * in_front / np.square(obs.sigma_px)
        by_unknown = by_pose @ chains(problem, state)[obs.view]
        weighted = by_unknown * information[:, None, None]
        transposed = np.swapaxes(by_point, 1, 2)
        prior = _prior_information(problem, weight)
        blocks = segment_sum(transposed @ by_point * information[:, None, None], obs.point, count) + prior
        inverse = _block_inverse(blocks)
        off = np.einsum("nki,nk->ni", by_point, residual) * information[:, None]
        point_gradient = segment_sum(off, obs.point, count) + np.einsum(
            "pij,pj->pi", prior, state.points - problem.given
        )
        mixed = segment_sum(np.swapaxes(weighted, 1, 2) @ by_point, obs.point, count)
        solved = mixed @ inverse
        flat_solved, size = _flat(solved), by_unknown.shape[2]
        flat_weighted = weighted.reshape(-1, size).T
        normal = flat_weighted @ by_unknown.reshape(-1, size) - flat_solved @ _flat(mixed).T
        gradient = flat_weighted @ residual.ravel() - flat_solved @ point_gradient.ravel()
        _add_calibration(problem, state, normal, gradient)
        return _System(lin, by_unknown, residual, information, inverse, mixed, solved, point_gradient, normal, gradient)


def _flat(blocks: Array) -> Array:
    """Blocks (P, U, 3) side by side: (U, 3P)."""
    return np.swapaxes(blocks, 0, 1).reshape(blocks.shape[1], -1)


def _linearized(problem: StationProblem, state: State, points: Array) -> Linearized:
    views = Views.of(member_poses(problem, state), [m.features.camera for m in problem.members])
    return linearize(views, problem.observations.view, points[problem.observations.point])


def _prior_information(problem: StationProblem, weight: Array) -> Array:
    """Information (P, 3, 3) of the points' positions, weighted as the observations of the point are on average."""
    obs, count = problem.observations, len(problem.given)
    seen = np.maximum(np.bincount(obs.point, minlength=count), 1)
    share = np.bincount(obs.point, weights=weight, minlength=count) / seen
    share = np.where(share > 0, share, 1.0)
    return problem.prior_information * share[:, None, None]


def _block_inverse(blocks: Array) -> Array:
    """Inverses (P, 3, 3); zero where a point is not determined, which then takes no part."""
    scale = np.trace(blocks, axis1=1, axis2=2) / 3.0
    scaled = blocks / np.where(scale > 0, scale, 1.0)[:, None, None]
    open_ = ~(np.abs(np.linalg.det(scaled)) > 1e-14)
    scaled[open_] = np.eye(3)
    inverse = np.linalg.inv(scaled) / np.where(scale > 0, scale, 1.0)[:, None, None]
    inverse[open_] = 0.0
    return cast(Array, inverse)


def _add_calibration(problem: StationProblem, state: State, normal: Array, gradient: Array) -> None:
    """The calibrated mountings as observations of the estimated ones, in place."""
    for index, place in _mounting_places(problem).items():
        given = problem.mountings[index]
        assert given.cov is not None
        weight, here = np.linalg.inv(given.cov), slice(place, place + 6)
        normal[here, here] += weight
        gradient[here] += weight @ given.rig_from_cam.local(state.rig_from_cams[index])


def _moved(problem: StationProblem, state: State, step: Array, points: Array) -> State:
    rigs = tuple(pose.retract(step[6 * i : 6 * i + 6]) for i, pose in enumerate(state.world_from_rigs))
    cams = list(state.rig_from_cams)
    for index, place in _mounting_places(problem).items():
        cams[index] = cams[index].retract(step[place : place + 6])
    return State(rigs, tuple(cams), points)


def _iterate(problem: StationProblem, state: State, selected: NDArray[np.bool_], *, robust: bool) -> State | None:
    """Gauss-Newton on the selected observations, with Cauchy weights at the scale that residuals show where robust."""
    for _ in range(_ROBUST_ITERATIONS if robust else _ITERATIONS):
        weight = selected.astype(float)
        if robust:
            weight = weight * _cauchy(problem, state)
        system = _System.at(problem, state, weight)
        inverse = _inverse(system.normal)
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
    lin = _linearized(problem, state, points)
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
    obs, system = problem.observations, _System.at(problem, state, inliers.astype(float))
    cofactors = _inverse(system.normal)
    if cofactors is None:
        return None
    lin = _linearized(problem, state, state.points)
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
    system = _System.at(problem, state, inliers.astype(float))
    cofactors = _inverse(system.normal)
    if cofactors is None:
        return None
    references, gains = _reference_gains(problem, system, cofactors)
    return SolvedStations(problem, state, inliers, symmetric(cofactors), references, gains, sigma0)


def _variance_factor(problem: StationProblem, state: State, inliers: NDArray[np.bool_]) -> float:
    """A-posteriori variance of unit weight."""
    obs, count = problem.observations, len(problem.given)
    lin = _linearized(problem, state, state.points)
    squares = np.square((lin.pixel - obs.pixel) / obs.sigma_px[:, None]).sum(axis=1)[inliers].sum()
    seen = np.bincount(obs.point[inliers], minlength=count) > 0
    known = seen & ~problem.free
    off = (state.points - problem.given)[known]
    squares += np.einsum("pi,pi->", off, np.einsum("pij,pj->pi", problem.prior_information[known], off))
    for index in _mounting_places(problem):
        given = problem.mountings[index]
        assert given.cov is not None
        step = given.rig_from_cam.local(state.rig_from_cams[index])
        squares += step @ np.linalg.solve(given.cov, step)
    unknowns = 6 * len(problem.world_from_rigs)  # each mounting has as many observations as unknowns
    redundancy = 2 * int(inliers.sum()) - 3 * int((seen & problem.free).sum()) - unknowns
    return float(squares) / max(redundancy, 1)


def _reference_gains(problem: StationProblem, system: _System, cofactors: Array) -> tuple[NDArray[np.int64], Array]:
    """Gains (R, U, 6) of the errors of reference poses: dx = -Q E N_pp^-1 C^-1 dX, dX = sum over rays of B e.

    With the given positions' covariance C; free points do not depend on references.
    """
    used, place = np.unique(problem.ray_reference, return_inverse=True)
    pulled = system.solved @ problem.prior_information  # (P, U, 3)
    by_ray = pulled[problem.ray_point] @ problem.by_reference_pose
    return used, -cofactors @ segment_sum(by_ray, place.ravel(), len(used))


def _inverse(normal: Array) -> Array | None:
    """The inverse of a normal matrix; None where it is singular to working precision."""
    diagonal = np.diag(normal)
    if not np.isfinite(normal).all() or not (diagonal > 0).all():
        return None
    scale = 1.0 / np.sqrt(diagonal)  # radians and metres differ by orders of magnitude
    scaled = normal * scale[:, None] * scale[None, :]
    if np.linalg.eigvalsh(scaled)[0] <= 1e-12:
        return None
    return cast(Array, np.linalg.inv(scaled)) * scale[:, None] * scale[None, :]
