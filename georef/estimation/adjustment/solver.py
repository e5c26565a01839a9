"""Least-squares solution of a block: Gauss-Newton on stations and shared unknowns, damped where it has to be.

Levenberg and Marquardt's damping relative to the diagonal (Marquardt 1963), accepted by the ratio of the achieved to
the promised decrease of the cost. Points are eliminated at each iteration and found again by back-substitution.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np

from georef.errors import GeorefError
from georef.estimation.adjustment.block import Block, State
from georef.estimation.adjustment.block_cholesky import SingularMatrix
from georef.estimation.adjustment.eliminate import Linearized, Losses
from georef.estimation.adjustment.equations import BlockEquations, Equations
from georef.estimation.adjustment.prepared import Prepared
from georef.estimation.adjustment.reduced_solve import reduced_step
from georef.geometry.rigid import Array

_log = logging.getLogger(__name__)
_ROUNDING = 1e-11  # of the cost
_NO_DAMPING, _HIGHEST_DAMPING, _FREE_GAUGE_DAMPING = 1e-11, 1e10, 1e-9


@dataclass(frozen=True, eq=False)
class BlockSolution:
    """cost: half the sum of squared whitened residuals, losses applied, of all observations that lenses show.

    hidden: image observations whose point the lens does not show; they took no part. undetermined: points whose rays
    leave a direction open, which stayed where they were in it.
    """

    state: State
    cost: float
    iterations: int
    converged: bool
    hidden: int
    undetermined: int


@dataclass(frozen=True, eq=False)
class Iteration:
    """What a callback is told after each iteration; `state` is where an interrupted adjustment can go on."""

    number: int
    state: State
    cost: float
    step: float  # largest, m, rad and units of Camera.changed
    damping: float
    next_damping: float  # what the next iteration begins with


@dataclass(frozen=True)
class SolverOptions:
    """When to stop, and how careful to be.

    step_tolerance: the largest step of a station or a shared unknown, m and rad. cost_tolerance: stops as well once an
    iteration lowers the cost by less than this part of it; 0: never. free_gauge: a network without datum is adjusted,
    its datum held by damping, instead of refused.
    """

    max_iterations: int = 50
    step_tolerance: float = 1e-7
    cost_tolerance: float = 0.0
    damping: float = 1e-6
    free_gauge: bool = False


def solve_block(
    block: Block,
    *,
    losses: Losses | None = None,
    options: SolverOptions | None = None,
    start: State | None = None,
    prepared: Prepared | None = None,
    equations: Equations | None = None,
    on_iteration: Callable[[Iteration], None] | None = None,
) -> BlockSolution:
    """Minimises half the squared whitened residuals of a block, with a Cauchy loss for the groups named in losses.

    start: another state than the approximate values, such as the last one of an interrupted adjustment. equations: who
    else sums the normal equations of this block, with these losses. Raises GeorefError where the constraints do not
    determine all unknowns.
    """
    equations = equations or BlockEquations(block, losses, prepared)
    return _Solver(block, options or SolverOptions(), equations).run(start or block.start(), on_iteration)


class Solve(Protocol):
    """Whoever solves a block as `solve_block` does: resumed, or over several processes."""

    def __call__(
        self,
        block: Block,
        *,
        losses: Losses | None = None,
        options: SolverOptions | None = None,
        start: State | None = None,
        prepared: Prepared | None = None,
        on_iteration: Callable[[Iteration], None] | None = None,
    ) -> BlockSolution: ...


class _Trial(NamedTuple):
    """A step, where it leads, and what it did to the cost (with HIDDEN_SQUARE for what is out of sight)."""

    step: Array
    state: State
    cost: float
    ratio: float  # of the achieved to the promised decrease; 1 where both are lost in rounding
    hidden: int


class _Solver:
    """One adjustment under way."""

    def __init__(self, block: Block, options: SolverOptions, equations: Equations) -> None:
        self._block, self._options, self._equations = block, options, equations
        self._pattern, self._hidden_cost = equations.pattern, equations.hidden_cost

    def run(self, state: State, on_iteration: Callable[[Iteration], None] | None) -> BlockSolution:
        damping, number = self._options.damping, 0
        lin = self._equations.linearized(state, damping)
        while True:
            number += 1
            before = lin.cost
            trial, used, lin = self._accepted_step(state, lin, damping)
            state, cost = trial.state, trial.cost - trial.hidden * self._hidden_cost
            largest = float(np.abs(trial.step).max(initial=0.0))
            small = largest < self._options.step_tolerance or before - cost < self._options.cost_tolerance * before
            # Only a step without damping says that the solution is unique.
            converged = small and (used == 0.0 or self._options.free_gauge)
            damping = 0.0 if small and not self._options.free_gauge else self._relaxed(used, trial.ratio)
            _log.info("iteration %d: cost %.6g, largest step %.2g, damping %.1g", number, cost, largest, used)
            if on_iteration:
                on_iteration(Iteration(number, state, cost, largest, used, damping))
            if converged or number >= self._options.max_iterations:
                return BlockSolution(state, cost, number, converged, trial.hidden, lin.undetermined)
            lin = self._equations.linearized(state, damping)

    def _accepted_step(self, state: State, lin: Linearized, damping: float) -> tuple[_Trial, float, Linearized]:
        """The first step that lowers the cost, its damping, and the equations it came from."""
        growth = 10.0
        cost = lin.cost + lin.hidden * self._hidden_cost
        while damping < _HIGHEST_DAMPING:
            trial = self._trial(state, lin, damping, cost)
            if trial is not None and trial.ratio > 0.0:
                return trial, damping, lin
            damping = max(damping * growth, 1e-6)
            growth *= 2.0
            lin = self._equations.linearized(state, damping)
        raise GeorefError(
            "The adjustment finds no step that improves it: its approximate values are too far off.",
            "Check approximate poses, units and the coordinate reference system of the constraints.",
        )

    def _relaxed(self, damping: float, ratio: float) -> float:
        """Less damping after a good step, none once the linear model holds (a free gauge keeps a little)."""
        factor = 0.01 if ratio > 0.8 else (0.2 if ratio > 0.5 else (1.0 if ratio > 0.2 else 5.0))
        lowest = _FREE_GAUGE_DAMPING if self._options.free_gauge else 0.0
        lower = damping * factor
        return max(lower if lower > _NO_DAMPING else 0.0, lowest)

    def _trial(self, state: State, lin: Linearized, damping: float, before: float) -> _Trial | None:
        """The step at a damping from a state of cost `before`; None where the equations have no solution at it."""
        try:
            step = reduced_step(lin.reduced, self._pattern, damping * lin.diagonal)
        except SingularMatrix as error:
            if damping > 0.0:
                return None
            raise self._singular(error, state, lin) from None
        moved = self._equations.moved(state, step, damping)
        gained, promised = before - moved.cost, moved.promised
        lost = abs(promised) <= _ROUNDING * before and abs(gained) <= _ROUNDING * before
        ratio = 1.0 if lost else (gained / promised if promised > 0.0 else -1.0)
        return _Trial(step, moved.state, moved.cost, float(ratio), moved.hidden)

    def _singular(self, error: SingularMatrix, state: State, lin: Linearized) -> GeorefError:
        """What is missing, in the words of `datum` where it finds a reason."""
        from georef.estimation.adjustment.datum import explain_singular
        from georef.estimation.adjustment.datum_words import name_of_unknown

        unknown = name_of_unknown(self._block, self._equations.layout, error.unknown)
        return GeorefError(
            f"The adjustment has no unique solution: its observations and constraints do not fix {unknown}.",
            explain_singular(self._block, state, lin.reduced)
            or "Add control points, GNSS positions or pose priors, or hold unknowns that nothing determines.",
        )
