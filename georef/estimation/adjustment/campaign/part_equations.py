"""The normal equations of one part of a block, condensed to what it shares with others.

With the unknowns inside of the part as I and the shared ones (separators, border) as S:
N_SS - N_SI N_II^-1 N_IS and g_S - N_SI N_II^-1 g_I, of which the sum over parts is solved; then
x_I = -N_II^-1 (g_I + N_IS x_S).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from georef.estimation.adjustment.block import Indices, State
from georef.estimation.adjustment.campaign.partition import Part
from georef.estimation.adjustment.equations.block_cholesky import BlockCholesky, Pattern, SingularMatrix
from georef.estimation.adjustment.equations.block_equations import BlockEquations
from georef.estimation.adjustment.equations.eliminate import Linearized, Losses
from georef.estimation.adjustment.equations.reduced import Reduced
from georef.estimation.adjustment.solver import promised_decrease
from georef.geometry.rigid import Array


@dataclass(frozen=True, eq=False)
class Given:
    """What a part is told before it linearises: everything but its points. points: None: those that it has."""

    state: State
    points: Array | None
    moved: bool  # its points are those of the last step, which was taken
    damping: float


@dataclass(frozen=True, eq=False)
class Condensed:
    """The equations of a part for its J separators and the border: (6 J + B) unknowns.

    matrix, gradient: damping of what is inside added, that of shared unknowns not. diagonal: of the normal matrix
    before any elimination. singular: the unknown of the part whose pivot vanished, else -1.
    """

    matrix: Array
    gradient: Array
    diagonal: Array
    cost: float
    hidden: int
    undetermined: int
    singular: int = -1


@dataclass(frozen=True, eq=False)
class Led:
    """What a step does in a part: what is inside moves by own (6 I,), its points are then points (P, 3); cost and
    hidden as in `Moved`, and the decrease of the cost that the linear model promised."""

    own: Array
    points: Array
    cost: float
    promised: float
    hidden: int


class PartEquations:
    """One part at work: it keeps its observations, its points, and its factor between calls."""

    def __init__(self, part: Part, losses: Losses) -> None:
        self._part, self._equations = part, BlockEquations(part.block, losses)
        self._split: _Split | None = None
        self._inside: tuple[BlockCholesky, Array, Array] | None = None  # factor, coupling, gradient of what is inside
        self._points, self._after = part.block.points, part.block.points
        self._state: State = part.block.start()
        self._damping = 0.0
        self._told: tuple[float, Array, Array] = (0.0, np.zeros(0), np.zeros(0))  # gain, gradient, diagonal

    def linearized(self, given: Given) -> Condensed:
        """Linearises, eliminates points and what is inside."""
        if given.points is not None:
            self._points = given.points
        elif given.moved:
            self._points = self._after
        self._state, self._damping = _with_points(given.state, self._points), given.damping
        lin = self._equations.linearized(self._state, given.damping)
        self._told = lin.gain, lin.reduced.gradient, lin.diagonal
        self._split = self._split or _Split.of(lin.reduced, self._part.inner)
        return self._condensed(lin, self._split)

    def _condensed(self, lin: Linearized, split: _Split) -> Condensed:
        inner = 6 * self._part.inner
        inside, across, matrix = split.taken(lin.reduced, self._damping * lin.diagonal[:inner])
        gradient = lin.reduced.gradient
        rest = lin.diagonal[inner:], lin.cost, lin.hidden, lin.undetermined
        self._inside = None  # its memory is free for the next
        if not inner:
            return Condensed(matrix, gradient, *rest)
        try:
            factor = BlockCholesky.of(split.pattern, inside)
        except SingularMatrix as error:
            return Condensed(matrix, gradient[inner:], *rest, singular=error.unknown)
        self._inside = factor, across, gradient[:inner]
        half = factor.half_solved(np.concatenate([across, gradient[:inner, None]], axis=1))
        return Condensed(matrix - half[:, :-1].T @ half[:, :-1], gradient[inner:] - half[:, :-1].T @ half[:, -1], *rest)

    def moved(self, shared: Array) -> Led:
        """Where a step of the shared unknowns (6 J + B,) leads."""
        own = np.zeros(0)
        if self._inside is not None:
            factor, across, gradient = self._inside
            own = -factor.solve(gradient + across @ shared)
        step = np.concatenate([own, shared])
        moved = self._equations.moved(self._state, step, self._damping)
        self._after = moved.state.points
        promised = promised_decrease(*self._told, step, self._damping, moved)
        return Led(own, self._after, moved.cost, promised, moved.hidden)


def _with_points(state: State, points: Array) -> State:
    return State(state.world_from_rig, state.rig_from_cam, state.cameras, state.lever_arms_m, state.drift_m, points)


@dataclass(frozen=True, eq=False)
class _Split:
    """Where the blocks of a reduced matrix stand once its first `inner` stations are apart; the same at every state."""

    inner: int
    stations: int
    pattern: Pattern  # of what is inside
    inside: Indices  # entries of the matrix, as all here
    own: Indices  # those on the diagonal, among `inside`
    across: Indices
    shared: Indices
    row: Indices
    column: Indices

    @staticmethod
    def of(reduced: Reduced, inner: int) -> _Split:
        stations = reduced.layout.stations
        row = np.repeat(np.arange(stations), np.diff(reduced.first))
        column = reduced.column
        within = (row < inner) & (column < inner)
        inside = np.flatnonzero(within)
        first = np.concatenate([[0], np.cumsum(np.bincount(row[inside], minlength=inner))])[: inner + 1]
        pattern = Pattern.of(first, column[inside])
        across = np.flatnonzero((row < inner) & (column >= inner))
        return _Split(inner, stations, pattern, inside, first[:-1], across, np.flatnonzero(row >= inner), row, column)

    def taken(self, reduced: Reduced, added: Array) -> tuple[Array, Array, Array]:
        """Blocks (n, 6, 6) inside with a diagonal (6 I,) added, the coupling (6 I, 6 J + B), the rest (6 J + B,)²."""
        inner, edge = self.inner, self.stations - self.inner
        inside, six = reduced.block[self.inside].copy(), np.arange(6)
        inside[self.own[:, None], six, six] += added.reshape(-1, 6)
        coupling = np.zeros((inner, 6, edge, 6))
        coupling[self.row[self.across], :, self.column[self.across] - inner, :] = reduced.block[self.across]
        matrix = np.zeros((edge, 6, edge, 6))
        a, b, blocks = self.row[self.shared] - inner, self.column[self.shared] - inner, reduced.block[self.shared]
        matrix[b, :, a, :] = np.swapaxes(blocks, 1, 2)
        matrix[a, :, b, :] = blocks
        by_border = reduced.border[6 * inner :]
        return (
            inside,
            np.concatenate([coupling.reshape(6 * inner, 6 * edge), reduced.border[: 6 * inner]], axis=1),
            np.block([[matrix.reshape(6 * edge, 6 * edge), by_border], [by_border.T, reduced.corner]]),
        )
