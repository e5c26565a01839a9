"""Solves that survive an interruption: how far each came is kept under its place in the adjustment.

An adjustment is a sequence of solves, each of which follows from the ones before. One that is run again after an
interruption takes finished solves as they were, goes on in the middle of the one that was under way, and so ends at the
same numbers. A changed input has another digest, and finds nothing.
"""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Callable, Mapping, Sized
from dataclasses import dataclass, field, fields, is_dataclass, replace
from typing import Any, Protocol

import numpy as np

from georef.estimation.adjustment.block import Block, State
from georef.estimation.adjustment.equations.eliminate import Losses
from georef.estimation.adjustment.equations.prepared import Prepared
from georef.estimation.adjustment.solver import BlockSolution, Iteration, Solve, SolverOptions, solve_block

_log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Reached:
    """How far a solve came: its solution so far, whether that is all, and the damping to go on with."""

    solution: BlockSolution
    finished: bool
    damping: float


class Checkpoints(Protocol):
    """Keeps how far solves came. What is written is there as a whole or not at all, whenever the process ends."""

    def read(self, key: str) -> Reached | None: ...
    def write(self, key: str, reached: Reached) -> None: ...


@dataclass
class Resumable:
    """A `Solve` that goes on from the last iteration which its checkpoints know of; one for each run of an adjustment.

    Solves are told apart by a digest of what the first was given to the last digit, by their number, losses and
    options, and by how much is observed: what follows from earlier solves may differ in rounding.
    """

    checkpoints: Checkpoints
    solve: Solve = solve_block
    _given: str = field(default="", init=False)
    _count: int = field(default=0, init=False)

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
        options, start, done = options or SolverOptions(), start or block.start(), 0
        key = self._key(block, losses or {}, options, start)
        before = self.checkpoints.read(key)
        if before is not None and before.finished:
            return before.solution
        if before is not None:
            done, start = before.solution.iterations, before.solution.state
            _log.info("going on after iteration %d", done)
            left = max(options.max_iterations - done, 1)
            options = replace(options, max_iterations=left, damping=before.damping)

        def keep(iteration: Iteration) -> None:
            number = done + iteration.number
            so_far = BlockSolution(iteration.state, iteration.cost, number, False, 0, 0)
            self.checkpoints.write(key, Reached(so_far, False, iteration.next_damping))
            if on_iteration:
                on_iteration(replace(iteration, number=number))

        found = self.solve(block, losses=losses, options=options, start=start, prepared=prepared, on_iteration=keep)
        solution = replace(found, iterations=done + found.iterations)
        self.checkpoints.write(key, Reached(solution, True, 0.0))
        return solution

    def _key(self, block: Block, losses: Losses, options: SolverOptions, start: State) -> str:
        self._given = self._given or digest_of(block, start)
        self._count += 1
        observed = [len(value) for part in fields(block) if isinstance(value := getattr(block, part.name), Sized)]
        return digest_of(self._given, self._count, losses, options, observed)


def digest_of(*values: Any) -> str:
    """A digest of data: dataclasses, mappings, sequences, arrays, numbers, texts, None. Raises TypeError for others."""
    hashed = hashlib.blake2b(digest_size=16)
    for value in values:
        _add(hashed, value)
    return hashed.hexdigest()


def _add(hashed: hashlib.blake2b, value: Any) -> None:
    if isinstance(value, np.ndarray):
        hashed.update(f"array {value.dtype.str} {value.shape} ".encode())
        hashed.update(np.ascontiguousarray(value).data)
    elif is_dataclass(value):
        hashed.update(f"{type(value).__name__}( ".encode())
        for part in fields(value):
            _add(hashed, getattr(value, part.name))
    elif isinstance(value, Mapping):
        _add(hashed, [item for pair in sorted(value.items()) for item in pair])
    elif isinstance(value, str | int | float | bool | np.number | None):
        hashed.update(f"{value!r} ".encode())
    elif isinstance(value, list | tuple):
        hashed.update(f"{len(value)}[ ".encode())
        for item in value:
            _add(hashed, item)
    else:
        raise TypeError(f"{type(value).__name__} has no digest")
