"""Cofactors of a block: the inverse of its normal matrix, where it is asked for.

All stations and all pairs of stations that share points come at once (selected inverse), the border whole; anything
else by solving. Stations and border are inverted exactly together, the border by its Schur complement:
with N = [[A, C], [C', D]], X = A^-1 C and Q_B = (D - C' X)^-1, the rest is Q_SB = -X Q_B and Q_SS = A^-1 + X Q_B X'.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from georef.estimation.adjustment.block import Block, Indices, State
from georef.estimation.adjustment.equations.block_cholesky import (
    VANISHING_PIVOT,
    BlockCholesky,
    Pattern,
    SingularMatrix,
)
from georef.estimation.adjustment.equations.reduced import Layout, Reduced
from georef.geometry.covariance import symmetric
from georef.geometry.rigid import Array


@dataclass(frozen=True, eq=False)
class Cofactors:
    """The inverse of a reduced normal matrix: covariances for the stated sigmas.

    first, column: the pattern of `Reduced`; pair (N, 6, 6): the blocks of the inverse in it, of rows' stations with
    columns' ones.
    """

    layout: Layout
    first: Indices  # (S + 1,)
    column: Indices  # (N,)
    pair: Array  # (N, 6, 6)
    station_border: Array  # (6 S, B)
    border: Array  # (B, B)
    factor: BlockCholesky  # of the stations alone, the border held
    by_border: Array  # (6 S, B) X: A^-1 C

    @property
    def stations(self) -> Array:
        """Covariances (S, 6, 6) of all stations, right perturbations of world_from_rig."""
        return self.pair[self.first[:-1]]

    def apply(self, vectors: Array) -> Array:
        """The inverse times vectors (6 S + B,) or (6 S + B, m)."""
        count = 6 * self.layout.stations
        own = self.factor.solve(vectors[:count])
        if not self.layout.border:
            return own
        shared = self.border @ (vectors[count:] - self.by_border.T @ vectors[:count])
        return np.concatenate([own - self.by_border @ shared, shared])

    def joint(self, unknowns: Indices) -> Array:
        """Joint covariance (k, k) of any unknowns of the reduced system, by solving."""
        units = np.zeros((self.layout.size, len(unknowns)))
        units[unknowns, np.arange(len(unknowns))] = 1.0
        return symmetric(self.apply(units)[unknowns])

    def joint_stations(self, stations: Indices) -> Array:
        """Joint covariance (6 k, 6 k) of a few stations."""
        return self.joint((6 * np.asarray(stations)[:, None] + np.arange(6)).ravel())

    def between(self, a: Indices, size_a: int, b: Indices, size_b: int) -> Array:
        """Covariances (K, size_a, size_b) of groups of unknowns that begin at a (K,) with ones that begin at b (K,).

        Stations must be of a pair in the pattern (KeyError); -1 is a group that is held: zeros.
        """
        out, edge = np.zeros((len(a), size_a, size_b)), 6 * self.layout.stations
        if not len(a):
            return out
        there = (a >= 0) & (b >= 0)
        of_stations = there & (a < edge) & (b < edge)
        if of_stations.any():
            out[of_stations] = self._pairs(a[of_stations] // 6, b[of_stations] // 6)
        rows, columns = a[:, None] + np.arange(size_a), b[:, None] + np.arange(size_b)
        for here, matrix, i, j in (
            (there & (a < edge) & (b >= edge), self.station_border, rows, columns - edge),
            (there & (a >= edge) & (b < edge), self.station_border.T, rows - edge, columns),
            (there & (a >= edge) & (b >= edge), self.border, rows - edge, columns - edge),
        ):
            out[here] = matrix[i[here][:, :, None], j[here][:, None, :]]
        return out

    def _pairs(self, a: Indices, b: Indices) -> Array:
        """Covariances (K, 6, 6) of stations a with stations b."""
        low, high = np.minimum(a, b), np.maximum(a, b)
        row = np.repeat(np.arange(self.layout.stations), np.diff(self.first))
        keys, wanted = row * self.layout.stations + self.column, low * self.layout.stations + high
        entry = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
        if (keys[entry] != wanted).any():
            raise KeyError("stations that no constraint and no point connects: ask for their joint covariance")
        found = self.pair[entry]
        return np.where((a > b)[:, None, None], np.swapaxes(found, 1, 2), found)

    def images(self, block: Block, state: State, images: Indices | None = None) -> Array:
        """Covariances (K, 6, 6) of world_from_cam of images (all of them if None), right perturbations: those of the
        stations with what is not known of the mountings, and their correlation."""
        taken = np.arange(len(block.image_ids)) if images is None else images
        mounting = block.mounting[taken]
        by_station = state.rig_from_cam.take(mounting).inverse().adjoint()
        first = self.layout.mounting[mounting]
        border = np.where(first >= 0, 6 * self.layout.stations + first, -1)
        at = 6 * block.station[taken]
        across = by_station @ self.between(at, 6, border, 6)
        own = by_station @ self.stations[block.station[taken]] @ np.swapaxes(by_station, 1, 2)
        return symmetric(own + across + np.swapaxes(across, 1, 2) + self.between(border, 6, border, 6))


def cofactors(reduced: Reduced, pattern: Pattern | None = None) -> Cofactors:
    """Inverts normal equations; `pattern` saves time where it is known of an earlier state. Raises SingularMatrix."""
    factor = BlockCholesky.of(pattern or Pattern.of(reduced.first, reduced.column), reduced.block)
    solved = factor.solve(reduced.border)
    border = _border_inverse(reduced, solved)
    pair = factor.selected_inverse()
    across = -solved @ border
    if reduced.layout.border:
        row = np.repeat(np.arange(reduced.layout.stations), np.diff(reduced.first))
        blocks = (-across.reshape(-1, 6, reduced.layout.border), solved.reshape(-1, 6, reduced.layout.border))
        for chunk in np.array_split(np.arange(len(row)), 1 + len(row) // 10_000):
            pair[chunk] += blocks[0][row[chunk]] @ np.swapaxes(blocks[1][reduced.column[chunk]], 1, 2)
    return Cofactors(reduced.layout, reduced.first, reduced.column, pair, across, border, factor, solved)


def _border_inverse(reduced: Reduced, solved: Array) -> Array:
    """(D - C' A^-1 C)^-1 (B, B). Raises SingularMatrix."""
    size, edge = reduced.layout.border, 6 * reduced.layout.stations
    if not size:
        return np.zeros((0, 0))
    whole = np.diag(reduced.corner)
    if (whole <= 0).any():
        raise SingularMatrix(edge + int(np.flatnonzero(whole <= 0)[0]))
    scale = 1.0 / np.sqrt(whole)
    schur = symmetric(reduced.corner - reduced.border.T @ solved) * scale[:, None] * scale
    try:
        factor = cho_factor(schur, lower=True)
    except np.linalg.LinAlgError:
        raise SingularMatrix(edge + _weakest(schur)) from None
    low = np.square(np.diag(factor[0])) < VANISHING_PIVOT
    if low.any():
        raise SingularMatrix(edge + int(np.flatnonzero(low)[0]))
    return symmetric(cast(Array, cho_solve(factor, np.eye(size)))) * scale[:, None] * scale


def _weakest(matrix: Array) -> int:
    """The unknown that stands out most in the direction that a matrix leaves open."""
    return int(np.argmax(np.abs(np.linalg.eigh(matrix)[1][:, 0])))
