"""Cholesky factor and selected inverse of a symmetric matrix of sparse 6x6 blocks, front by front (multifrontal).

Duff and Reid, "The multifrontal solution of indefinite sparse symmetric linear systems" (1983); the elements of the
inverse where the factor has blocks by Takahashi, Fagan and Chen (1973), of whole fronts at once.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.linalg import get_blas_funcs, get_lapack_funcs

from georef.estimation.adjustment.block import Indices
from georef.estimation.adjustment.equations.block_order import Front, fronts_of
from georef.estimation.adjustment.kernels.fronts import assemble, extend
from georef.geometry.rigid import Array

dsyrk, dtrsm = get_blas_funcs(("syrk", "trsm"), dtype=np.float64)
dpotrf, dtrtri = get_lapack_funcs(("potrf", "trtri"), dtype=np.float64)

VANISHING_PIVOT = 1e-12  # of its diagonal element before elimination: less is rounding


class SingularMatrix(ArithmeticError):
    """A normal matrix that cannot be inverted: the pivot of `unknown` (its index in the matrix) vanished."""

    def __init__(self, unknown: int) -> None:
        self.unknown = unknown
        super().__init__(f"the pivot of unknown {unknown} vanished")


@dataclass(frozen=True, eq=False)
class Pattern:
    """The symbolic part, to be used again for all matrices with the same blocks.

    Entries of a front: which blocks of the matrix it takes up, at which block row and column of its lower triangle,
    and whether transposed.
    """

    stations: int
    block_row: Indices  # (N,) of the matrix
    block_column: Indices  # (N,)
    fronts: list[Front]
    unknowns: list[Indices]  # of each front: its members' rows of the matrix, 6 each
    passed: list[Indices]  # of each front: where the members after its pivots stand in the parent, 6 each
    entries: list[Indices]
    row: list[Indices]
    column: list[Indices]
    turned: list[Indices]

    @property
    def factor_work(self) -> float:
        """Floating-point operations of a factor: two for each multiplication."""
        sizes = ((6.0 * front.pivots, 6.0 * (len(front.members) - front.pivots)) for front in self.fronts)
        return sum(p**3 / 3.0 + p * p * rest + p * rest * rest for p, rest in sizes)

    @property
    def solve_work(self) -> float:
        """Floating-point operations of a solution with the factor."""
        sizes = ((6.0 * front.pivots, 6.0 * (len(front.members) - front.pivots)) for front in self.fronts)
        return sum(4.0 * p * (p + rest) for p, rest in sizes)

    @staticmethod
    def of(first: Indices, column: Indices) -> Pattern:
        """Of the upper block triangle in rows, as in `Reduced`."""
        stations = len(first) - 1
        row = np.repeat(np.arange(stations), np.diff(first))
        fronts = fronts_of(stations, row, column)
        return Pattern(stations, row, column, fronts, *_places(fronts, row, column, stations))


def _places(
    fronts: list[Front], row: Indices, column: Indices, stations: int
) -> tuple[list[Indices], list[Indices], list[Indices], list[Indices], list[Indices], list[Indices]]:
    place, owner = np.empty(stations, np.int64), np.empty(stations, np.int64)
    eliminated = 0
    for index, front in enumerate(fronts):
        own = front.members[: front.pivots]
        owner[own], place[own] = index, eliminated + np.arange(front.pivots)
        eliminated += front.pivots
    turned = (place[row] < place[column]).astype(np.int64)
    early, late = np.where(turned, row, column), np.where(turned, column, row)
    sorting = np.argsort(owner[early], kind="stable")
    bounds = np.searchsorted(owner[early][sorting], np.arange(len(fronts) + 1))
    out: tuple[list[Indices], ...] = ([], [], [], [], [], [])
    position = np.empty(stations, np.int64)
    for index, front in enumerate(fronts):
        here = sorting[bounds[index] : bounds[index + 1]]
        position[front.members] = np.arange(len(front.members))
        out[0].append(_six(front.members))
        out[2].append(here)
        out[3].append(position[late[here]])
        out[4].append(position[early[here]])
        out[5].append(turned[here])
    for front in fronts:
        if front.parent >= 0:
            position[fronts[front.parent].members] = np.arange(len(fronts[front.parent].members))
        out[1].append(_six(position[front.members[front.pivots :]]))
    return out[0], out[1], out[2], out[3], out[4], out[5]


def _six(blocks: Indices) -> Indices:
    return (6 * blocks[:, None] + np.arange(6)).ravel()


@dataclass(frozen=True, eq=False)
class BlockCholesky:
    """The factor of a matrix scaled to a unit diagonal: S A S = L L'."""

    pattern: Pattern
    scale: Array  # (6 S,) the diagonal of S
    corner: list[Array]  # of each front: L of its pivots, lower
    below: list[Array]  # of each front: L of the members after them

    @staticmethod
    def of(pattern: Pattern, blocks: Array) -> BlockCholesky:
        """blocks: (N, 6, 6) in the order of the pattern's matrix. Raises SingularMatrix."""
        scale = _scale(pattern, blocks)
        corners: list[Array] = []
        belows: list[Array] = []
        waiting: dict[int, list[tuple[Indices, Array]]] = {}
        for index, front in enumerate(pattern.fronts):
            corner, below, update = _assembled(pattern, index, blocks, scale, waiting.pop(index, []))
            corner, failed = dpotrf(corner, lower=1, clean=1, overwrite_a=1)
            low = np.flatnonzero(np.square(np.diag(corner)) < VANISHING_PIVOT)
            if failed or len(low):
                where = failed - 1 if failed else low[0]
                raise SingularMatrix(int(pattern.unknowns[index][where]))
            if len(below):
                below = dtrsm(1.0, corner, below, side=1, lower=1, trans_a=1, overwrite_b=1)
                update = dsyrk(-1.0, below, beta=1.0, c=update, lower=1, overwrite_c=1)
                waiting.setdefault(front.parent, []).append((pattern.passed[index], update))
            corners.append(corner)
            belows.append(below)
        return BlockCholesky(pattern, scale.ravel(), corners, belows)

    def solve(self, right: Array) -> Array:
        """A^-1 times vectors (6 S,) or (6 S, m)."""
        return self.back_solved(self.half_solved(right))

    def half_solved(self, right: Array) -> Array:
        """L^-1 S times vectors (6 S,) or (6 S, m); columns may be zero at most stations (a drift)."""
        flat = right.ndim == 1
        x = np.asfortranarray((right[:, None] if flat else right) * self.scale[:, None])
        for own, rest, corner, below in self._parts():
            columns = np.array([0]) if flat else np.flatnonzero(x[own].any(axis=0))
            if not len(columns):
                continue
            at = np.ix_(own, columns)
            x[at] = solved = dtrsm(1.0, corner, x[at], lower=1)
            if len(rest):
                x[np.ix_(rest, columns)] -= below @ solved
        return x[:, 0] if flat else x

    def back_solved(self, half: Array) -> Array:
        """S L'^-1 times vectors (6 S,) or (6 S, m)."""
        flat = half.ndim == 1
        x = np.array(half[:, None] if flat else half, order="F")
        for own, rest, corner, below in reversed(list(self._parts())):
            known = x[own] - below.T @ x[rest] if len(rest) else x[own]
            x[own] = dtrsm(1.0, corner, known, lower=1, trans_a=1)
        x *= self.scale[:, None]
        return x[:, 0] if flat else x

    def selected_inverse(self) -> Array:
        """The blocks (N, 6, 6) of A^-1 that A has, in their order."""
        fronts, out = self.pattern.fronts, np.zeros((len(self.pattern.block_row), 6, 6))
        children = np.bincount([front.parent for front in fronts if front.parent >= 0], minlength=len(fronts))
        inverses: dict[int, Array] = {}
        for index in reversed(range(len(fronts))):
            front, pivots = fronts[index], 6 * fronts[index].pivots
            inverse = np.empty((6 * len(front.members),) * 2)
            from_corner = np.asarray(dtrtri(self.corner[index], lower=1)[0])
            inverse[:pivots, :pivots] = from_corner.T @ from_corner
            if front.parent >= 0:
                place = self.pattern.passed[index]
                known = inverses[front.parent][np.ix_(place, place)]
                step = self.below[index] @ from_corner
                across = -known @ step
                inverse[pivots:, pivots:], inverse[pivots:, :pivots] = known, across
                inverse[:pivots, pivots:] = across.T
                inverse[:pivots, :pivots] -= step.T @ across
                children[front.parent] -= 1
                if not children[front.parent]:
                    del inverses[front.parent]
            if children[index]:
                inverses[index] = inverse
            _taken(self.pattern, index, inverse, out)
        return _scaled_by(self.pattern, self.scale.reshape(-1, 6), out)

    def _parts(self) -> Iterator[tuple[Indices, Indices, Array, Array]]:
        for front, unknowns, corner, below in zip(
            self.pattern.fronts, self.pattern.unknowns, self.corner, self.below, strict=True
        ):
            yield unknowns[: 6 * front.pivots], unknowns[6 * front.pivots :], corner, below


def _assembled(
    pattern: Pattern, index: int, blocks: Array, scale: Array, updates: list[tuple[Indices, Array]]
) -> tuple[Array, Array, Array]:
    """A front before its pivots are eliminated, see `kernels_fronts`: its own blocks, and what its children pass on."""
    pivots = 6 * pattern.fronts[index].pivots
    rest = len(pattern.unknowns[index]) - pivots
    corner, below, update = (np.zeros(shape, order="F") for shape in ((pivots, pivots), (rest, pivots), (rest, rest)))
    own = (pattern.entries[index], pattern.row[index], pattern.column[index], pattern.turned[index])
    assemble(blocks, scale, pattern.block_row, pattern.block_column, *own, corner, below, update)
    for place, passed in updates:
        extend(place, passed, corner, below, update)
    return corner, below, update


def _taken(pattern: Pattern, index: int, inverse: Array, out: Array) -> None:
    """Writes the blocks of a front's inverse to their entries."""
    count = len(pattern.fronts[index].members)
    found = inverse.reshape(count, 6, count, 6)[pattern.row[index], :, pattern.column[index], :]
    turned = pattern.turned[index].astype(bool)
    found[turned] = np.swapaxes(found[turned], 1, 2)
    out[pattern.entries[index]] = found


def _scale(pattern: Pattern, blocks: Array) -> Array:
    """The scale (S, 6) that makes the diagonal one: radians and metres differ by much."""
    diagonal = np.zeros((pattern.stations, 6))
    own = pattern.block_row == pattern.block_column
    diagonal[pattern.block_row[own]] = np.diagonal(blocks[own], axis1=1, axis2=2)
    bad = np.flatnonzero(~(diagonal.ravel() > 0))
    if len(bad):
        raise SingularMatrix(int(bad[0]))
    return 1.0 / np.sqrt(diagonal)


def _scaled_by(pattern: Pattern, scale: Array, blocks: Array) -> Array:
    return blocks * scale[pattern.block_row][:, :, None] * scale[pattern.block_column][:, None, :]
