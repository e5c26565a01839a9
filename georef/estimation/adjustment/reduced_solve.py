"""Solution of the reduced normal equations: stations by a sparse Cholesky factor, border by its Schur complement."""

from __future__ import annotations

from typing import cast

import numpy as np
from scipy.linalg import get_lapack_funcs

from georef.estimation.adjustment.block_cholesky import VANISHING_PIVOT, BlockCholesky, Pattern, SingularMatrix
from georef.estimation.adjustment.reduced import Reduced
from georef.geometry.rigid import Array


def reduced_step(reduced: Reduced, pattern: Pattern, added: Array) -> Array:
    """The step (6 S + B,) that solves (N + diag(added)) step = -gradient. Raises SingularMatrix."""
    stations = 6 * reduced.layout.stations
    blocks = _with_diagonal(reduced, added[:stations])
    factor = BlockCholesky.of(pattern, blocks)
    right = np.concatenate([reduced.border, reduced.gradient[:stations, None]], axis=1)
    solved = factor.solve(right)
    across, alone = solved[:, :-1], solved[:, -1]
    corner = reduced.corner + np.diag(added[stations:]) - reduced.border.T @ across
    own = np.diag(reduced.corner) + added[stations:]
    border = _solve_border(corner, own, reduced.border.T @ alone - reduced.gradient[stations:], stations)
    return np.concatenate([-alone - across @ border, border])


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
