"""Fewer, less correlated components: principal axes of the reference's own rows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh

from georef.features.globals.base import unit_or_even_rows


@dataclass(frozen=True, eq=False)
class Whitening:
    """rows -> unit((rows - mean) @ axes.T), padded with zeros to `size`."""

    mean: NDArray[np.float32]  # (D,)
    axes: NDArray[np.float32]  # (k, D), each over the standard deviation along it; k at most `size`
    size: int

    def apply(self, rows: NDArray[np.floating]) -> NDArray[np.float32]:
        """Rows (N, D) as unit rows (N, size)."""
        out = np.zeros((len(rows), self.size), np.float32)
        out[:, : len(self.axes)] = (np.asarray(rows, np.float32) - self.mean) @ self.axes.T
        return unit_or_even_rows(out)


def learn_whitening(rows: NDArray[np.float32], size: int) -> Whitening:
    """Whitening learned from rows (n, D): the `size` principal axes, or all n - 1 of them where the rows are few.

    Few rows: they lie in the space of their n - 1 axes, in which every dot product of a query with one of them is
    complete, so nothing is lost for them; what is missing to `size` is zero. But full whitening would make n = k + 1
    rows equally far from each other, which says nothing about their places. The variances along the k axes are
    therefore drawn towards their mean by the share k / n, the number of variances over that of the rows that tell them:
    a mere rotation for n = k + 1, nearly full whitening for n far above k.
    Raises ValueError for fewer than two different rows.
    """
    mean = rows.mean(0, dtype=np.float64).astype(np.float32)
    centred = rows - mean
    variances, axes = _principal(centred, size)
    shrunk = _shrunk(variances, len(rows))
    return Whitening(mean, (axes / np.sqrt(shrunk)[:, None]).astype(np.float32), size)


def _principal(centred: NDArray[np.float32], size: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Variances (k,), falling, and unit axes (k, D), through the smaller of the two products."""
    count, dimension = centred.shape
    wide = count <= dimension
    product = (centred @ centred.T if wide else centred.T @ centred).astype(np.float64) / count
    last = len(product) - 1
    values, vectors = eigh(product, subset_by_index=(max(0, last - size + 1), last), overwrite_a=True)
    values, vectors = values[::-1], vectors[:, ::-1]
    keep = min(size, count - 1, int(np.count_nonzero(values > 1e-6 * max(values[0], 1e-30))))
    if keep < 1:
        raise ValueError(f"whitening needs at least two different rows, got {count}")
    axes = vectors[:, :keep].T
    if wide:
        axes = axes @ centred / np.sqrt(count * values[:keep])[:, None]
    return values[:keep], axes


def _shrunk(variances: NDArray[np.float64], count: int) -> NDArray[np.float64]:
    share = len(variances) / count
    return (1 - share) * variances + share * variances.mean()
