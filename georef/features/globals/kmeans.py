"""Centres of a cloud of vectors."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_CHUNK = 16384  # rows whose distances to all centres exist at once


def kmeans(
    rows: NDArray[np.float32], count: int, seed: int = 0, max_iterations: int = 30, tolerance: float = 1e-4
) -> NDArray[np.float32]:
    """`count` centres (K, D) of rows (N, D): k-means++ seeds (Arthur and Vassilvitskii 2007), then Lloyd's iterations.

    Stops when the mean squared distance falls by less than `tolerance` of itself. A centre that loses all its rows
    takes the row that is farthest from its own. The same rows and seed give the same centres.
    Raises ValueError for fewer rows than centres.
    """
    if len(rows) < count:
        raise ValueError(f"{count} centres need at least as many rows, got {len(rows)}")
    centres, before = _seeds(rows, count, np.random.default_rng(seed)), np.inf
    for _ in range(max_iterations):
        nearest, squared = assign(rows, centres)
        spread = float(squared.mean())
        if before - spread <= tolerance * before < np.inf:
            break
        centres, before = _means(rows, nearest, squared, count), spread
    return centres


def assign(rows: NDArray[np.float32], centres: NDArray[np.float32]) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """The nearest centre (N,) of each row, and the squared distance (N,) to it."""
    norms = (centres * centres).sum(1)
    nearest, squared = np.zeros(len(rows), np.int64), np.zeros(len(rows), np.float32)
    for start in range(0, len(rows), _CHUNK):
        part = rows[start : start + _CHUNK]
        partial = norms - 2 * (part @ centres.T)
        best = partial.argmin(1)
        nearest[start : start + _CHUNK] = best
        squared[start : start + _CHUNK] = partial[np.arange(len(part)), best] + (part * part).sum(1)
    return nearest, np.maximum(squared, 0)


def _seeds(rows: NDArray[np.float32], count: int, random: np.random.Generator) -> NDArray[np.float32]:
    chosen = [int(random.integers(len(rows)))]
    squared = ((rows - rows[chosen[0]]) ** 2).sum(1)
    while len(chosen) < count:
        total = np.cumsum(squared, dtype=np.float64)
        if total[-1] > 0:
            chosen.append(int(min(np.searchsorted(total, random.random() * total[-1], "right"), len(rows) - 1)))
        else:  # fewer different rows than centres
            chosen.append(int(random.integers(len(rows))))
        squared = np.minimum(squared, ((rows - rows[chosen[-1]]) ** 2).sum(1))
    return rows[chosen].copy()


def _means(
    rows: NDArray[np.float32], nearest: NDArray[np.int64], squared: NDArray[np.float32], count: int
) -> NDArray[np.float32]:
    held = np.bincount(nearest, minlength=count)
    sums = np.zeros((count, rows.shape[1]), np.float64)
    order = np.argsort(nearest, kind="stable")
    filled = np.flatnonzero(held)
    starts = np.concatenate([[0], np.cumsum(held[filled])[:-1]])
    sums[filled] = np.add.reduceat(rows[order], starts, axis=0, dtype=np.float64)
    centres = sums / np.maximum(held, 1)[:, None]
    empty = np.flatnonzero(held == 0)
    centres[empty] = rows[np.argsort(-squared, kind="stable")[: len(empty)]]
    return centres.astype(np.float32)
