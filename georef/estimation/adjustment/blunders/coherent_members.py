"""Who belongs to a coherent block: every given pose and point judged by itself, once the named ones are out.

The search works on segments of the drive. At their seams right and wrong ones meet, and a segment that has both shows
a shift that neither has.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import cast

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree
from scipy.stats import chi2

from georef.estimation.adjustment.block import KINDS_OF_POINT, KINDS_OF_POSE, Block, Indices, State
from georef.estimation.adjustment.blunders.coherent import (
    FEWEST_POINTS,
    LARGE_SHARE,
    CoherentBlock,
    CoherentSearch,
    references_of,
    search_limit,
)
from georef.estimation.adjustment.blunders.coherent_clusters import Offsets, clusters, named
from georef.estimation.adjustment.equations.cofactors import Cofactors
from georef.estimation.adjustment.equations.constraint_terms import POSE_PRIORS, constraint_terms
from georef.estimation.adjustment.quality.group_tests import fitted_cofactor
from georef.geometry.rigid import Array

_SEAM = 3  # stations beyond the ends of a block that may belong to it
_NEAR_M = 15.0  # between points of one piece of the reference
_CONTRADICTS = 1e-6  # how seldom a right point is as far off as one of a cluster
_SAME = 0.9999  # that two estimates of one shift are taken for the same


@dataclass(frozen=True, eq=False)
class _Candidates:
    """Rows of one kind, their stations, and their statistic of dof degrees of freedom: of some of them (places among
    the rows) with a shift (3,) taken off."""

    row: Indices
    station: Indices
    dof: int
    statistic: Callable[[Indices, Array], Array]


def settled(
    search: CoherentSearch,
    block: Block,
    state: State,
    found: Cofactors,
    points: Array,
    *,
    probability: float = 0.999,
    reference_m: float = 0.01,
) -> CoherentSearch:
    """The search with the members of each block told one by one.

    One that agrees with the rest after all, and better so than with the shift of its block, is let go; one that
    disagrees belongs to the block near by whose shift explains it best. A block of fewer points than a search would
    name, or of no significant shift, is none; contradicting points that belong to none may form one by themselves
    (`coherent_clusters`). block has all priors; state, found and points (P, 3, 3), the cofactors, are those of the
    adjustment that lacks the named ones.
    """
    offsets = Offsets.of_poses(block, state, found), Offsets.of_points(block, state, points)
    of_poses, of_points = _poses(block, state, found), _points(offsets[1])
    middle = [_middle(wrong, *offsets) for wrong in search.blocks]
    pose_owner = _owners(of_poses, [wrong.poses for wrong in search.blocks], middle, probability)
    point_owner = _owners(of_points, [wrong.points for wrong in search.blocks], middle, probability)
    blocks, limit = [], search_limit(len(block.station_ids))
    for k in range(len(search.blocks)):
        mine, given = np.flatnonzero(pose_owner == k), np.flatnonzero(point_owner == k)
        if not len(mine) and len(given) < FEWEST_POINTS:
            point_owner[given] = -1
            continue
        members = offsets[0].take(mine) if len(mine) else offsets[1].take(given)
        one = named(block, members, bool(len(mine)), reference_m**2, limit)
        if one.statistic > limit:
            blocks.append(one)
        else:
            point_owner[given] = -1
    alone = np.flatnonzero((point_owner < 0) & (offsets[1].squares() > chi2.isf(_CONTRADICTS, 3)))
    blocks += clusters(block, offsets[1].take(alone), reference_m**2, limit)
    blocks = _joined(blocks, block)
    tested = len(of_poses.row) + len(of_points.row)
    return CoherentSearch(tuple(blocks), search.undecidable or _as_many(blocks, block, tested))


def _as_many(blocks: list[CoherentBlock], block: Block, tested: int) -> bool:
    """Whether about as many rows as are left agree in one shift, and nothing else says where the block is."""
    control = block.point_priors.kind == KINDS_OF_POINT.index("control")
    if not blocks or len(block.position_priors) or control.any():
        return False
    counts = [len(b.poses) + len(b.points) for b in blocks]
    return max(counts) >= LARGE_SHARE * (tested - sum(counts))


def _middle(wrong: CoherentBlock, poses: Offsets, points: Offsets) -> Array:
    """The median (3,) of the offsets that a block names: some of them are not its own."""
    inside = np.isin(poses.row, wrong.poses), np.isin(points.row, wrong.points)
    return cast(Array, np.median(np.concatenate([poses.off_m[inside[0]], points.off_m[inside[1]]]), axis=0))


def _joined(blocks: list[CoherentBlock], block: Block) -> list[CoherentBlock]:
    """Blocks of one kind and of the same shift whose stations adjoin, or whose points lie near each other as those seen
    from two passages of a street do, made one; in the order of their stations, poses first."""
    at = {name: i for i, name in enumerate(block.station_ids)}
    left = sorted(blocks, key=lambda b: (len(b.points) > 0, at[b.station_ids[0]]))
    out: list[CoherentBlock] = []
    while left:
        here = left.pop(0)
        while (k := next((k for k, b in enumerate(left) if _one_piece(here, b, block, at)), -1)) >= 0:
            here = _merged(here, left.pop(k), block)
        out.append(here)
    return out


def _one_piece(a: CoherentBlock, b: CoherentBlock, block: Block, at: dict[str, int]) -> bool:
    """Whether blocks are of one kind, their shifts may be the same, and nothing is between them."""
    off, cov = a.shift_m - b.shift_m, a.cov + b.cov
    if bool(len(a.points)) != bool(len(b.points)) or off @ np.linalg.solve(cov, off) > chi2.ppf(_SAME, 3):
        return False
    stations = [np.array([at[name] for name in c.station_ids]) for c in (a, b)]
    if np.abs(stations[0][:, None] - stations[1]).min() <= _SEAM:
        return True
    places = [block.point_priors.position[c.points] for c in (a, b)]
    return len(a.points) > 0 and float(KDTree(places[0]).query(places[1])[0].min()) <= _NEAR_M


def _merged(a: CoherentBlock, b: CoherentBlock, block: Block) -> CoherentBlock:
    """Both as one, the shifts weighted."""
    weights = np.linalg.inv(a.cov), np.linalg.inv(b.cov)
    cov = cast(Array, np.linalg.inv(weights[0] + weights[1]))
    points = np.union1d(a.points, b.points)
    return CoherentBlock(
        *(
            tuple(sorted({*a.station_ids, *b.station_ids}, key=block.station_ids.index)),
            np.union1d(a.poses, b.poses),
            points,
        ),
        *(references_of(block, points), cov @ (weights[0] @ a.shift_m + weights[1] @ b.shift_m), cov),
        *(max(a.statistic, b.statistic), min(a.detectable_m, b.detectable_m)),
    )


def _owners(candidates: _Candidates, named: list[Indices], shifts: list[Array], probability: float) -> Indices:
    """The block (K,) that each candidate belongs to, or -1, by the rows that each names and its shift."""
    limit = float(chi2.ppf(probability, candidates.dof))
    count = len(candidates.row)
    given = candidates.statistic(np.arange(count), np.zeros(3))
    owner, best, own = np.full(count, -1), np.full(count, np.inf), np.full(count, -1)
    for k, (rows, shift) in enumerate(zip(named, shifts, strict=True)):
        mine = np.flatnonzero(np.isin(candidates.row, rows))
        if not len(mine):
            continue
        corrected = candidates.statistic(mine, shift)
        own[mine[~((given[mine] <= limit) & (given[mine] <= corrected))]] = k
        first, last = candidates.station[mine].min() - _SEAM, candidates.station[mine].max() + _SEAM
        near = np.flatnonzero((candidates.station >= first) & (candidates.station <= last) & ~(given <= limit))
        corrected = candidates.statistic(near, shift)
        better = (corrected <= limit) & (corrected < best[near])
        owner[near[better]], best[near[better]] = k, corrected[better]
    return np.where(owner >= 0, owner, own)


def _poses(block: Block, state: State, found: Cofactors) -> _Candidates:
    """r' (S + A Q A')^-1 r of localized poses that the adjustment lacks."""
    priors = block.pose_priors
    row = np.flatnonzero(priors.kind == KINDS_OF_POSE.index("localized"))

    def statistic(chosen: Indices, shift: Array) -> Array:
        if not len(chosen):
            return np.zeros(0)
        taken = priors.take(_mask(row[chosen], len(priors)))
        back = replace(taken.world_from_cam, translation=taken.world_from_cam.translation - shift)
        only = replace(block, pose_priors=replace(taken, world_from_cam=back))
        (term,) = (t for t in constraint_terms(only, state, found.layout) if t.name == POSE_PRIORS)
        return _squares(term.residual, np.eye(6) + fitted_cofactor(term, found))

    return _Candidates(row, block.station[block.pose_priors.image[row]], 6, statistic)


def _points(offsets: Offsets) -> _Candidates:
    """The same of automatic GCPs."""
    return _Candidates(
        *(offsets.row, offsets.station, 3),
        lambda chosen, shift: offsets.take(chosen).squares(shift),
    )


def _squares(residual: Array, cov: Array) -> Array:
    return np.einsum("ki,ki->k", residual, np.linalg.solve(cov, residual[:, :, None])[:, :, 0])


def _mask(rows: Indices, count: int) -> NDArray[np.bool_]:
    out = np.zeros(count, bool)
    out[rows] = True
    return out
