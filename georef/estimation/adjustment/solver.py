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
from georef.estimation.adjustment.equations.block_cholesky import SingularMatrix
from georef.estimation.adjustment.equations.block_equations import BlockEquations, Equations, Moved
from georef.estimation.adjustment.equations.eliminate import Linearized, Losses, normal_equations
from georef.estimation.adjustment.equations.prepared import Prepared
from georef.estimation.adjustment.equations.reduced import Layout
from georef.estimation.adjustment.equations.reduced_solve import StepSolver
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
    return Minimizer(block, options or SolverOptions(), _Whole(equations)).run(start or block.start(), on_iteration)


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


class Model(Protocol):
    """What linearising at a state tells of it, as in `Linearized`."""

    @property
    def cost(self) -> float: ...
    @property
    def hidden(self) -> int: ...
    @property
    def undetermined(self) -> int: ...


class Attempts(Protocol):
    """Whoever linearises a block, solves its equations and says what the step does.

    hidden_cost: what an image observation costs that no lens shows.
    """

    @property
    def layout(self) -> Layout: ...
    @property
    def hidden_cost(self) -> float: ...

    def linearized(self, state: State, damping: float) -> Model: ...

    def attempt(self, state: State, damping: float) -> tuple[Array, Moved, float]:
        """The step (6 S + B,) of the equations that were linearised last, at this state and damping; where it leads;
        the decrease of the cost that the linear model promised. Raises SingularMatrix."""
        ...


class _Whole:
    """Attempts on a block whose equations are in one piece."""

    def __init__(self, equations: Equations) -> None:
        self._equations, self.layout, self.hidden_cost = equations, equations.layout, equations.hidden_cost
        self._steps, self._lin = StepSolver(equations.pattern), None

    _lin: Linearized | None

    def linearized(self, state: State, damping: float) -> Linearized:
        self._lin = None  # its memory is free for the next
        self._lin = self._equations.linearized(state, damping)
        return self._lin

    def attempt(self, state: State, damping: float) -> tuple[Array, Moved, float]:
        assert self._lin is not None
        lin = self._lin
        step = self._steps.step(lin.reduced, damping * lin.diagonal)
        moved = self._equations.moved(state, step, damping)
        return step, moved, promised_decrease(lin.gain, lin.reduced.gradient, lin.diagonal, step, damping, moved)


class Minimizer:
    """One adjustment under way: steps that lower the cost, damped as far as they have to be."""

    def __init__(self, block: Block, options: SolverOptions, attempts: Attempts) -> None:
        self._block, self._options, self._attempts = block, options, attempts

    def run(self, state: State, on_iteration: Callable[[Iteration], None] | None) -> BlockSolution:
        damping, number = self._options.damping, 0
        lin = self._attempts.linearized(state, damping)
        while True:
            number += 1
            before = lin.cost
            trial, used, lin = self._accepted_step(state, lin, damping)
            state, cost = trial.state, trial.cost - trial.hidden * self._attempts.hidden_cost
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
            lin = self._attempts.linearized(state, damping)

    def _accepted_step(self, state: State, lin: Model, damping: float) -> tuple[_Trial, float, Model]:
        """The first step that lowers the cost, its damping, and the equations it came from."""
        growth = 10.0
        cost = lin.cost + lin.hidden * self._attempts.hidden_cost
        while damping < _HIGHEST_DAMPING:
            trial = self._trial(state, damping, cost)
            if trial is not None and trial.ratio > 0.0:
                return trial, damping, lin
            damping = max(damping * growth, 1e-6)
            growth *= 2.0
            lin = self._attempts.linearized(state, damping)
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

    def _trial(self, state: State, damping: float, before: float) -> _Trial | None:
        """The step at a damping from a state of cost `before`; None where the equations have no solution at it."""
        try:
            step, moved, promised = self._attempts.attempt(state, damping)
        except SingularMatrix as error:
            if damping > 0.0:
                return None
            raise self._singular(error, state) from None
        gained = before - moved.cost
        small = _ROUNDING * max(before, 1.0)  # whitened squares: far less than one residual
        lost = abs(promised) <= small and abs(gained) <= small
        ratio = 1.0 if lost else (gained / promised if promised > 0.0 else -1.0)
        return _Trial(step, moved.state, moved.cost, float(ratio), moved.hidden)

    def _singular(self, error: SingularMatrix, state: State) -> GeorefError:
        """What is missing, in the words of `datum` where it finds a reason."""
        from georef.estimation.datum.singular import explain_singular
        from georef.estimation.datum.singular_words import name_of_unknown

        unknown = name_of_unknown(self._block, self._attempts.layout, error.unknown)
        return GeorefError(
            f"The adjustment has no unique solution: its observations and constraints do not fix {unknown}.",
            explain_singular(self._block, state, normal_equations(self._block, state).reduced)
            or "Add control points, GNSS positions or pose priors, or hold unknowns that nothing determines.",
        )


def promised_decrease(
    gain: float, gradient: Array, diagonal: Array, step: Array, damping: float, moved: Moved
) -> float:
    """Decrease of the cost of the linear model by a step that solves its damped equations; the first three are those
    of `Linearized`. Over parts of a block it adds up.

    With the damped model m_d = m + damping / 2 step' D step, D the diagonal, and its minimum at the step, the points'
    own among it, m_d falls by the gain of points alone less half the product of reduced gradient and step.
    """
    squares = moved.squares + float(diagonal @ np.square(step))
    return gain - 0.5 * float(gradient @ step) + 0.5 * damping * squares
