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
from georef.estimation.adjustment.batches import Work
from georef.estimation.adjustment.block import Block, Indices, State
from georef.estimation.adjustment.block_cholesky import Pattern, SingularMatrix
from georef.estimation.adjustment.eliminate import (
    IMAGE_OBSERVATIONS,
    GivenPoints,
    Linearized,
    Losses,
    constraint_cost,
    cost_of_squares,
    normal_equations,
    promised_by_constraints,
)
from georef.estimation.adjustment.kernels_move import move_points
from georef.estimation.adjustment.prepared import Prepared, placed
from georef.estimation.adjustment.reduced import Layout
from georef.estimation.adjustment.reduced_solve import reduced_step
from georef.geometry.rigid import Array

_log = logging.getLogger(__name__)
_HIDDEN_SQUARE = 1e4  # what an observation costs whose point a step moves out of sight: as much as one 100 sigmas off
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
    on_iteration: Callable[[Iteration], None] | None = None,
) -> BlockSolution:
    """Minimises half the squared whitened residuals of a block, with a Cauchy loss for the groups named in losses.

    start: another state than the approximate values, such as the last one of an interrupted adjustment. Raises
    GeorefError where the constraints do not determine all unknowns.
    """
    solver = _Solver(block, losses or {}, options or SolverOptions(), prepared or Prepared.of(block))
    return solver.run(start or block.start(), on_iteration)


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
    """A step, where it leads, and what it did to the cost (with _HIDDEN_SQUARE for what is out of sight)."""

    step: Array
    state: State
    cost: float
    ratio: float  # of the achieved to the promised decrease; 1 where both are lost in rounding
    hidden: int


class _Solver:
    """One adjustment under way: what it is given, the pattern of its equations, scratch memory."""

    def __init__(self, block: Block, losses: Losses, options: SolverOptions, prepared: Prepared) -> None:
        self._block, self._losses, self._options, self._prepared = block, losses, options, prepared
        self._pattern = Pattern.of(prepared.first, prepared.column)
        self._work: Work = prepared.work()
        self._image_scale = losses.get(IMAGE_OBSERVATIONS, 0.0)
        self._hidden_cost = cost_of_squares(np.array([_HIDDEN_SQUARE]), self._image_scale)

    def run(self, state: State, on_iteration: Callable[[Iteration], None] | None) -> BlockSolution:
        damping, number = self._options.damping, 0
        lin = self._linearized(state, damping)
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
            lin = self._linearized(state, damping)

    def _linearized(self, state: State, damping: float) -> Linearized:
        return normal_equations(
            *(self._block, state), losses=self._losses, damping=damping, prepared=self._prepared, work=self._work
        )

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
            lin = self._linearized(state, damping)
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
        moved = moved_state(self._prepared.layout, state, step)
        given = GivenPoints.at(self._block, state.points, self._losses)
        promised, cost, hidden = move_points(
            *(self._prepared.tracks, self._prepared.images, placed(state), placed(moved), state.points),
            *(given.information, given.shift, damping, self._image_scale, _HIDDEN_SQUARE, step, moved.points),
            self._work,
        )
        args = (self._prepared.layout, self._losses)
        cost += constraint_cost(self._block, moved, *args)
        promised += promised_by_constraints(self._block, state, step, moved.points, *args)
        lost = abs(promised) <= _ROUNDING * before and abs(before - cost) <= _ROUNDING * before
        ratio = 1.0 if lost else ((before - cost) / promised if promised > 0.0 else -1.0)
        return _Trial(step, moved, float(cost), float(ratio), int(hidden))

    def _singular(self, error: SingularMatrix, state: State, lin: Linearized) -> GeorefError:
        """What is missing, in the words of `datum` where it finds a reason."""
        from georef.estimation.adjustment.datum import explain_singular
        from georef.estimation.adjustment.datum_words import name_of_unknown

        unknown = name_of_unknown(self._block, self._prepared.layout, error.unknown)
        return GeorefError(
            f"The adjustment has no unique solution: its observations and constraints do not fix {unknown}.",
            explain_singular(self._block, state, lin.reduced)
            or "Add control points, GNSS positions or pose priors, or hold unknowns that nothing determines.",
        )


def moved_state(layout: Layout, state: State, step: Array) -> State:
    """The state after a step (6 S + B,) of stations and border; points are copied, kept ones moved."""
    stations, border = step[: 6 * layout.stations].reshape(-1, 6), step[6 * layout.stations :]

    def taken(starts: Indices, size: int) -> Array:
        out = np.zeros((len(starts), size))
        there = np.flatnonzero(starts >= 0)
        out[there] = border[starts[there][:, None] + np.arange(size)]
        return out

    cameras = tuple(
        camera.changed(camera.estimate, border[at : at + len(camera.estimate)]) if at >= 0 else camera
        for at, camera in zip(layout.calibration, state.cameras, strict=True)
    )
    return State(
        state.world_from_rig.retract(stations),
        state.rig_from_cam.retract(taken(layout.mounting, 6)),
        cameras,
        state.lever_arms_m + taken(layout.antenna, 3),
        state.drift_m + taken(layout.drift, 3),
        state.points + taken(layout.kept_point, 3),
    )
