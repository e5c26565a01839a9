"""What of an adjustment's time goes into its points."""

from __future__ import annotations

import time

from georef.estimation.adjustment.block import State
from georef.estimation.adjustment.equations.block_cholesky import Pattern
from georef.estimation.adjustment.equations.block_equations import Equations, Moved
from georef.estimation.adjustment.equations.eliminate import Linearized
from georef.estimation.adjustment.equations.reduced import Layout
from georef.geometry.rigid import Array


class TimedEquations:
    """Equations that count the CPU-seconds they take, `points_s`; the rest of a solution is the reduced equations."""

    def __init__(self, equations: Equations) -> None:
        self._equations = equations
        self.points_s = 0.0

    @property
    def layout(self) -> Layout:
        return self._equations.layout

    @property
    def pattern(self) -> Pattern:
        return self._equations.pattern

    @property
    def hidden_cost(self) -> float:
        return self._equations.hidden_cost

    def linearized(self, state: State, damping: float) -> Linearized:
        begin = time.process_time()
        found = self._equations.linearized(state, damping)
        self.points_s += time.process_time() - begin
        return found

    def moved(self, state: State, step: Array, damping: float) -> Moved:
        begin = time.process_time()
        found = self._equations.moved(state, step, damping)
        self.points_s += time.process_time() - begin
        return found
