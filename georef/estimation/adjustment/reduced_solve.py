"""Solution of the reduced normal equations: stations by a sparse Cholesky factor, border by its Schur complement."""

from __future__ import annotations

from typing import cast

import numpy as np
from scipy.linalg import get_lapack_funcs, solve_triangular

from georef.estimation.adjustment.block_cholesky import VANISHING_PIVOT, BlockCholesky, Pattern, SingularMatrix
from georef.estimation.adjustment.reduced import Reduced
from georef.geometry.rigid import Array


def reduced_step(reduced: Reduced, pattern: Pattern, added: Array) -> Array:
    """The step (6 S + B,) that solves (N + diag(added)) step = -gradient. Raises SingularMatrix."""
    stations = 6 * reduced.layout.stations
    factor = BlockCholesky.of(pattern, _with_diagonal(reduced, added[:stations]))
    half = _half_solved(factor, np.concatenate([reduced.border, reduced.gradient[:stations, None]], axis=1))
    taken = half[:, :-1].T @ half
    own = np.diag(reduced.corner) + added[stations:]
    corner = reduced.corner + np.diag(added[stations:]) - taken[:, :-1]
    border = _solve_border(corner, own, taken[:, -1] - reduced.gradient[stations:], stations)
    return np.concatenate([-factor.solve(reduced.gradient[:stations] + reduced.border @ border), border])


def _half_solved(factor: BlockCholesky, right: Array) -> Array:
    """L^-1 times columns (6 S, m), in which most columns are zero at most stations: a drift knows its street."""
    x = right * factor.scale[:, None]
    for front, unknowns, corner, below in zip(
        factor.pattern.fronts, factor.pattern.unknowns, factor.corner, factor.below, strict=True
    ):
        own, rest = unknowns[: 6 * front.pivots], unknowns[6 * front.pivots :]
        columns = np.flatnonzero(x[own].any(axis=0))
        solved = solve_triangular(corner, x[np.ix_(own, columns)], lower=True, check_finite=False)
        x[np.ix_(own, columns)] = solved
        if len(rest) and len(columns):
            x[np.ix_(rest, columns)] -= below @ solved
    return x


def _with_diagonal(reduced: Reduced, added: Array) -> Array:
    blocks = reduced.block.copy()
    six = np.arange(6)
    blocks[reduced.first[:-1, None], six, six] += added.reshape(-1, 6)
    return blocks


def _solve_border(matrix: Array, own: Array, right: Array, stations: int) -> Array:
    """Solves for the border; own: its diagonal before stations were eliminated, which tells rounding from a pivot."""
    if not len(right):
        return right
    bad = np.flatnonzero(~(own > 0))
    if len(bad):
        raise SingularMatrix(stations + int(bad[0]))
    scale = 1.0 / np.sqrt(own)
    potrf, potrs = get_lapack_funcs(("potrf", "potrs"), (matrix,))
    factor, failed = potrf(matrix * scale[:, None] * scale, lower=1)
    low = np.flatnonzero(np.square(np.diag(factor)) < VANISHING_PIVOT)
    if failed or len(low):
        raise SingularMatrix(stations + int(failed - 1 if failed else low[0]))
    solved, _ = potrs(factor, right * scale, lower=1)
    return cast(Array, solved * scale)
