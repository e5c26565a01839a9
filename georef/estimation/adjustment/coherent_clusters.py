"""Few points that are wrong by one shift: single contradictions near each other that turn out to be the same.

A stretch of two or three stations is too short to stand out against its neighbours on the drive. Gates reject its
points one by one; that they agree with each other says that they have one cause.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from georef.estimation.adjustment.block import KINDS_OF_POINT, Block, Indices, State
from georef.estimation.adjustment.coherent import FEWEST_POINTS, CoherentBlock, detectable, references_of
from georef.estimation.adjustment.shift_rows import AUTOMATIC, stations_of_points
from georef.geometry.rigid import Array

_REACH = 30  # contradicting points before and after that are compared with one
_STATIONS = 10  # that two of a cluster may be apart
_AGREES = 0.99


@dataclass(frozen=True, eq=False)
class PointOffsets:
    """How far given points are from where all else puts them, in the order of their stations."""

    row: Indices  # (K,) of the point priors
    station: Indices  # (K,)
    off_m: Array  # (K, 3) given minus adjusted
    cov: Array  # (K, 3, 3); NaN where nothing else determines the point

    @staticmethod
    def of(block: Block, state: State, points: Array) -> PointOffsets:
        """Of the automatic GCPs; points: cofactors (P, 3, 3) of an adjustment without the doubtful ones."""
        priors = block.point_priors
        station = stations_of_points(block)[priors.point]
        row = np.flatnonzero((priors.kind == KINDS_OF_POINT.index(AUTOMATIC)) & (station >= 0))
        row = row[np.argsort(station[row], kind="stable")]
        point = priors.point[row]
        cov = np.linalg.inv(priors.information[row]) + points[point]
        return PointOffsets(row, station[row], priors.position[row] - state.points[point], cov)

    def take(self, chosen: Indices) -> PointOffsets:
        return PointOffsets(self.row[chosen], self.station[chosen], self.off_m[chosen], self.cov[chosen])

    def squares(self, shift: Array | float = 0.0, shift_cov: Array | float = 0.0) -> Array:
        """Their statistics (K,), 3 degrees of freedom, with a shift of a covariance taken off."""
        off = self.off_m - shift
        return np.einsum("ki,ki->k", off, np.linalg.solve(self.cov + shift_cov, off[:, :, None])[:, :, 0])


def clusters(block: Block, offsets: PointOffsets, shared: float, limit: float) -> list[CoherentBlock]:
    """Blocks among single contradictions, the largest first; each of three points or more whose common shift has a
    statistic above a limit, `shared` being the variance that what is right may have in common."""
    known = np.flatnonzero(np.isfinite(offsets.cov).all(axis=(1, 2)))
    left, found = offsets.take(known), []
    while len(left.row) >= FEWEST_POINTS:
        agree = _agreement(left)
        members = np.flatnonzero(agree[np.argmax(agree.sum(axis=1))])
        if len(members) < FEWEST_POINTS:
            break
        named = _named(block, left.take(members), shared, limit)
        found += [named] if named.statistic > limit else []
        left = left.take(np.delete(np.arange(len(left.row)), members))
    return found


def _agreement(offsets: PointOffsets) -> Array:
    """Which (K, K) are near each other and may have the same offset; each with itself."""
    count = len(offsets.row)
    agree, limit = np.eye(count, dtype=bool), float(chi2.ppf(_AGREES, 3))
    for step in range(1, min(_REACH, count - 1) + 1):
        a, b = np.arange(count - step), np.arange(step, count)
        off = offsets.off_m[a] - offsets.off_m[b]
        square = np.einsum("ki,ki->k", off, np.linalg.solve(offsets.cov[a] + offsets.cov[b], off[:, :, None])[:, :, 0])
        same = (square <= limit) & (offsets.station[b] - offsets.station[a] <= _STATIONS)
        agree[a[same], b[same]] = agree[b[same], a[same]] = True
    return agree


def _named(block: Block, members: PointOffsets, shared: float, limit: float) -> CoherentBlock:
    """Its shift is the weighted mean; what the points' places have in common is taken to be all of their covariance."""
    own = np.linalg.inv(block.point_priors.information[members.row])
    weight = np.linalg.inv(members.cov)
    mean = np.linalg.inv(weight.sum(axis=0))
    shift = mean @ np.einsum("kij,kj->i", weight, members.off_m)
    cov = mean + np.median(members.cov - own, axis=0)
    statistic = float(shift @ np.linalg.solve(cov + shared * np.eye(3), shift))
    names = tuple(block.station_ids[i] for i in np.unique(members.station))
    rows = np.sort(members.row)
    none = np.zeros(0, np.int64)
    least = detectable(shift, statistic, limit)
    return CoherentBlock(names, none, rows, references_of(block, rows), shift, cov, statistic, least)
