"""The normal equations of a station problem: unknowns, derivatives, points eliminated.

Unknowns are the stations (world_from_rig, 6 each) and, where a calibration has a covariance, the mountings
(rig_from_cam, 6 each), all as right perturbations.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import numpy as np

from georef.estimation.station_problem import StationProblem
from georef.geometry.projection import Linearized, Views, linearize
from georef.geometry.rigid import Array, Rigid3
from georef.geometry.triangulation import segment_sum


@dataclass(frozen=True, eq=False)
class State:
    """Values of all unknowns."""

    world_from_rigs: tuple[Rigid3, ...]
    rig_from_cams: tuple[Rigid3, ...]
    points: Array  # (P, 3)


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
    places = mounting_places(problem)
    size = 6 * (len(problem.world_from_rigs) + len(places))
    out = np.zeros((len(problem.members), 6, size))
    for i, (member, mounting) in enumerate(zip(problem.members, problem.mounting_of, strict=True)):
        here = 6 * member.station
        out[i, :, here : here + 6] = state.rig_from_cams[mounting].inverse().adjoint()
        if int(mounting) in places:
            there = places[int(mounting)]
            out[i, :, there : there + 6] = np.eye(6)
    return out


def mounting_places(problem: StationProblem) -> dict[int, int]:
    """First unknown of each mounting that is not exact."""
    uncertain = [i for i, mounting in enumerate(problem.mountings) if mounting.cov is not None]
    return {i: 6 * (len(problem.world_from_rigs) + k) for k, i in enumerate(uncertain)}


@dataclass(frozen=True, eq=False)
class System:
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
    def at(problem: StationProblem, state: State, weight: Array) -> System:
        obs, count = problem.observations, len(problem.given)
        lin = linearized(problem, state, state.points)
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
        return System(lin, by_unknown, residual, information, inverse, mixed, solved, point_gradient, normal, gradient)


def _flat(blocks: Array) -> Array:
    """Blocks (P, U, 3) side by side: (U, 3P)."""
    return np.swapaxes(blocks, 0, 1).reshape(blocks.shape[1], -1)


def linearized(problem: StationProblem, state: State, points: Array) -> Linearized:
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
    for index, place in mounting_places(problem).items():
        given = problem.mountings[index]
        assert given.cov is not None
        weight, here = np.linalg.inv(given.cov), slice(place, place + 6)
        normal[here, here] += weight
        gradient[here] += weight @ given.rig_from_cam.local(state.rig_from_cams[index])


def inverse_of(normal: Array) -> Array | None:
    """The inverse of a normal matrix; None where it is singular to working precision."""
    diagonal = np.diag(normal)
    if not np.isfinite(normal).all() or not (diagonal > 0).all():
        return None
    scale = 1.0 / np.sqrt(diagonal)  # radians and metres differ by orders of magnitude
    scaled = normal * scale[:, None] * scale[None, :]
    if np.linalg.eigvalsh(scaled)[0] <= 1e-12:
        return None
    return cast(Array, np.linalg.inv(scaled)) * scale[:, None] * scale[None, :]
