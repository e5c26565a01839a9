"""Coherent blocks of what is given wrong: stretches of the drive whose given poses or points share one shift.

Every contiguous run of segments is tested for a common shift; the most significant one is taken, the search repeated
with its shift estimated along, until none is left. The pieces that the runs cut the drive into are then tested
together, so that an overlap or a good piece inside a run comes out right.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from typing import cast

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.stats import chi2, ncx2

from georef.estimation.adjustment.block import Block, Indices
from georef.estimation.adjustment.blunders.shift_system import Members, ShiftSystem
from georef.estimation.adjustment.kernels.shifts import best_run
from georef.geometry.rigid import Array

_FALSE_ALARM = 0.001  # of a whole search
_RUNS_A_SEGMENT = 10.0  # so many of the runs through a segment count as independent
_MOST_RUNS = 100
_POWER = 0.8  # that a detectable shift is found with: 1 - beta0
FEWEST_POINTS = 3  # one or two that are off are single blunders
LARGE_SHARE = 0.5  # of those that are left: so many of one other shift may be the right ones as well
Run = tuple[int, int]


@dataclass(frozen=True, eq=False)
class CoherentBlock:
    """Given poses or points of neighbouring stations that are wrong by one shift.

    poses, points: rows of the block's priors; references: images of the reference that these points come from;
    shift_m: given minus adjusted (3,), in world, with its covariance (3, 3); statistic: chi-square with 3 degrees of
    freedom if the shift were nothing but what references may share (of the clearer part where two were joined);
    detectable_m: the least shift in its direction that the search finds with a probability of 0.8.
    """

    station_ids: tuple[str, ...]
    poses: Indices
    points: Indices
    references: tuple[str, ...]
    shift_m: Array
    cov: Array
    statistic: float
    detectable_m: float


@dataclass(frozen=True, eq=False)
class CoherentSearch:
    """undecidable: that the named blocks are wrong and not the rest rests on nothing but how many they are."""

    blocks: tuple[CoherentBlock, ...]
    undecidable: bool


def coherent_blocks(block: Block, system: ShiftSystem, *, reference_m: float = 0.01) -> CoherentSearch:
    """Names the stretches of what is given wrong. reference_m: 1-sigma of the errors that what is right in a stretch
    may have in common (those of the reference images it was localized against)."""
    shared, limit = reference_m**2, search_limit(len(system))
    pieces = _joined(system, _wrong_pieces(system, _runs(system, shared, limit), shared, limit), limit)
    if not pieces:
        return CoherentSearch((), False)
    pieces = _smaller_side(system, pieces, limit)
    shifts, cov, _ = _of_pieces(system, pieces).estimate(np.eye(len(pieces)))
    named = tuple(
        _named(block, system, piece, shifts[k], _own(cov, k, k), shared, limit) for k, piece in enumerate(pieces)
    )
    return CoherentSearch(named, _undecidable(system, pieces, limit))


def search_limit(segments: int) -> float:
    """What the statistic of a shift (3 degrees of freedom) has to exceed in a search over so many segments."""
    return float(chi2.isf(_FALSE_ALARM / (_RUNS_A_SEGMENT * max(segments, 1)), 3))


def _runs(system: ShiftSystem, shared: float, limit: float) -> list[Run]:
    """Significant runs, the most significant first, each once those before are estimated along."""
    runs: list[Run] = []
    while len(runs) < _MOST_RUNS:
        information, right = np.ascontiguousarray(system.information), np.ascontiguousarray(system.right)
        found = [best_run(information, right, *span, shared) for span in system.spans]
        begin, end, statistic = max(found, key=lambda run: run[2], default=(0, 0, 0.0))
        if statistic <= limit or (begin, end) in runs:
            break
        runs.append((begin, end))
        design = np.zeros((len(system), 1))
        design[begin:end] = 1.0
        system = system.given(design)
    return runs


def _wrong_pieces(system: ShiftSystem, runs: list[Run], shared: float, limit: float) -> list[Run]:
    """Pieces between the ends of runs whose own shift stays significant when those of all others are estimated along;
    what was good inside a run is let go, least significant first, and so are too few points."""
    cuts = sorted({end for run in runs for end in run} | {end for span in system.spans for end in span})
    pieces = [(a, b) for a, b in pairwise(cuts) if any(begin <= a and b <= end for begin, end in runs)]
    of_points = np.bincount(system.points.segment, minlength=len(system))
    of_poses = np.bincount(system.poses.segment, minlength=len(system))
    pieces = [(a, b) for a, b in pieces if of_poses[a:b].sum() or of_points[a:b].sum() >= FEWEST_POINTS]
    every, kept = _of_pieces(system, pieces), np.arange(len(pieces))
    while len(kept):
        shifts, cov, _ = every.estimate(np.eye(len(pieces))[:, kept])
        statistic = np.array([_squared(s, _own(cov, k, k) + shared * np.eye(3)) for k, s in enumerate(shifts)])
        if statistic.min() > limit:
            break
        kept = np.delete(kept, int(np.argmin(statistic)))
    return [pieces[k] for k in kept]


def _of_pieces(system: ShiftSystem, pieces: list[Run], *, rest: bool = False) -> ShiftSystem:
    """The system of pieces, and of all that is in none of them as the last one if asked for."""
    group = np.full(len(system), len(pieces) if rest else -1)
    for k, (begin, end) in enumerate(pieces):
        group[begin:end] = k
    return system.grouped(group, len(pieces) + rest)


def _joined(system: ShiftSystem, pieces: list[Run], limit: float) -> list[Run]:
    """Adjoining pieces of the same shift made one."""
    k, starts = 0, {begin for begin, _ in system.spans}
    while k + 1 < len(pieces):
        shifts, cov, _ = _of_pieces(system, pieces).estimate(np.eye(len(pieces)))
        difference = _own(cov, k, k) + _own(cov, k + 1, k + 1) - _own(cov, k, k + 1) - _own(cov, k + 1, k)
        adjoining = pieces[k][1] == pieces[k + 1][0] and pieces[k][1] not in starts
        if adjoining and _squared(shifts[k] - shifts[k + 1], difference) <= limit:
            pieces[k : k + 2] = [(pieces[k][0], pieces[k + 1][1])]
        else:
            k += 1
    return pieces


def _smaller_side(system: ShiftSystem, pieces: list[Run], limit: float) -> list[Run]:
    """The pieces, or all unnamed ones instead of those of one shift where that explains the residuals no worse and
    names fewer: a shift of many against a datum that rests on a few looks the same from either side."""
    grouped, last = _of_pieces(system, pieces, rest=True), len(pieces)
    members, every = grouped.members, np.eye(len(pieces) + 1)
    shifts, cov, explained = grouped.estimate(every[:, :last])
    for k in range(last):
        like = _like(shifts, cov, k, limit)
        if members[:last][like].sum() <= members[last] or not members[last]:
            continue
        if grouped.estimate(every[:, np.append(~like, True)])[2] > explained - limit:
            return sorted(
                [piece for piece, same in zip(pieces, like, strict=True) if not same] + _unnamed(system, pieces)
            )
    return pieces


def _unnamed(system: ShiftSystem, pieces: list[Run]) -> list[Run]:
    """The runs between pieces, none across the ends of spans."""
    cuts = sorted({end for run in (*pieces, *system.spans) for end in run})
    inside = [any(begin <= a and b <= end for begin, end in pieces) for a, b in pairwise(cuts)]
    spans = [any(begin <= a and b <= end for begin, end in system.spans) for a, b in pairwise(cuts)]
    return [run for run, named, there in zip(pairwise(cuts), inside, spans, strict=True) if there and not named]


def _undecidable(system: ShiftSystem, pieces: list[Run], limit: float) -> bool:
    """Whether some pieces of one shift may as well be right and all unnamed ones wrong: that explains the residuals no
    worse, and there are not many more of the latter."""
    grouped, last = _of_pieces(system, pieces, rest=True), len(pieces)
    members, every = grouped.members, np.eye(len(pieces) + 1)
    shifts, cov, explained = grouped.estimate(every[:, :last])
    for k in range(last):
        like = _like(shifts, cov, k, limit)
        if members[:last][like].sum() < LARGE_SHARE * members[last]:
            continue
        other = grouped.estimate(every[:, np.append(~like, True)])[2]
        if other > explained - limit:
            return True
    return False


def _like(shifts: Array, cov: Array, k: int, limit: float) -> NDArray[np.bool_]:
    """Which shifts may be the same as the k-th."""
    out = np.zeros(len(shifts), bool)
    for i in range(len(shifts)):
        difference = _own(cov, k, k) + _own(cov, i, i) - _own(cov, k, i) - _own(cov, i, k)
        out[i] = i == k or _squared(shifts[k] - shifts[i], difference) <= limit
    return out


def _own(cov: Array, a: int, b: int) -> Array:
    return cov[3 * a : 3 * a + 3, 3 * b : 3 * b + 3]


def _squared(vector: Array, cov: Array) -> float:
    return float(vector @ np.linalg.pinv(cov, hermitian=True) @ vector)


def _named(
    block: Block, system: ShiftSystem, piece: Run, shift: Array, cov: Array, shared: float, limit: float
) -> CoherentBlock:
    poses, points = (_inside(members, piece) for members in (system.poses, system.points))
    stations = np.unique(np.concatenate([poses.station, points.station]))
    statistic = _squared(shift, cov + shared * np.eye(3))
    return CoherentBlock(
        tuple(block.station_ids[i] for i in stations),
        *(poses.row, points.row, references_of(block, points.row), shift, cov, statistic),
        detectable(shift, statistic, limit),
    )


def _inside(members: Members, piece: Run) -> Members:
    kept = (members.segment >= piece[0]) & (members.segment < piece[1])
    return Members(members.row[kept], members.station[kept], members.segment[kept])


def references_of(block: Block, points: Indices) -> tuple[str, ...]:
    """Names of the reference images that some rows of the point priors come from; none where the block knows none."""
    rays = block.reference_rays
    if rays is None or not rays.image_ids:
        return ()
    chosen = np.isin(rays.point, block.point_priors.point[points])
    return tuple(rays.image_ids[i] for i in np.unique(rays.reference[chosen]))


def detectable(shift: Array, statistic: float, limit: float) -> float:
    """The least shift (m) in the direction of one with this statistic that exceeds a limit with probability _POWER."""
    return float(np.linalg.norm(shift) * np.sqrt(_noncentrality(limit) / statistic))


@cache
def _noncentrality(limit: float) -> float:
    """Of a chi-square with 3 degrees of freedom that exceeds a limit with a probability of _POWER."""
    return cast(float, brentq(lambda at: ncx2.sf(limit, 3, at) - _POWER, 1e-6, 100.0 + 10.0 * limit))
