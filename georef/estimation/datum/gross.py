"""Gross differences between two sets of paired positions: axes swapped or reversed, units, turned or far-away frames.

Level (easting, northing) and heights are looked at apart. Each hypothesis is a fixed map of the first positions and
the shift that suits most pairs; its cost is the sum of squared residuals in sigmas, cut off so that blunders count the
same under all. A free similarity (MSAC: Torr and Zisserman 2000) takes over where no fixed map explains half the pairs.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from georef.geometry.rigid import Array

FOOT_M, SURVEY_FOOT_M = 0.3048, 1200.0 / 3937.0
_CUT = 25.0  # squared residual in sigmas from which on a pair is a blunder
_AS_GOOD = 30.0  # difference of costs at which two hypotheses explain the pairs alike
_EXPLAINED = 0.5  # share of pairs
_NEARLY_ALL = 0.8  # of the pairs that the best explains
_COARSE = 0.02  # of the extent: what a frame of another place bends
_SAMPLES, _SCORED = 300, 1500
_STANDING = 20.0  # sigmas of extent below which pairs show shifts only

_TURN = np.array([[0.0, -1.0], [1.0, 0.0]])
LEVEL_MAPS: dict[str, Array] = {
    "same": np.eye(2),
    "swapped": np.array([[0.0, 1.0], [1.0, 0.0]]),
    "east reversed": np.diag([-1.0, 1.0]),
    "north reversed": np.diag([1.0, -1.0]),
    "swapped and reversed": np.array([[0.0, -1.0], [-1.0, 0.0]]),
    "turned by 90 degrees": _TURN,
    "turned by 180 degrees": -np.eye(2),
    "turned by -90 degrees": -_TURN,
}
HEIGHT_MAPS: dict[str, Array] = {"same": np.eye(1), "up reversed": -np.eye(1)}
SCALES: dict[str, float] = {"same": 1.0, "feet taken as metres": 1.0 / FOOT_M, "metres taken as feet": FOOT_M}


@dataclass(frozen=True, eq=False)
class Gross:
    """second = scale * matrix @ first + shift for most pairs. axes, unit: names of what the map is, "free" if neither.

    alike: other (axes, unit) that explain the pairs as well. inlier (N,). sigma of the turn (rad) and of the scale,
    as a share, where they were estimated.
    """

    axes: str
    unit: str
    matrix: Array
    scale: float
    shift: Array
    inlier: NDArray[np.bool_]
    alike: tuple[tuple[str, str], ...] = ()
    turn_rad: float = 0.0
    turn_sigma: float = 0.0
    coarse: bool = False

    @property
    def same(self) -> bool:
        return self.axes == self.unit == "same"


def gross_relation(first: Array, second: Array, sigma: Array) -> Gross | None:
    """How second (N, d) follows from first (N, d), sigma (N,) of a coordinate's difference; d 2 (level) or 1 (height).

    The plainest map wins where several explain the pairs alike; None where no fixed map explains half of them.
    """
    maps = LEVEL_MAPS if first.shape[1] == 2 else HEIGHT_MAPS
    found = {
        (axes, unit): _fixed(axes, unit, matrix, scale, first, second, sigma)
        for axes, matrix in maps.items()
        for unit, scale in SCALES.items()
    }
    best, least = min(found.values(), key=lambda pair: pair[1])
    enough = _NEARLY_ALL * best.inlier.mean()
    alike = [  # the plainest first, by the order of maps
        key for key, (map_, cost) in found.items() if cost <= least + _AS_GOOD or map_.inlier.mean() >= enough
    ]
    chosen = found[alike[0]][0]
    if chosen.inlier.mean() >= _EXPLAINED:
        others = alike[1:]
        turned = chosen.axes != "same" and first.shape[1] == 2
        if turned and _on_a_line(first[chosen.inlier], sigma[chosen.inlier]):
            others.append(("free" if np.linalg.det(chosen.matrix) < 0 else "mirrored", "free"))
        return replace(chosen, alike=tuple(others))
    return None


def stands_still(first: Array, sigma: Array) -> bool:
    """Whether positions (N, d) lie so close together that nothing but shifts can be seen."""
    return _extent(first) < _STANDING * float(np.median(sigma))


def _extent(points: Array) -> float:
    return float(np.median(np.linalg.norm(points - np.median(points, axis=0), axis=1)))


def _fixed(
    axes: str, unit: str, matrix: Array, scale: float, first: Array, second: Array, sigma: Array
) -> tuple[Gross, float]:
    mapped = scale * first @ matrix.T
    wide = sigma * max(1.0, scale)
    shift = np.median(second - mapped, axis=0)
    squares = np.zeros(len(first))
    for _ in range(3):
        squares = np.square(second - mapped - shift).sum(axis=1) / wide**2
        near = squares < _CUT
        if near.any():
            shift = np.average((second - mapped)[near], axis=0, weights=1.0 / wide[near] ** 2)
    cost = float(np.minimum(squares, _CUT).sum())
    return Gross(axes, unit, matrix, scale, shift, squares < _CUT), cost


def _on_a_line(points: Array, sigma: Array) -> bool:
    """Whether positions (N, 2) stray so little from a line that a mirror and a turn do the same to them."""
    across = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[1][1] / np.sqrt(len(points))
    return bool(across < np.sqrt(_CUT) * np.median(sigma))


def free_similarity(first: Array, second: Array, sigma: Array) -> Gross | None:
    """A similarity of the plane, proper or not, first to the stated noise and then to what other frames bend."""
    a, b = first[:, 0] + 1j * first[:, 1], second[:, 0] + 1j * second[:, 1]
    middle = np.median(a.real) + 1j * np.median(a.imag)
    for coarse in (False, True):
        results = [
            _similarity(ours - np.conj(middle) * flip - middle * (1 - flip), b, sigma, coarse, first)
            for flip, ours in ((0, a), (1, np.conj(a)))
        ]
        costs = [cost for *_, cost in results]
        order = int(costs[1] < costs[0] - _AS_GOOD)  # a mirror only where it is needed
        factor, offset, inlier, turn_sigma, _ = results[order]
        if inlier.mean() < _EXPLAINED:
            continue
        scale, turn = abs(factor), float(np.angle(factor))
        c, s = np.cos(turn), np.sin(turn)
        mirror = np.diag([1.0, -1.0]) if order else np.eye(2)
        matrix = np.array([[c, -s], [s, c]]) @ mirror
        shift = np.array([offset.real, offset.imag]) - scale * matrix @ [middle.real, middle.imag]
        alike = (("mirrored", "free"),) if not order and costs[1] <= costs[0] + _AS_GOOD else ()
        name = "mirrored" if order else "free"
        return Gross(name, "free", matrix, scale, shift, inlier, alike, turn, turn_sigma, coarse)
    return None


def _similarity(
    a: NDArray[np.complex128], b: NDArray[np.complex128], sigma: Array, coarse: bool, first: Array
) -> tuple[complex, complex, NDArray[np.bool_], float, float]:
    """b = factor a + offset of most pairs: factor, offset, inliers, sigma of the factor (relative), cost."""
    rng, n = np.random.default_rng(0), len(a)
    scored = rng.permutation(n)[:_SCORED]
    i, j = rng.integers(0, n, (2, _SAMPLES))
    apart = np.abs(a[i] - a[j]) > 0.3 * _extent(first)
    i, j = i[apart], j[apart]
    best: tuple[float, complex, complex] = (np.inf, 1.0 + 0j, 0j)
    for factor, offset in zip((b[i] - b[j]) / (a[i] - a[j]), b[i] - (b[i] - b[j]) / (a[i] - a[j]) * a[i], strict=True):
        cost = _cost(a[scored], b[scored], factor, offset, _tolerance(sigma[scored], factor, coarse, first))
        best = min(best, (cost, factor, offset), key=lambda triple: triple[0])
    _, factor, offset = best
    inlier, spread = np.zeros(n, bool), 1.0
    for _ in range(4):
        tolerance = _tolerance(sigma, factor, coarse, first)
        inlier = np.abs(b - factor * a - offset) < np.sqrt(_CUT) * tolerance
        if inlier.sum() < 3:
            break
        mean_a, mean_b = a[inlier].mean(), b[inlier].mean()
        spread = float(np.sum(np.abs(a[inlier] - mean_a) ** 2))
        factor = complex(np.sum(np.conj(a[inlier] - mean_a) * (b[inlier] - mean_b)) / spread)
        offset = complex(mean_b - factor * mean_a)
    tolerance = _tolerance(sigma, factor, coarse, first)
    turn_sigma = float(np.median(tolerance) / np.sqrt(spread) / max(abs(factor), 1e-12))
    return factor, offset, inlier, turn_sigma, _cost(a, b, factor, offset, tolerance)


def _tolerance(sigma: Array, factor: complex, coarse: bool, first: Array) -> Array:
    wide = sigma * max(1.0, abs(factor))
    return wide + _COARSE * abs(factor) * _extent(first) / np.sqrt(_CUT) if coarse else wide


def _cost(a: NDArray[np.complex128], b: NDArray[np.complex128], factor: complex, offset: complex, wide: Array) -> float:
    return float(np.minimum(np.abs(b - factor * a - offset) ** 2 / wide**2, _CUT).sum())
