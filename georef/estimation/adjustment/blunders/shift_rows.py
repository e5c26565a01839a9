"""Which given poses and points are tested for shifts in common, and the system of these shifts.

A given point enters with what its rays and its coordinates say of each other (`given_points`). One that disagrees with
its neighbours on the drive, on both sides, is a single blunder: it is not tested, and counts as its loss says.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csc_array, csr_array, hstack
from scipy.stats import chi2

from georef.estimation.adjustment.block import KINDS_OF_POINT, KINDS_OF_POSE, Block, Indices, State
from georef.estimation.adjustment.blunders.shift_system import Members, ShiftSystem
from georef.estimation.adjustment.equations.cofactors import Cofactors
from georef.estimation.adjustment.equations.constraint_terms import POSE_PRIORS, Term, constraint_terms, whitening
from georef.estimation.adjustment.equations.eliminate import Losses, given_squares, robust_weight
from georef.estimation.adjustment.equations.given_points import GivenRays
from georef.estimation.adjustment.equations.reduced import Layout
from georef.estimation.adjustment.kernels.shifts import agreeing
from georef.geometry.rigid import Array

AUTOMATIC = KINDS_OF_POINT[1]
_MOST_SEGMENTS = 600  # a search over all runs of them stays cheap
_CHUNK = 300  # solutions at a time
_POINTS = 20_000  # given points looked at together
_REACH, _SHARE = 8, 0.5  # neighbours on either side, and how many of those on one side have to agree
_TOLERANCE_M = 0.015  # what neighbours may differ by because of their stations
_AGREES = 0.999
_LOOSE = 1e-6  # of the trace: the least a point is taken to be known by in a direction


@dataclass(frozen=True, eq=False)
class ShiftRows:
    """Rows of pose priors and of point priors that are tested, with their stations."""

    pose: Indices
    pose_station: Indices
    point: Indices
    point_station: Indices

    def __len__(self) -> int:
        return len(self.pose) + len(self.point)


def shift_rows(block: Block, state: State, layout: Layout, losses: Losses) -> ShiftRows:
    """All localized poses, and the automatic GCPs that agree with their neighbours on the drive."""
    pose = np.flatnonzero(block.pose_priors.kind == KINDS_OF_POSE.index("localized"))
    point = np.flatnonzero(block.point_priors.kind == KINDS_OF_POINT.index(AUTOMATIC))
    point = point[layout.kept_point[block.point_priors.point[point]] < 0]
    station = stations_of_points(block)[block.point_priors.point[point]]
    seen = np.flatnonzero(station >= 0)
    seen = seen[np.argsort(station[seen], kind="stable")]
    point, station = point[seen], station[seen]
    supported = _supported(block, state, layout, point, losses)
    return ShiftRows(pose, block.station[block.pose_priors.image[pose]], point[supported], station[supported])


def stations_of_points(block: Block) -> Indices:
    """The middle one (P,) of the stations that a point is seen from, in their order; -1 for a point in no image."""
    obs = block.observations
    station = block.station[obs.view]
    order = np.lexsort((station, obs.point))
    count = np.bincount(obs.point, minlength=len(block.points))
    middle = np.cumsum(count) - count + count // 2
    seen = count > 0
    out = np.full(len(block.points), -1)
    out[seen] = station[order[middle[seen]]]
    return out


def with_singles_weighted(block: Block, state: State, tested: ShiftRows, losses: Losses) -> Block:
    """The block in which automatic GCPs that are not tested have the weight of their loss, tested ones their own."""
    priors = block.point_priors
    single = priors.kind == KINDS_OF_POINT.index(AUTOMATIC)
    single[tested.point] = False
    weight = robust_weight(given_squares(block, state.points), losses.get(AUTOMATIC, 0.0))
    information = priors.information * np.where(single, weight, 1.0)[:, None, None]
    return replace(block, point_priors=replace(priors, information=information))


def shift_system(
    block: Block, state: State, found: Cofactors, gradient: Array, tested: ShiftRows, losses: Losses | None = None
) -> ShiftSystem:
    """found, gradient: of the normal equations at the state, what is tested with its full weight; losses: of the image
    observations as in these."""
    at_pose, poses = _segments(tested.pose_station)
    at_point, points = _segments(tested.point_station)
    parts = [
        _of_poses(block, state, found.layout, tested.pose, at_pose, poses),
        _of_points(block, state, found.layout, tested.point, at_point, points, losses),
    ]
    across = cast(csc_array, hstack([part[0] for part in parts]).tocsc())
    own, right = (np.concatenate([part[i] for part in parts]) for i in (1, 2))
    turned: Any = csr_array(across.T)
    count = right.size
    information = np.zeros((count, count))
    for begin in range(0, count, _CHUNK):
        chunk = slice(begin, min(begin + _CHUNK, count))
        information[:, chunk] = -(turned @ found.apply(np.asarray(across[:, chunk].toarray())))
    at = np.arange(len(own))
    information.reshape(len(own), 3, len(own), 3)[at, :, at, :] += own
    return ShiftSystem(
        0.5 * (information + information.T),
        right.ravel() - turned @ found.apply(gradient),
        Members(tested.pose, tested.pose_station, at_pose),
        Members(tested.point, tested.point_station, poses + at_point),
        tuple(span for span in ((0, poses), (poses, poses + points)) if span[1] > span[0]),
    )


def _segments(station: Indices) -> tuple[Indices, int]:
    """Number of each row's segment, a station each or a few neighbouring ones if there are many; how many they are."""
    names, number = np.unique(station, return_inverse=True)
    segment = (number // (1 + (len(names) - 1) // _MOST_SEGMENTS)).astype(np.int64)
    return segment, int(segment.max(initial=-1)) + 1


def _of_poses(
    block: Block, state: State, layout: Layout, rows: Indices, segment: Indices, count: int
) -> tuple[Any, Array, Array]:
    """J'C (U, 3 n), C'C (n, 3, 3) and C'v (n, 3) of shifts of poses."""
    own, right = np.zeros((count, 3, 3)), np.zeros((count, 3))
    if not len(rows):
        return csc_array((layout.size, 0)), own, right
    (term,) = (t for t in constraint_terms(block, state, layout) if t.name == POSE_PRIORS)
    rotation = block.pose_priors.world_from_cam.rotation[rows]
    design = -whitening(block.pose_priors.cov[rows])[:, :, 3:] @ np.swapaxes(rotation, 1, 2)
    np.add.at(own, segment, np.swapaxes(design, 1, 2) @ design)
    np.add.at(right, segment, np.einsum("kmi,km->ki", design, term.residual[rows]))
    return _across(term, rows, segment, design, layout.size, count), own, right


def _across(term: Term, rows: Indices, segment: Indices, design: Array, size: int, count: int) -> Any:
    values, i, j = [], [], []
    for first, by in term.columns:
        here = np.flatnonzero(first[rows] >= 0)
        block = np.swapaxes(by[rows[here]], 1, 2) @ design[here]
        values.append(block.ravel())
        at = first[rows[here]][:, None, None] + np.arange(by.shape[2])[None, :, None]
        to = 3 * segment[here][:, None, None] + np.arange(3)[None, None, :]
        i.append(np.broadcast_to(at, block.shape).ravel())
        j.append(np.broadcast_to(to, block.shape).ravel())
    entries = (np.concatenate(values), (np.concatenate(i), np.concatenate(j)))
    return coo_array(entries, shape=(size, 3 * count)).tocsc()


def _of_points(
    block: Block, state: State, layout: Layout, rows: Indices, segment: Indices, count: int, losses: Losses | None
) -> tuple[Any, Array, Array]:
    """The same of shifts of given points, these eliminated: W N^-1 P, P - P N^-1 P, and the right side."""
    own, right, across = np.zeros((count, 3, 3)), np.zeros((count, 3)), csr_array((layout.size, 3 * count))
    for part in _chunks(len(rows)):
        seen = GivenRays.of(block, state, layout, rows[part], losses)
        checked, pull, gain = _checked(block, state, rows[part], seen)
        np.add.at(own, segment[part], checked)
        np.add.at(right, segment[part], pull)
        across = across + seen.coupled(gain, layout.size, segment[part], count)
    return across.tocsc(), own, right


def _checked(block: Block, state: State, rows: Indices, seen: GivenRays) -> tuple[Array, Array, Array]:
    """P - P N^-1 P (K, 3, 3), what stands against it (K, 3) as shifts go, and N^-1 P (K, 3, 3); stations held."""
    weight = block.point_priors.information[rows]
    inverse = seen.inverse(weight)
    off = state.points[block.point_priors.point[rows]] - block.point_priors.position[rows]
    pulled = np.einsum("kij,kj->ki", weight, off)
    gain = inverse @ weight
    step = np.einsum("kij,kj->ki", inverse, seen.slope + pulled)
    return weight - weight @ gain, np.einsum("kij,kj->ki", weight, step) - pulled, gain


def _supported(block: Block, state: State, layout: Layout, rows: Indices, losses: Losses) -> NDArray[np.bool_]:
    """Which given points (K,), in the order of the drive, agree with half of their neighbours on one side at least."""
    shift, cov = np.zeros((len(rows), 3)), np.zeros((len(rows), 3, 3))
    for part in _chunks(len(rows)):
        checked, pull, _ = _checked(block, state, rows[part], GivenRays.of(block, state, layout, rows[part], losses))
        known = np.trace(block.point_priors.information[rows[part]], axis1=1, axis2=2)
        cov[part] = np.linalg.inv(checked + _LOOSE * known[:, None, None] * np.eye(3))
        shift[part] = np.einsum("kij,kj->ki", cov[part], pull)
    before, after, compared = (np.zeros(shape, np.int64) for shape in (len(rows), len(rows), (len(rows), 2)))
    agreeing(shift, cov, _REACH, _TOLERANCE_M**2, float(chi2.ppf(_AGREES, 3)), before, after, compared)
    enough = np.maximum(_SHARE * compared, 1.0)
    return (before >= enough[:, 0]) | (after >= enough[:, 1])


def _chunks(count: int) -> list[slice]:
    return [slice(begin, min(begin + _POINTS, count)) for begin in range(0, count, _POINTS)]
