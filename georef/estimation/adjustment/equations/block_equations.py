"""What a solver asks of a block: its normal equations at a state, and what a step of stations and border does.

`BlockEquations` answers from one process; whoever sums the contributions of points from several answers the same calls.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from georef.estimation.adjustment.block import Block, Indices, State
from georef.estimation.adjustment.equations.block_cholesky import Pattern
from georef.estimation.adjustment.equations.eliminate import (
    IMAGE_OBSERVATIONS,
    Linearized,
    Losses,
    constraint_cost,
    cost_of_squares,
    normal_equations,
)
from georef.estimation.adjustment.equations.prepared import Prepared, placed
from georef.estimation.adjustment.equations.reduced import Layout
from georef.estimation.adjustment.kernels.batches import Back, Work
from georef.estimation.adjustment.kernels.moves import move_points
from georef.geometry.rigid import Array

HIDDEN_SQUARE = 1e4
"""What an observation costs whose point a step moves out of sight: as much as one 100 sigmas off."""


@dataclass(frozen=True, eq=False)
class Moved:
    """Where a step leads: the state, its cost as in `Linearized` with HIDDEN_SQUARE for the squared residual of each
    image observation that no lens shows, how many are out of sight, and the sum of the squared steps of eliminated
    points, each times the diagonal of the point's normal matrix (0 will do without damping)."""

    state: State
    cost: float
    hidden: int
    squares: float


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
        self._back: Back = self._prepared.back()
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
            *(self._block, state),
            losses=self._losses,
            damping=damping,
            prepared=self._prepared,
            work=self._work,
            back=self._back,
        )

    def moved(self, state: State, step: Array, damping: float) -> Moved:
        after = moved_state(self.layout, state, step)
        prepared = self._prepared
        cost, hidden, squares = move_points(
            *(prepared.tracks, prepared.images, prepared.pairs, placed(state), placed(after), state.points, damping),
            *(self._image_scale, HIDDEN_SQUARE, step, self._back, after.points, self._work),
        )
        cost += constraint_cost(self._block, after, self.layout, self._losses)
        return Moved(after, float(cost), int(hidden), float(squares))


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
