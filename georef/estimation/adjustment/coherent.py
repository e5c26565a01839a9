"""Coherent blocks of wrong priors: stretches of the trajectory whose given poses share one shift.

Every contiguous run of segments is tested for a common shift; the most significant one is taken, the search repeated
with its shift estimated along, until none is left. The pieces that the runs cut the trajectory into are then tested
together, so that an overlap or a good piece inside a run comes out right.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from georef.estimation.adjustment.block import Block, Indices, State
from georef.estimation.adjustment.cofactors import Cofactors
from georef.estimation.adjustment.constraint_terms import POSE_PRIORS, constraint_terms
from georef.estimation.adjustment.group_tests import fitted_cofactor
from georef.estimation.adjustment.shift_system import ShiftSystem
from georef.geometry.rigid import Array

_FALSE_ALARM = 0.001  # of a whole search
_RUNS_A_SEGMENT = 10.0  # so many of the runs through a segment count as independent
_MOST_RUNS = 100
_LARGE_SHARE = 0.5  # of those that are left: so many priors of one other shift may be the right ones as well


@dataclass(frozen=True, eq=False)
class CoherentBlock:
    """Priors of neighbouring stations that are wrong by one shift.

    rows: of the block's pose priors; shift_m: given minus adjusted (3,), in world, with its covariance (3, 3);
    statistic: chi-square with 3 degrees of freedom if the shift were nothing but what references may share.
    """

    station_ids: tuple[str, ...]
    rows: Indices
    shift_m: Array
    cov: Array
    statistic: float


@dataclass(frozen=True, eq=False)
class CoherentSearch:
    """undecidable: that the named blocks are wrong and not the rest rests on nothing but how many they are."""

    blocks: tuple[CoherentBlock, ...]
    undecidable: bool


def coherent_blocks(block: Block, system: ShiftSystem, *, reference_m: float = 0.01) -> CoherentSearch:
    """Names the stretches of wrong priors. reference_m: 1-sigma of the errors that right priors of a stretch may have
    in common (those of the reference images they were localized against)."""
    limit = float(chi2.isf(_FALSE_ALARM / (_RUNS_A_SEGMENT * len(system)), 3))
    runs: list[tuple[int, int]] = []
    while len(runs) < _MOST_RUNS:
        run, statistic = _best_run(system.given(_design(runs, len(system))), reference_m**2)
        if statistic <= limit or run in runs:
            break
        runs.append(run)
    pieces = _joined(system, _wrong_pieces(system, runs, reference_m**2, limit), limit)
    if not pieces:
        return CoherentSearch((), False)
    shifts, cov, _ = system.estimate(_design(pieces, len(system)))
    blocks = [
        _named(block, system, piece, shifts[k], cov[3 * k : 3 * k + 3, 3 * k : 3 * k + 3], reference_m)
        for k, piece in enumerate(pieces)
    ]
    return CoherentSearch(tuple(blocks), _undecidable(system, pieces, shifts, cov, limit))


def without_agreeing(
    search: CoherentSearch, block: Block, state: State, found: Cofactors, probability: float
) -> CoherentSearch:
    """The search without poses that agree with the rest after all, such as one right pose at the station where a
    stretch ends: those that pass their own test, and better so than with the shift of their block taken off.

    block has all poses, state and found (its cofactors) are those of the adjustment that lacks the named ones.
    """
    blocks = []
    for wrong in search.blocks:
        given, priors = _deleted_statistics(block, state, found, wrong, 0.0), len(wrong.rows)
        corrected = _deleted_statistics(block, state, found, wrong, 1.0)
        stays = (given > chi2.ppf(probability, 6)) | (given > corrected)
        if stays.sum() < priors:
            rows = wrong.rows[stays]
            stations = np.unique(block.station[block.pose_priors.image[rows]])
            wrong = replace(wrong, rows=rows, station_ids=tuple(block.station_ids[i] for i in stations))
        blocks += [wrong] if len(wrong.rows) else []
    return CoherentSearch(tuple(blocks), search.undecidable)


def _deleted_statistics(block: Block, state: State, found: Cofactors, wrong: CoherentBlock, share: float) -> Array:
    """r' (S + A Q A')^-1 r (k,) of poses that the adjustment lacks, this share of their shift taken off."""
    poses = block.pose_priors.take(np.isin(np.arange(len(block.pose_priors)), wrong.rows))
    back = replace(poses.world_from_cam, translation=poses.world_from_cam.translation - share * wrong.shift_m)
    only = replace(block, pose_priors=replace(poses, world_from_cam=back))
    (term,) = (t for t in constraint_terms(only, state, found.layout) if t.name == POSE_PRIORS)
    cov = np.eye(6) + fitted_cofactor(term, found)
    return np.einsum("ki,ki->k", term.residual, np.linalg.solve(cov, term.residual[:, :, None])[:, :, 0])


def _design(runs: list[tuple[int, int]], count: int) -> Array:
    out = np.zeros((count, len(runs)))
    for k, (begin, end) in enumerate(runs):
        out[begin:end, k] = 1.0
    return out


def _best_run(system: ShiftSystem, shared: float) -> tuple[tuple[int, int], float]:
    """The run of segments whose common shift is most significant, against a variance that right ones may share."""
    count = len(system)
    sums = np.zeros((count + 1, count + 1, 3, 3))
    blocks = system.information.reshape(count, 3, count, 3).transpose(0, 2, 1, 3)
    sums[1:, 1:] = blocks.cumsum(axis=0).cumsum(axis=1)
    right = np.concatenate([np.zeros((1, 3)), system.right.reshape(-1, 3).cumsum(axis=0)])
    best, found = (0, count), -1.0
    ends = np.arange(count + 1)
    for begin in range(count):
        end = ends[begin + 1 :]
        information = sums[end, end] - sums[begin, end] - sums[end, begin] + sums[begin, begin]
        statistic = _significance(information, right[end] - right[begin], shared)
        k = int(np.argmax(statistic))
        if statistic[k] > found:
            best, found = (begin, int(end[k])), float(statistic[k])
    return best, found


def _significance(information: Array, right: Array, shared: float) -> Array:
    """s' (M^-1 + shared I)^-1 s of shifts s = M^-1 b (k, 3): by b' (M + shared M M)^-1 b, which a datum that rests on
    the tested priors alone leaves finite."""
    scale = np.trace(information, axis1=1, axis2=2)[:, None, None]
    matrix = information + shared * information @ information + (1e-9 * np.abs(scale) + 1e-12) * np.eye(3)
    return np.einsum("ki,ki->k", right, np.linalg.solve(matrix, right[:, :, None])[:, :, 0])


def _wrong_pieces(
    system: ShiftSystem, runs: list[tuple[int, int]], shared: float, limit: float
) -> list[tuple[int, int]]:
    """Pieces between the ends of runs whose own shift stays significant when those of all others are estimated along;
    what was good inside a run is let go, least significant first."""
    cuts = sorted({end for run in runs for end in run})
    pieces = [(a, b) for a, b in pairwise(cuts) if any(begin <= a and b <= end for begin, end in runs)]
    while pieces:
        shifts, cov, _ = system.estimate(_design(pieces, len(system)))
        statistic = np.array([_squared(s, _own(cov, k, k) + shared * np.eye(3)) for k, s in enumerate(shifts)])
        if statistic.min() > limit:
            return pieces
        pieces.pop(int(np.argmin(statistic)))
    return pieces


def _joined(system: ShiftSystem, pieces: list[tuple[int, int]], limit: float) -> list[tuple[int, int]]:
    """Adjoining pieces of the same shift made one."""
    k = 0
    while k + 1 < len(pieces):
        shifts, cov, _ = system.estimate(_design(pieces, len(system)))
        difference = _own(cov, k, k) + _own(cov, k + 1, k + 1) - _own(cov, k, k + 1) - _own(cov, k + 1, k)
        if pieces[k][1] == pieces[k + 1][0] and _squared(shifts[k] - shifts[k + 1], difference) <= limit:
            pieces[k : k + 2] = [(pieces[k][0], pieces[k + 1][1])]
        else:
            k += 1
    return pieces


def _undecidable(system: ShiftSystem, pieces: list[tuple[int, int]], shifts: Array, cov: Array, limit: float) -> bool:
    """Whether some pieces of one shift may as well be right and all unnamed priors wrong: that explains the residuals
    no worse, and there are not many more of the latter."""
    design, per_segment = _design(pieces, len(system)), np.bincount(system.segment, minlength=len(system))
    rest = ~design.any(axis=1)
    explained = system.estimate(design)[2]
    for k in range(len(pieces)):
        like = _like(shifts, cov, k, limit)
        if per_segment[design[:, like].any(axis=1)].sum() < _LARGE_SHARE * per_segment[rest].sum():
            continue
        other = system.estimate(np.column_stack([design[:, ~like], rest.astype(np.float64)]))[2]
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
    block: Block, system: ShiftSystem, piece: tuple[int, int], shift: Array, cov: Array, reference_m: float
) -> CoherentBlock:
    rows = system.rows[(system.segment >= piece[0]) & (system.segment < piece[1])]
    stations = np.unique(block.station[block.pose_priors.image[rows]])
    statistic = _squared(shift, cov + reference_m**2 * np.eye(3))
    return CoherentBlock(tuple(block.station_ids[i] for i in stations), rows, shift, cov, statistic)
