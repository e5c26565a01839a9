"""The adjustment of an epoch's problem in which every image is a station by itself, as the stage `adjust` makes it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from georef.config import AdjustConfig
from georef.estimation.adjustment.adjust_block import AdjustedBlock, BlockOptions, Quality, adjust_block, quality
from georef.estimation.adjustment.block import Block, State
from georef.estimation.adjustment.from_problem import block_of
from georef.estimation.adjustment.problem import Problem
from georef.estimation.adjustment.solver import SolverOptions, solve_block
from georef.geometry.rigid import Array, Rigid3


def images_alone(problem: Problem) -> Block:
    """The block of a problem: station i is image i."""
    return block_of(problem, [None] * len(problem.image_ids))


@dataclass(frozen=True, eq=False)
class Solved:
    """A block of images that are stations by themselves at a state, with its quality there."""

    block: Block
    state: State
    quality: Quality

    @staticmethod
    def of(block: Block) -> Solved:
        """The solution without losses and gates."""
        solution = solve_block(block)
        assert solution.converged
        return Solved(block, solution.state, quality(block, solution.state))

    @property
    def poses(self) -> list[Rigid3]:
        return self.block.world_from_cam(self.state).to_list()

    @cached_property
    def cofactors(self) -> Array:
        """Joint covariance (6M, 6M) of all images against the reference as it is published."""
        return self.quality.cofactors.joint(np.arange(6 * len(self.block.image_ids)))

    @cached_property
    def reference_part(self) -> Array:
        """What the errors of the references add to it (6M, 6M)."""
        if self.quality.references is None:
            return np.zeros_like(self.cofactors)
        size = 6 * len(self.block.image_ids)
        return self.quality.references.cov(np.eye(self.quality.cofactors.layout.size)[:, :size])

    @cached_property
    def cov(self) -> Array:
        """Joint covariance (6M, 6M) of all images with the errors of the references."""
        return self.cofactors + self.reference_part

    def joint(self, images: list[int]) -> Array:
        """Joint covariance (6k, 6k) of several images."""
        rows = np.concatenate([np.arange(6 * i, 6 * i + 6) for i in images])
        return self.cov[np.ix_(rows, rows)]


@dataclass(frozen=True, eq=False)
class Outcome(Solved):
    """An adjustment with losses and gates."""

    adjusted: AdjustedBlock

    def rejected(self, kind: str) -> set[str]:
        """Names of what the gates rejected of a kind."""
        return {constraint.name for constraint in self.adjusted.rejected if constraint.kind == kind}


def adjusted(given: Problem | Block, config: AdjustConfig | None = None) -> Outcome:
    """A problem, or its block, adjusted with the options of the stage `adjust`."""
    config = config or AdjustConfig()
    options = BlockOptions.of(config.cauchy_scale, config.gate_probability)
    options = replace(options, solver=SolverOptions(max_iterations=config.max_iterations))
    found = adjust_block(images_alone(given) if isinstance(given, Problem) else given, options)
    return Outcome(found.block, found.solution.state, found.quality, found)
