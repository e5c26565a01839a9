"""Solution of the reduced normal equations: stations by a sparse Cholesky factor, border by its Schur complement.

Equations of one iteration resemble those of the one before. A factor is therefore kept, and later equations are first
tried by conjugate gradients with it as preconditioner (Hestenes and Stiefel 1952), as far as that is much cheaper than
another factor; the solution is that of the new equations either way.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import numpy as np
from scipy.linalg import get_lapack_funcs

from georef.estimation.adjustment.equations.block_cholesky import (
    VANISHING_PIVOT,
    BlockCholesky,
    Pattern,
    SingularMatrix,
)
from georef.estimation.adjustment.equations.reduced import Reduced
from georef.estimation.adjustment.kernels.fronts import times
from georef.geometry.rigid import Array

_SOLVED = 1e-7  # of the first residual, in the norm of the kept factor's inverse
_WORTH = 0.5  # of a factor's time that conjugate gradients may take
_FACTOR_RATE, _SOLVE_RATE = 30e9, 2e9  # floating-point operations a second: of dense products, of streaming a factor
_FEWEST_STEPS = 4
_DIVERGED = 1e3

dpotrf, dpotrs = get_lapack_funcs(("potrf", "potrs"), dtype=np.float64)


@dataclass(frozen=True, eq=False)
class ReducedFactor:
    """The factor of reduced normal equations, with something added to their diagonal."""

    stations: BlockCholesky
    half: Array  # (6 S, B) the border's columns, half solved
    border: Array  # (B, B) lower factor of the Schur complement, scaled
    scale: Array  # (B,)

    @staticmethod
    def of(reduced: Reduced, pattern: Pattern, added: Array) -> ReducedFactor:
        """added: (6 S + B,). Raises SingularMatrix."""
        stations = 6 * reduced.layout.stations
        factor = BlockCholesky.of(pattern, _with_diagonal(reduced, added[:stations]))
        half = factor.half_solved(reduced.border)
        own = np.diag(reduced.corner) + added[stations:]
        corner = reduced.corner + np.diag(added[stations:]) - half.T @ half
        return ReducedFactor(factor, half, *_border_factor(corner, own, stations))

    def solve(self, right: Array) -> Array:
        """The inverse times a vector (6 S + B,)."""
        stations = len(self.half)
        own = self.stations.half_solved(right[:stations])
        if not len(self.scale):
            return self.stations.back_solved(own)
        solved, _ = dpotrs(self.border, (right[stations:] - self.half.T @ own) * self.scale, lower=1)
        border = solved * self.scale
        return np.concatenate([self.stations.back_solved(own - self.half @ border), border])


class StepSolver:
    """Steps of one adjustment, iteration by iteration.

    most_steps: of conjugate gradients, before a factor is made after all.
    """

    def __init__(self, pattern: Pattern) -> None:
        self._pattern = pattern
        self._factor: ReducedFactor | None = None
        self._regular = False  # whether the kept factor is one without damping, which says that the solution is unique
        self.most_steps = int(_WORTH * (pattern.factor_work / _FACTOR_RATE) / (pattern.solve_work / _SOLVE_RATE))

    def step(self, reduced: Reduced, added: Array) -> Array:
        """The step (6 S + B,) that solves (N + diag(added)) step = -gradient. Raises SingularMatrix."""
        damped = bool(added.any())
        if self._factor is not None and (damped or self._regular) and self.most_steps >= _FEWEST_STEPS:
            found = conjugate_gradients(reduced, added, -reduced.gradient, self._factor, self.most_steps)
            if found is not None:
                return found
        self._factor = None  # its memory is free for the next
        self._factor = ReducedFactor.of(reduced, self._pattern, added)
        self._regular = not damped
        return -self._factor.solve(reduced.gradient)


def conjugate_gradients(
    reduced: Reduced, added: Array, right: Array, factor: ReducedFactor, most_steps: int
) -> Array | None:
    """(N + diag(added))^-1 times a vector (6 S + B,), preconditioned by a factor of like equations; None where they are
    not like enough."""
    x, residual = np.zeros_like(right), right.copy()
    direction = np.zeros_like(right)
    first, before = 0.0, 1.0
    for number in range(most_steps + 1):
        improved = factor.solve(residual)
        left = float(residual @ improved)
        first = first if number else left
        if left <= _SOLVED**2 * first:
            return x
        if not left < _DIVERGED * first or number == most_steps:
            return None
        direction = improved + (left / before if number else 0.0) * direction
        image = product(reduced, direction) + added * direction
        curved = float(direction @ image)
        if not curved > 0.0:
            return None
        x += left / curved * direction
        residual -= left / curved * image
        before = left
    return None


def product(reduced: Reduced, vector: Array) -> Array:
    """The reduced normal matrix times a vector (6 S + B,)."""
    stations = 6 * reduced.layout.stations
    out = np.zeros(len(vector))
    times(reduced.first, reduced.column, reduced.block, vector, out)
    out[:stations] += reduced.border @ vector[stations:]
    out[stations:] = reduced.border.T @ vector[:stations] + reduced.corner @ vector[stations:]
    return out


def _with_diagonal(reduced: Reduced, added: Array) -> Array:
    blocks = reduced.block.copy()
    six = np.arange(6)
    blocks[reduced.first[:-1, None], six, six] += added.reshape(-1, 6)
    return blocks


def _border_factor(matrix: Array, own: Array, stations: int) -> tuple[Array, Array]:
    """Lower factor of the border's scaled matrix, and the scale; own: its diagonal before stations were eliminated,
    which tells rounding from a pivot."""
    if not len(own):
        return matrix, own
    bad = np.flatnonzero(~(own > 0))
    if len(bad):
        raise SingularMatrix(stations + int(bad[0]))
    scale = 1.0 / np.sqrt(own)
    factor, failed = dpotrf(matrix * scale[:, None] * scale, lower=1)
    low = np.flatnonzero(np.square(np.diag(factor)) < VANISHING_PIVOT)
    if failed or len(low):
        raise SingularMatrix(stations + int(failed - 1 if failed else low[0]))
    return cast(Array, factor), scale
