"""Mutual nearest neighbours in descriptor space, and the similarity that other ways of matching use too."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from georef.features.base import Descriptors
from georef.types.features import Features, Matches


def unit_rows(descriptors: Descriptors) -> NDArray[np.float32]:
    """Descriptors (N, D) of any stored type as float32 rows of length 1; a zero row stays zero."""
    rows = descriptors.astype(np.float32)
    norms = np.linalg.norm(rows, axis=1, keepdims=True)
    return rows / np.maximum(norms, np.float32(1e-12))


def similarity(a: Descriptors, b: Descriptors) -> NDArray[np.float32]:
    """Cosine similarity (N, M) in [-1, 1] of descriptors (N, D) and (M, D): uint8 RootSIFT, float16 or float32."""
    return unit_rows(a) @ unit_rows(b).T


class MutualNearest:
    """Pairs that are each other's nearest neighbour, with a ratio test in both directions.

    ratio: distance to the nearest over distance to the second nearest must be below it; None leaves the test out.
    min_similarity: cosine similarity below which nothing matches. chunk: rows compared at once
    (memory: chunk x M x 4 bytes).
    """

    name = "mutual-nn"

    def __init__(self, *, ratio: float | None = 0.9, min_similarity: float = 0.0, chunk: int = 2048) -> None:
        self._ratio = ratio
        self._min_similarity = min_similarity
        self._chunk = chunk

    def version(self) -> str:
        return f"mutual-nn-1 ratio={self._ratio} min_similarity={self._min_similarity}"

    def match(self, a: Features, b: Features) -> Matches:
        """Matches with the cosine similarity as score, clipped to [0, 1]."""
        if len(a) == 0 or len(b) == 0:
            return Matches.empty()
        rows_a, rows_b = unit_rows(a.descriptors), unit_rows(b.descriptors)
        nearest_b, best_a, second_a = _two_best(rows_a, rows_b, self._chunk)
        nearest_a, best_b, second_b = _two_best(rows_b, rows_a, self._chunk)
        rows = np.arange(len(a))
        keep = (nearest_a[nearest_b] == rows) & (best_a >= self._min_similarity)
        if self._ratio is not None:
            keep &= _distinct(best_a, second_a, self._ratio)
            keep &= _distinct(best_b, second_b, self._ratio)[nearest_b]
        indices = np.stack([rows[keep], nearest_b[keep]], axis=1).astype(np.int32)
        return Matches(indices, np.clip(best_a[keep], 0, 1).astype(np.float32))


def _two_best(
    a: NDArray[np.float32], b: NDArray[np.float32], chunk: int
) -> tuple[NDArray[np.int64], NDArray[np.float32], NDArray[np.float32]]:
    """For every row of a: the most similar row of b, its similarity, and that of the second (-2: none)."""
    index = np.empty(len(a), np.int64)
    best, second = np.empty(len(a), np.float32), np.empty(len(a), np.float32)
    for start in range(0, len(a), chunk):
        part = slice(start, min(start + chunk, len(a)))
        block = a[part] @ b.T
        rows = np.arange(len(block))
        index[part] = block.argmax(axis=1)
        best[part] = block[rows, index[part]]
        block[rows, index[part]] = -2
        second[part] = block.max(axis=1)
    return index, best, second


def _distinct(best: NDArray[np.float32], second: NDArray[np.float32], ratio: float) -> NDArray[np.bool_]:
    """Whether the distance |u - v| = sqrt(2 - 2 cos) of the best is below ratio times that of the second best."""
    return (1 - best) < ratio**2 * (1 - second)
