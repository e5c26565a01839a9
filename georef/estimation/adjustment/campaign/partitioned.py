"""A block solved part by part, by as many processes as an executor has: exactly the solution of the whole.

Each iteration asks all parts for their condensed equations, solves the sum of these for separators and border, and
tells each part its share of the step. Parts hold their own observations; here are states and separators alone.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cho_solve, get_lapack_funcs

from georef.estimation.adjustment.block import Block, Indices, State
from georef.estimation.adjustment.campaign.part_equations import Condensed, Given, PartEquations
from georef.estimation.adjustment.campaign.partition import Part, part_of, partition
from georef.estimation.adjustment.equations.block_cholesky import VANISHING_PIVOT, SingularMatrix
from georef.estimation.adjustment.equations.block_equations import HIDDEN_SQUARE, Moved, moved_state
from georef.estimation.adjustment.equations.eliminate import IMAGE_OBSERVATIONS, Losses, cost_of_squares
from georef.estimation.adjustment.equations.prepared import Prepared
from georef.estimation.adjustment.equations.reduced import Layout
from georef.estimation.adjustment.solver import BlockSolution, Iteration, Minimizer, SolverOptions
from georef.executor import Held
from georef.geometry.rigid import Array

(_dpotrf,) = get_lapack_funcs(("potrf",), dtype=np.float64)


@dataclass(frozen=True)
class Partitioned:
    """A `Solve` over several processes: held by them are the parts of one block at a time."""

    held: Held
    parts: int

    def __call__(
        self,
        block: Block,
        *,
        losses: Losses | None = None,
        options: SolverOptions | None = None,
        start: State | None = None,
        prepared: Prepared | None = None,
        on_iteration: Callable[[Iteration], None] | None = None,
    ) -> BlockSolution:
        attempts = PartedBlock.of(block, losses or {}, self.held, self.parts)
        return Minimizer(block, options or SolverOptions(), attempts).run(start or block.start(), on_iteration)


@dataclass(frozen=True, eq=False)
class _Place:
    """Where the unknowns of a part stand among all."""

    stations: Indices  # of the whole block, those inside first
    inner: int
    points: Indices
    shared: Indices  # its separators' and the border's unknowns among all shared ones

    @property
    def own(self) -> Indices:
        """The unknowns inside, of the whole reduced system."""
        return (6 * self.stations[: self.inner, None] + np.arange(6)).ravel()


@dataclass
class _Maker:
    """What makes a part's equations where they are held."""

    losses: dict[str, float]

    def __call__(self, part: Part) -> PartEquations:
        return PartEquations(part, self.losses)


@dataclass(frozen=True)
class Summary:
    """What all parts together tell of a state, as in `Linearized`."""

    cost: float
    hidden: int
    undetermined: int


class PartedBlock:
    """`Attempts` on a block whose parts are held elsewhere."""

    def __init__(self, layout: Layout, separators: Indices, places: list[_Place], losses: Losses, held: Held) -> None:
        self.layout, self._separators, self._places, self._held = layout, separators, places, held
        self._hidden_cost = cost_of_squares(np.array([HIDDEN_SQUARE]), losses.get(IMAGE_OBSERVATIONS, 0.0))
        self._at: State | None = None
        self._after: State | None = None
        self._sums: Condensed | None = None
        self._singular = -1

    @staticmethod
    def of(block: Block, losses: Losses, held: Held, parts: int) -> PartedBlock:
        """Cuts a block and hands out its parts, one after the other."""
        cut = partition(block, parts, block.world_from_rig.translation)
        layout, separators = Layout.of(block), cut.separators
        place_of = np.full(len(block.station_ids), -1)
        place_of[separators] = np.arange(len(separators))
        border = 6 * len(separators) + np.arange(layout.border)
        places: list[_Place] = []

        def handed_out(index: int) -> Part:
            part = part_of(block, cut, index)
            edge = place_of[part.stations[part.inner :]]
            shared = np.concatenate([(6 * edge[:, None] + np.arange(6)).ravel(), border])
            places.append(_Place(part.stations, part.inner, part.points, shared))
            return part

        held.put(_Maker(dict(losses)), (handed_out(index) for index in range(parts)))
        return PartedBlock(layout, separators, places, losses, held)

    @property
    def hidden_cost(self) -> float:
        return self._hidden_cost

    def linearized(self, state: State, damping: float) -> Summary:
        known, moved = state is self._at, state is self._after
        given = [
            Given(
                replace(state, world_from_rig=state.world_from_rig.take(p.stations), points=np.zeros((0, 3))),
                None if known or moved else state.points[p.points],
                moved,
                damping,
            )
            for p in self._places
        ]
        found = self._held.call(PartEquations.linearized, given)
        self._at, self._after = state, None
        size = 6 * len(self._separators) + self.layout.border
        sums = Condensed(np.zeros((size, size)), np.zeros(size), np.zeros(size), 0.0, 0, 0)
        self._singular = -1
        for place, part in zip(self._places, found, strict=True):
            sums.matrix[np.ix_(place.shared, place.shared)] += part.matrix
            sums.gradient[place.shared] += part.gradient
            sums.diagonal[place.shared] += part.diagonal
            if part.singular >= 0:
                self._singular = int(place.own[part.singular])
        cost, hidden = sum(f.cost for f in found), sum(f.hidden for f in found)
        self._sums = sums
        return Summary(cost, hidden, sum(f.undetermined for f in found))

    def attempt(self, state: State, damping: float) -> tuple[Array, Moved, float]:
        """As `Attempts` says. Raises SingularMatrix."""
        assert self._sums is not None
        if self._singular >= 0:
            raise SingularMatrix(self._singular)
        shared = self._shared_step(self._sums, damping)
        done = self._held.call(PartEquations.moved, [shared[place.shared] for place in self._places])
        edge = 6 * len(self._separators)
        step, points = np.zeros(self.layout.size), state.points.copy()
        step[(6 * self._separators[:, None] + np.arange(6)).ravel()] = shared[:edge]
        step[6 * self.layout.stations :] = shared[edge:]
        for place, led in zip(self._places, done, strict=True):
            step[place.own], points[place.points] = led.own, led.points
        after = replace(moved_state(self.layout, state, step), points=points)
        self._after = after
        cost, promised = sum(led.cost for led in done), sum(led.promised for led in done)
        return step, Moved(after, cost, sum(led.hidden for led in done), squares=0.0), promised

    def _shared_step(self, sums: Condensed, damping: float) -> Array:
        """Solves for separators and border, scaled to a unit diagonal before anything was eliminated."""
        if not len(sums.gradient):
            return sums.gradient
        own = sums.diagonal * (1.0 + damping)
        bad = np.flatnonzero(~(own > 0))
        if len(bad):
            raise SingularMatrix(self._unknown(int(bad[0])))
        scale = 1.0 / np.sqrt(own)
        matrix = (sums.matrix + np.diag(damping * sums.diagonal)) * scale[:, None] * scale
        factor, failed = _dpotrf(matrix, lower=1, clean=1)
        low = np.flatnonzero(np.square(np.diag(factor)) < VANISHING_PIVOT)
        if failed or len(low):
            raise SingularMatrix(self._unknown(int(failed - 1 if failed else low[0])))
        return -scale * np.asarray(cho_solve((factor, True), scale * sums.gradient))

    def _unknown(self, shared: int) -> int:
        """The number in the whole reduced system of a shared unknown."""
        edge = 6 * len(self._separators)
        if shared >= edge:
            return 6 * self.layout.stations + shared - edge
        return int(6 * self._separators[shared // 6] + shared % 6)
