"""The reduced normal equations of a block: points eliminated, stations sparse, everything shared in a dense border."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from georef.estimation.adjustment.block import Block, Indices
from georef.geometry.rigid import Array


@dataclass(frozen=True, eq=False)
class Layout:
    """Where unknowns stand in the reduced system: station i at 6 i, then the border.

    The border holds mountings that are not held (6 each), unknown parameters of calibrations, lever arms that are not
    held (3), drift nodes (3) and kept points (3; those that a measured distance ends at, which elimination one by one
    cannot take), in this order. -1: held, or eliminated.
    """

    stations: int
    mounting: Indices  # (R,) first unknown of each mounting, counted from the start of the border
    calibration: Indices  # (C,)
    antenna: Indices  # (A,)
    drift: Indices  # (D,)
    kept_point: Indices  # (P,)
    border: int  # unknowns in it

    @staticmethod
    def of(block: Block) -> Layout:
        ends = np.zeros(len(block.points), bool)
        ends[block.distances.a] = ends[block.distances.b] = True
        groups = (
            [0 if m.information is None else 6 for m in block.mountings],
            [len(c.camera.estimate) for c in block.calibrations],
            [0 if a.information is None else 3 for a in block.antennas],
            [3] * len(block.drift_information),
            np.where(ends, 3, 0).tolist(),
        )
        sizes = np.array([size for group in groups for size in group], dtype=np.int64)
        starts = np.where(sizes > 0, np.cumsum(sizes) - sizes, -1)
        parts = np.split(starts, np.cumsum([len(group) for group in groups])[:-1])
        return Layout(len(block.station_ids), *parts, border=int(sizes.sum()))

    @property
    def size(self) -> int:
        """Unknowns of the reduced system."""
        return 6 * self.stations + self.border


@dataclass(frozen=True, eq=False)
class Reduced:
    """Normal matrix and gradient (of half the squared residuals) at a state, points eliminated.

    The stations' part is symmetric block sparse, its upper triangle in block rows: row i holds the blocks
    `first[i] : first[i + 1]`, of which the first is the diagonal one and the others follow with rising columns.
    """

    layout: Layout
    first: Indices  # (S + 1,)
    column: Indices  # (N,)
    block: Array  # (N, 6, 6)
    border: Array  # (6 S, B) stations by border
    corner: Array  # (B, B)
    gradient: Array  # (6 S + B,)

    def dense(self) -> Array:
        """The whole normal matrix (6 S + B, 6 S + B): for small blocks and tests."""
        count = self.layout.stations
        out = np.zeros((self.layout.size, self.layout.size))
        for row in range(count):
            for entry in range(self.first[row], self.first[row + 1]):
                here, there = slice(6 * row, 6 * row + 6), slice(6 * self.column[entry], 6 * self.column[entry] + 6)
                out[here, there] = self.block[entry]
                out[there, here] = self.block[entry].T
        stations = 6 * count
        out[:stations, stations:], out[stations:, :stations] = self.border, self.border.T
        out[stations:, stations:] = self.corner
        return out
