"""The adjustment of a block against blunders: Cauchy, gates, refit without a robust loss, quality.

Every kind of observation has its own loss and gate. Coherent blocks of wrong poses are looked for before single ones:
a robust loss does not see through a stretch whose neighbours confirm each other.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from georef.errors import GeorefError
from georef.estimation.adjustment.block import KINDS_OF_POINT, Block, State
from georef.estimation.adjustment.block_cholesky import SingularMatrix
from georef.estimation.adjustment.block_gates import RejectedConstraint, without_contradictions
from georef.estimation.adjustment.cofactors import Cofactors, cofactors
from georef.estimation.adjustment.coherent import CoherentBlock, CoherentSearch, coherent_blocks, without_agreeing
from georef.estimation.adjustment.components import Component
from georef.estimation.adjustment.constraint_terms import DISTANCES, POSE_PRIORS, POSITION_PRIORS, RELATIVE_POSES
from georef.estimation.adjustment.datum import explain_singular
from georef.estimation.adjustment.eliminate import IMAGE_OBSERVATIONS, Linearized, normal_equations
from georef.estimation.adjustment.group_tests import ImageTests, TermTests, components, constraint_tests, image_tests
from georef.estimation.adjustment.prepared import Prepared
from georef.estimation.adjustment.reference_part import ReferencePart
from georef.estimation.adjustment.shift_system import pose_shifts
from georef.estimation.adjustment.solver import BlockSolution, SolverOptions, solve_block

_GATE_ROUNDS, _ROBUST_ROUNDS = 3, 2
_ROBUST_COST_TOLERANCE = 1e-5
_FAR_OFF = 1.25  # of a sigma against its residuals
_SETTLED_SHARE = 1e-4  # of the observations: a gate that drops fewer changes nothing
_FACTOR_TOLERANCE = 0.05
_GROSS = 1e-3  # share of the false alarms of a gate that the first one may give: a robust solution is not the best one


@dataclass(frozen=True)
class BlockOptions:
    """losses: scale in sigmas of the Cauchy loss of each kind. gate_probability: what good observations pass with.
    reference_m: 1-sigma of the errors that right poses of a stretch may share."""

    losses: Mapping[str, float]
    gate_probability: float = 0.999
    reference_m: float = 0.01
    solver: SolverOptions = field(default_factory=SolverOptions)

    @staticmethod
    def of(cauchy_scale: float, gate_probability: float = 0.999) -> BlockOptions:
        """One scale for all kinds."""
        kinds = (IMAGE_OBSERVATIONS, POSE_PRIORS, POSITION_PRIORS, RELATIVE_POSES, DISTANCES, *KINDS_OF_POINT)
        return BlockOptions(dict.fromkeys(kinds, cauchy_scale), gate_probability)


@dataclass(frozen=True, eq=False)
class Quality:
    """Cofactors and tests of a block at a state."""

    cofactors: Cofactors
    images: ImageTests
    constraints: list[TermTests]
    components: dict[str, Component]
    references: ReferencePart | None  # what the errors of reference images add through automatic GCPs


@dataclass(frozen=True, eq=False)
class AdjustedBlock:
    """A block that passed its gates, its solution and its quality.

    sigma_scale: of the image observations, against the block as it was given; dropped: how many of them were. wrong:
    coherent blocks of poses; undecidable: which of their sides is wrong, nothing but their number tells.
    """

    block: Block
    solution: BlockSolution
    quality: Quality
    rejected: tuple[RejectedConstraint, ...]
    wrong: tuple[CoherentBlock, ...]
    undecidable: bool
    dropped: int
    sigma_scale: float


def adjust_block(block: Block, options: BlockOptions, start: State | None = None) -> AdjustedBlock:
    """Adjusts a block in which observations and constraints may be wrong.

    start: another state than the approximate values, where the robust stage begins. Image sigmas are scaled by their
    own variance component; sigmas of constraints are tested and reported, never changed. Raises GeorefError where the
    constraints leave the datum open.
    """
    given, gross = block, 1.0 - _GROSS * (1.0 - options.gate_probability)
    block, state, scale, found = _robust(block, start or block.start(), options)
    block, _ = _gate_images(block, found, gross)
    search = _coherent(block, state, options)
    if search.blocks:
        lacking = _without_rows(block, search)
        state = _robust_state(lacking, state, options)
        search = without_agreeing(search, block, state, quality(lacking, state).cofactors, options.gate_probability)
        block = _without_rows(block, search)
    block, rejected = without_contradictions(block, quality(block, state).constraints, gross)
    solution = solve_block(block, options=options.solver, start=state)
    block, solution, scale, found = _rescaled(block, solution, scale, quality(block, solution.state), options)
    for _ in range(_GATE_ROUNDS):
        kept, more = without_contradictions(block, found.constraints, options.gate_probability)
        kept, dropped = _gate_images(kept, found, options.gate_probability)
        if not more and dropped <= _SETTLED_SHARE * len(given.observations):
            break
        block, rejected = kept, rejected + more
        solution = solve_block(block, options=options.solver, start=solution.state)
        found = quality(block, solution.state)
    block, solution, scale, found = _rescaled(block, solution, scale, found, options)
    dropped = len(given.observations) - len(block.observations)
    return AdjustedBlock(block, solution, found, rejected, search.blocks, search.undecidable, dropped, scale)


def quality(block: Block, state: State) -> Quality:
    """Cofactors, tests and variance components at a state, for the stated sigmas. Raises GeorefError where the normal
    equations are singular."""
    prepared = Prepared.of(block)
    lin = normal_equations(block, state, prepared=prepared)
    found = _inverted(block, state, lin)
    images = image_tests(block, state, found, prepared)
    references = ReferencePart.of(block, state, found)
    tests = constraint_tests(block, state, found, images.points, references)
    return Quality(found, images, tests, components(block, state, images, tests), references)


def _inverted(block: Block, state: State, lin: Linearized) -> Cofactors:
    try:
        return cofactors(lin.reduced)
    except SingularMatrix:
        words = explain_singular(block, state, lin.reduced)
        raise GeorefError(
            words or "The adjustment has no unique solution: its constraints leave unknowns open."
        ) from None


def _robust(block: Block, state: State, options: BlockOptions) -> tuple[Block, State, float, Quality]:
    """The robust solution, with image sigmas near what the residuals show: a loss far too narrow fits too few."""
    scale = 1.0
    for _ in range(1 + _ROBUST_ROUNDS):
        state = _robust_state(block, state, options)
        found = quality(block, state)
        factor = min(max(found.images.scale, 0.1), 10.0)
        if 1.0 / _FAR_OFF < factor < _FAR_OFF:
            return block, state, scale, found
        block, scale = _scaled(block, factor), scale * factor
    return block, state, scale, quality(block, state)


def _robust_state(block: Block, state: State, options: BlockOptions) -> State:
    """The robust solution as closely as gates need it: reweighting converges slowly."""
    solver = replace(options.solver, cost_tolerance=max(options.solver.cost_tolerance, _ROBUST_COST_TOLERANCE))
    return solve_block(block, losses=options.losses, options=solver, start=state).state


def _scaled(block: Block, factor: float) -> Block:
    """The block with the sigmas of all keypoints scaled, those behind the automatic GCPs included."""
    priors = block.point_priors
    automatic = priors.kind == KINDS_OF_POINT.index("automatic")
    weight = np.where(automatic, factor**-2, 1.0)[:, None, None]
    given = replace(priors, information=priors.information * weight)
    return replace(block, observations=block.observations.scaled(factor), point_priors=given)


def _gate_images(block: Block, found: Quality, probability: float) -> tuple[Block, int]:
    """The block without image observations that contradict the rest, and how many they are."""
    bad = found.images.rejected(probability, found.images.scale)
    return replace(block, observations=block.observations.take(~bad)), int(bad.sum())


def _coherent(block: Block, state: State, options: BlockOptions) -> CoherentSearch:
    """Wrong stretches of poses at the robust solution: poses with their full weight, all else with that of its loss, so
    that its single blunders do not bend the network."""
    losses = {kind: scale for kind, scale in options.losses.items() if kind != POSE_PRIORS}
    lin = normal_equations(block, state, losses=losses)
    system = pose_shifts(block, state, _inverted(block, state, lin), lin.reduced.gradient)
    if system is None:
        return CoherentSearch((), False)
    return coherent_blocks(block, system, reference_m=options.reference_m)


def _without_rows(block: Block, search: CoherentSearch) -> Block:
    keep = np.ones(len(block.pose_priors), bool)
    for wrong in search.blocks:
        keep[wrong.rows] = False
    return replace(block, pose_priors=block.pose_priors.take(keep))


def _rescaled(
    block: Block, solution: BlockSolution, scale: float, found: Quality, options: BlockOptions
) -> tuple[Block, BlockSolution, float, Quality]:
    """The image sigmas brought to what the residuals show, the solution for them and its quality."""
    component = found.components.get(IMAGE_OBSERVATIONS)
    factor = None if component is None else component.factor
    if factor is None or abs(factor - 1.0) < _FACTOR_TOLERANCE:
        return block, solution, scale, found
    block = _scaled(block, factor)
    solution = solve_block(block, options=options.solver, start=solution.state)
    return block, solution, scale * factor, quality(block, solution.state)
