"""How far given poses and points are shifted, stretch by stretch of a drive: the normal equations of such shifts alone.

A shift d (m, in world) of all that is given in a stretch enters its residuals by a design C. With everything else
eliminated, its normal matrix is C' P Qvv P C and its right side C' P v, whatever else is adjusted; those of all
stretches together make one small system, in which any hypothesis about wrong stretches is a few sums. Baarda's mean
shift model (1968) with groups of observations; Teunissen, "Testing theory" (2000), chapter 4.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np
from scipy.sparse import csr_array

from georef.estimation.adjustment.block import Indices
from georef.geometry.rigid import Array


@dataclass(frozen=True, eq=False)
class Members:
    """Rows of the given poses or points of a block that are tested, where each stands on the drive."""

    row: Indices  # (K,)
    station: Indices  # (K,)
    segment: Indices  # (K,)

    @staticmethod
    def none() -> Members:
        nothing = np.zeros(0, np.int64)
        return Members(nothing, nothing, nothing)


@dataclass(frozen=True, eq=False)
class ShiftSystem:
    """Normal equations M s = b of a shift s (m, world) for each of n segments, in the order of the stations.

    information: (3 n, 3 n); right: (3 n,). spans: segments [begin, end) of one kind each, poses and points: what is
    wrong together is of one kind.
    """

    information: Array
    right: Array
    poses: Members
    points: Members
    spans: tuple[tuple[int, int], ...]

    def __len__(self) -> int:
        return len(self.right) // 3

    @property
    def members(self) -> Indices:
        """How many rows each segment (n,) has."""
        return np.bincount(np.concatenate([self.poses.segment, self.points.segment]), minlength=len(self))

    def estimate(self, design: Array) -> tuple[Array, Array, float]:
        """Shifts (k, 3) common to sets of segments, their joint covariance (3 k, 3 k), and by how much they lower the
        squared residuals. design: (n, k), 1 where a segment belongs to a set."""
        information, right = self._summed(design)
        cov = cast(Array, np.linalg.pinv(information, rcond=1e-10, hermitian=True))
        shifts = cov @ right
        return shifts.reshape(-1, 3), cov, float(right @ shifts)

    def given(self, design: Array) -> ShiftSystem:
        """The system once shifts common to sets of segments (n, k) are estimated along."""
        wide = _wide(design)
        across = np.asarray(self.information @ wide)
        information, right = wide.T @ across, wide.T @ self.right
        gain = across @ np.linalg.pinv(information, rcond=1e-10, hermitian=True)
        return replace(self, information=self.information - gain @ across.T, right=self.right - gain @ right)

    def grouped(self, group: Indices, groups: int) -> ShiftSystem:
        """The system of segments joined: group (n,) of each, -1 for none, which then has no shift."""
        segments = np.flatnonzero(group >= 0)
        design = csr_array((np.ones(len(segments)), (segments, group[segments])), shape=(len(self), groups))
        information, right = self._summed(design)

        def moved(members: Members) -> Members:
            kept = group[members.segment] >= 0
            return Members(members.row[kept], members.station[kept], group[members.segment[kept]])

        return ShiftSystem(information, right, moved(self.poses), moved(self.points), ())

    def _summed(self, design: Any) -> tuple[Array, Array]:
        wide = _wide(design)
        return wide.T @ np.asarray(self.information @ wide), wide.T @ self.right


def _wide(design: Any) -> Any:
    """(3 n, 3 k) of (n, k): the same for each coordinate."""
    sets: Any = csr_array(design).tocoo()
    row, column = (3 * i[:, None] + np.arange(3) for i in sets.coords)
    values = np.repeat(sets.data, 3)
    return csr_array((values, (row.ravel(), column.ravel())), shape=(3 * sets.shape[0], 3 * sets.shape[1]))
