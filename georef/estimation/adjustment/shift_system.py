"""How far given poses are shifted, stretch by stretch of the trajectory: the normal equations of such shifts alone.

A shift d (m, in world) of all given poses of a stretch enters their residuals by a design C. With everything else
eliminated, its normal matrix is C' P Qvv P C and its right side C' P v, whatever else is adjusted; those of all
stretches together make one small system, in which any hypothesis about wrong stretches is a few sums. Baarda's mean
shift model (1968) with groups of observations; Teunissen, "Testing theory" (2000), chapter 4.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, cast

import numpy as np
from scipy.sparse import coo_array, csr_array

from georef.estimation.adjustment.block import KINDS_OF_POSE, Block, Indices, State
from georef.estimation.adjustment.cofactors import Cofactors
from georef.estimation.adjustment.constraint_terms import POSE_PRIORS, Term, constraint_terms, whitening
from georef.geometry.rigid import Array

_MOST_SEGMENTS = 1200  # a search over all runs of them stays cheap
_CHUNK = 300  # solutions at a time


@dataclass(frozen=True, eq=False)
class ShiftSystem:
    """Normal equations M s = b of a shift s (m, world) for each of n segments, in the order of the stations.

    information: (3 n, 3 n); right: (3 n,); segment (K,): of each row tested, rows (K,) of the block's pose priors.
    """

    information: Array
    right: Array
    segment: Indices
    rows: Indices

    def __len__(self) -> int:
        return len(self.right) // 3

    def estimate(self, design: Array) -> tuple[Array, Array, float]:
        """Shifts (k, 3) common to sets of segments, their joint covariance (3 k, 3 k), and by how much they lower the
        squared residuals. design: (n, k), 1 where a segment belongs to a set."""
        wide = np.kron(design, np.eye(3))
        cov = cast(Array, np.linalg.pinv(wide.T @ self.information @ wide, rcond=1e-10, hermitian=True))
        right = wide.T @ self.right
        shifts = cov @ right
        return shifts.reshape(-1, 3), cov, float(right @ shifts)

    def given(self, design: Array) -> ShiftSystem:
        """The system once shifts common to sets of segments (n, k) are estimated along."""
        if not design.shape[1]:
            return self
        wide = np.kron(design, np.eye(3))
        across = self.information @ wide
        gain = across @ np.linalg.pinv(wide.T @ across, rcond=1e-10, hermitian=True)
        return ShiftSystem(
            self.information - gain @ across.T, self.right - gain @ (wide.T @ self.right), self.segment, self.rows
        )


def pose_shifts(block: Block, state: State, found: Cofactors, gradient: Array) -> ShiftSystem | None:
    """The system of all localized poses; None where there are none. found, gradient: of the normal equations at the
    state without robust losses."""
    terms = [t for t in constraint_terms(block, state, found.layout) if t.name == POSE_PRIORS]
    rows = np.flatnonzero(block.pose_priors.kind == KINDS_OF_POSE.index("localized"))
    if not terms or not len(rows):
        return None
    segment = _segments(block.station[block.pose_priors.image[rows]])
    rotation = block.pose_priors.world_from_cam.rotation[rows]
    weight = whitening(block.pose_priors.cov[rows])
    design = -weight[:, :, 3:] @ np.swapaxes(rotation, 1, 2)
    return _system(terms[0], rows, segment, design, found, gradient)


def _segments(station: Indices) -> Indices:
    """Number of each row's segment: a station each, or a few neighbouring ones if there are many."""
    names, number = np.unique(station, return_inverse=True)
    return (number // (1 + (len(names) - 1) // _MOST_SEGMENTS)).astype(np.int64)


def _system(
    term: Term, rows: Indices, segment: Indices, design: Array, found: Cofactors, gradient: Array
) -> ShiftSystem:
    count = int(segment.max()) + 1
    across = _across(term, rows, segment, design, found.layout.size, count)
    right = np.zeros((count, 3))
    np.add.at(right, segment, np.einsum("kmi,km->ki", design, term.residual[rows]))
    step = found.apply(gradient)
    own = np.zeros((count, 3, 3))
    np.add.at(own, segment, np.swapaxes(design, 1, 2) @ design)
    information = np.zeros((3 * count, 3 * count))
    turned = csr_array(across.T)
    for begin in range(0, 3 * count, _CHUNK):
        chunk = slice(begin, min(begin + _CHUNK, 3 * count))
        information[:, chunk] = -(turned @ found.apply(_dense(across[:, chunk])))
    at = np.arange(count)
    information.reshape(count, 3, count, 3)[at, :, at, :] += own
    return ShiftSystem(0.5 * (information + information.T), right.ravel() - np.asarray(turned @ step), segment, rows)


def _across(term: Term, rows: Indices, segment: Indices, design: Array, size: int, count: int) -> Any:
    """J'C, sparse (unknowns, 3 n)."""
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


def _dense(matrix: Any) -> Array:
    return cast(Array, matrix.toarray())
