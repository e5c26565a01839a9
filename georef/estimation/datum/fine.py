"""Small differences between paired positions: which of a shift, an antenna offset, a turn and a scale explain them.

Errors of neighbouring positions go together (GNSS drifts), so that N positions are far from N independent ones.
Positions are averaged over stretches of the drive, and a regression on the stretches knows what neighbours share; where
stretches scatter more than that, its noise is their scatter. Explanations are compared by F tests; those that do
equally well with as few parts are all returned.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.stats import f as f_distribution

from georef.geometry.rigid import Array

FALSE_ALARM = 1e-4  # of one call
_LEFT_OVER = 0.003  # level at which what an explanation leaves is more than noise
_STRETCHES, _FEWEST = 24, 4
_GATE = 5.0  # sigmas from a robust fit, and from the middle of a stretch
_EXPLAINED = 0.5  # share of the pairs
_LARGEST_SCATTER = 10.0  # times what is stated: beyond, it is no noise
_ROBUST_STEPS = 20
_RANK = 1e-6
_FROM_MAD = 1.4826


Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Shared:
    """Errors that neighbouring positions share: sigma of a coordinate, correlation exp(-distance / over), in pairs."""

    sigma_m: float
    over: float


@dataclass(frozen=True, eq=False)
class Explanation:
    """Parts of a model with their values and covariances, and the F statistic that it takes away."""

    values: dict[str, Array]
    covs: dict[str, Array]
    statistic: float

    def sigma(self, part: str) -> Array:
        return np.sqrt(np.diag(self.covs[part]))


@dataclass(frozen=True, eq=False)
class _Averaged:
    """Differences and their regressors, whitened, one block of rows for each stretch."""

    y: Array  # (G d,)
    parts: dict[str, Array]  # each (G d, q)


@dataclass(frozen=True, eq=False)
class Explained:
    """The smallest sets of parts that explain differences, best first, all equally small; empty: nothing to explain.

    inlier (N,): differences that follow all parts together.
    """

    explanations: tuple[Explanation, ...]
    inlier: Mask


def explain(difference: Array, sigma: Array, shared: Shared, parts: dict[str, Array]) -> Explained | None:
    """What explains differences (N, d), in the order of the drive, sigma (N,) of each coordinate's own errors.

    parts: name -> (N, d, q) derivatives by its q values. None where all parts together explain less than half.
    """
    residual, scale = _robust_residual(difference, sigma, np.concatenate(list(parts.values()), axis=2))
    inlier = np.abs(residual).max(axis=1) < _GATE * scale * sigma
    if inlier.mean() < _EXPLAINED or scale > _LARGEST_SCATTER:
        return None
    averaged = _averaged(
        difference=difference, residual=residual, sigma=scale * sigma, shared=shared, parts=parts, inlier=inlier
    )
    return Explained(() if averaged is None else _smallest(averaged, tuple(parts)), inlier)


def _robust_residual(difference: Array, sigma: Array, design: Array) -> tuple[Array, float]:
    """Residuals (N, d) of a regression on (N, d, p) with Cauchy's weights; how much larger than stated they scatter."""
    n, d, p = design.shape
    lengths = np.linalg.norm(design, axis=(0, 1)) + 1e-300
    rows = (design / lengths).reshape(n * d, p)
    residual, scale = difference - np.median(difference, axis=0), 1.0
    for _ in range(_ROBUST_STEPS):
        size = np.linalg.norm(residual, axis=1) / sigma
        scale = max(1.0, _FROM_MAD * float(np.median(np.abs(residual) / sigma[:, None])))
        weight = np.repeat(1.0 / np.sqrt(1.0 + np.square(size / (2.0 * scale))) / sigma, d)
        values = np.linalg.lstsq(weight[:, None] * rows, weight * difference.ravel(), rcond=_RANK)[0]
        residual = difference - (rows @ values).reshape(n, d)
    return residual, scale


def _smallest(averaged: _Averaged, parts: tuple[str, ...]) -> tuple[Explanation, ...]:
    """Nothing, where all parts together take away no more than noise would; else the fewest that leave only noise."""
    everything, rank = _fit(averaged, parts)
    noise, freedom = _noise(averaged, parts)
    if freedom < 1 or rank == 0:
        return ()
    if f_distribution.sf(everything / rank / noise, rank, freedom) > FALSE_ALARM:
        return ()
    for count in range(1, len(parts) + 1):
        found = []
        for names in combinations(parts, count):
            taken, own = _fit(averaged, names)
            left = max(0.0, everything - taken)
            if rank == own or f_distribution.sf(left / (rank - own) / noise, rank - own, freedom) > _LEFT_OVER:
                found.append((own, _explanation(averaged, names, taken / noise, noise)))
        if found:
            fewest = min(own for own, _ in found)
            return tuple(sorted((e for own, e in found if own == fewest), key=lambda e: -e.statistic))
    return ()


def _noise(averaged: _Averaged, parts: tuple[str, ...]) -> tuple[float, int]:
    """Mean square of what all parts leave, no less than stated, and its degrees of freedom."""
    taken, rank = _fit(averaged, parts)
    freedom = len(averaged.y) - rank
    return (max(1.0, float(averaged.y @ averaged.y - taken) / freedom), freedom) if freedom > 0 else (1.0, 0)


def _averaged(
    *, difference: Array, residual: Array, sigma: Array, shared: Shared, parts: dict[str, Array], inlier: Mask
) -> _Averaged | None:
    """Averages over stretches; residuals of a robust fit say which differences stray from their stretch."""
    d, used = difference.shape[1], np.flatnonzero(inlier)
    groups = [g for g in np.array_split(used, min(_STRETCHES, len(used))) if len(g)]
    means, variances, places, columns = [], [], [], {name: [] for name in parts}
    for group in groups:
        kept = group[_near_the_middle(residual[group], sigma[group])]
        weight = 1.0 / sigma[kept] ** 2
        means.append(np.average(difference[kept], axis=0, weights=weight))
        variances.append(1.0 / weight.sum())
        places.append(np.average(kept, weights=weight))
        for name, design in parts.items():
            columns[name].append(np.average(design[kept], axis=0, weights=weight))
    if len(means) < _FEWEST:
        return None
    apart = np.abs(np.subtract.outer(places, places))
    factor = np.linalg.cholesky(np.diag(variances) + shared.sigma_m**2 * np.exp(-apart / shared.over))

    def whitened(rows: Array) -> Array:
        """Rows (G, d, q), those of one coordinate with each other."""
        return np.asarray(np.linalg.solve(factor, rows.reshape(len(rows), -1)), np.float64).reshape(len(rows) * d, -1)

    y = whitened(np.array(means)[:, :, None])[:, 0]
    return _Averaged(y, {name: whitened(np.array(column)) for name, column in columns.items()})


def _near_the_middle(residual: Array, sigma: Array) -> NDArray[np.bool_]:
    if len(residual) < 3:
        return np.ones(len(residual), bool)
    off = np.abs(residual - np.median(residual, axis=0)).max(axis=1) / sigma
    return off <= _GATE * max(1.0, _FROM_MAD * float(np.median(off)))


def _basis(design: Array) -> Array:
    """Orthonormal columns that span those of a design; dependent ones drop out."""
    lengths = np.linalg.norm(design, axis=0)
    scaled = design / np.where(lengths > 0, lengths, 1.0)
    u, s, _ = np.linalg.svd(scaled, full_matrices=False)
    return u[:, s > _RANK * max(s.max(initial=0.0), 1e-300)]


def _fit(averaged: _Averaged, names: tuple[str, ...]) -> tuple[float, int]:
    """Squares that some parts take away, and their rank."""
    basis = _basis(np.concatenate([averaged.parts[name] for name in names], axis=1))
    return float(np.square(basis.T @ averaged.y).sum()), basis.shape[1]


def _explanation(averaged: _Averaged, names: tuple[str, ...], statistic: float, noise: float) -> Explanation:
    design = np.concatenate([averaged.parts[name] for name in names], axis=1)
    cov = np.asarray(np.linalg.pinv(design.T @ design, rcond=_RANK**2, hermitian=True), np.float64)
    values = cov @ design.T @ averaged.y
    ends = np.cumsum([averaged.parts[name].shape[1] for name in names])
    slices = {name: slice(end - averaged.parts[name].shape[1], end) for name, end in zip(names, ends, strict=True)}
    return Explanation(
        {name: values[at] for name, at in slices.items()},
        {name: noise * cov[at, at] for name, at in slices.items()},
        statistic,
    )
