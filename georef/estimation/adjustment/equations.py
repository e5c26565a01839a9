"""What a solver asks of a block: its normal equations at a state, and what a step of stations and border does.

`BlockEquations` answers from one process; whoever sums the contributions of points from several answers the same calls.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from georef.estimation.adjustment.batches import Work
from georef.estimation.adjustment.block import Block, Indices, State
from georef.estimation.adjustment.block_cholesky import Pattern
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
from georef.geometry.rigid import Array

HIDDEN_SQUARE = 1e4
"""What an observation costs whose point a step moves out of sight: as much as one 100 sigmas off."""


@dataclass(frozen=True, eq=False)
class Moved:
    """Where a step leads: the state, its cost as in `Linearized` with HIDDEN_SQUARE for the squared residual of each
    image observation that no lens shows, the decrease of the cost that the linear model promised, and how many are out
    of sight."""

    state: State
    cost: float
    promised: float
    hidden: int


class Equations(Protocol):
    """A block as its solver sees it.

    hidden_cost: what an image observation costs that no lens shows: HIDDEN_SQUARE under its loss.
    """

    @property
    def layout(self) -> Layout: ...

    @property
    def pattern(self) -> Pattern:
        """Of the stations' part of the matrices that `linearized` gives."""
        ...

    @property
    def hidden_cost(self) -> float: ...

    def linearized(self, state: State, damping: float) -> Linearized:
        """Normal equations at a state; damping, relative to the diagonal, of points only."""
        ...

    def moved(self, state: State, step: Array, damping: float) -> Moved:
        """What a step (6 S + B,) does, points found again by back-substitution: `state` and `damping` are those of the
        last call of `linearized`, and the step solves its equations."""
        ...


class BlockEquations:
    """The equations of a whole block in this process."""

    def __init__(self, block: Block, losses: Losses | None = None, prepared: Prepared | None = None) -> None:
        self._block, self._losses, self._prepared = block, losses or {}, prepared or Prepared.of(block)
        self._work: Work = self._prepared.work()
        self._image_scale = self._losses.get(IMAGE_OBSERVATIONS, 0.0)

    @property
    def layout(self) -> Layout:
        return self._prepared.layout

    @property
    def pattern(self) -> Pattern:
        return self._prepared.pattern

    @property
    def hidden_cost(self) -> float:
        return cost_of_squares(np.array([HIDDEN_SQUARE]), self._image_scale)

    def linearized(self, state: State, damping: float) -> Linearized:
        return normal_equations(
            *(self._block, state), losses=self._losses, damping=damping, prepared=self._prepared, work=self._work
        )

    def moved(self, state: State, step: Array, damping: float) -> Moved:
        after = moved_state(self.layout, state, step)
        given = GivenPoints.at(self._block, state.points, self._losses)
        promised, cost, hidden = move_points(
            *(self._prepared.tracks, self._prepared.images, placed(state), placed(after), state.points),
            *(given.information, given.shift, damping, self._image_scale, HIDDEN_SQUARE, step, after.points),
            self._work,
        )
        args = (self.layout, self._losses)
        cost += constraint_cost(self._block, after, *args)
        promised += promised_by_constraints(self._block, state, step, after.points, *args)
        return Moved(after, float(cost), float(promised), int(hidden))


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
