"""The adjustment of a block against blunders: Cauchy, gates, refit without a robust loss, quality.

Every kind of observation has its own loss and gate. Coherent blocks of wrong poses and automatic GCPs are looked for
before single ones: a robust loss does not see through a stretch whose neighbours confirm each other.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from georef.estimation.adjustment.block import KINDS_OF_POINT, Block, State
from georef.estimation.adjustment.blunders.coherent import CoherentBlock, CoherentSearch
from georef.estimation.adjustment.blunders.coherent_members import settled
from georef.estimation.adjustment.blunders.coherent_search import (
    named_rows,
    search_coherent,
    shared_by_references,
    without_named,
)
from georef.estimation.adjustment.blunders.gates import Contradictions, RejectedConstraint
from georef.estimation.adjustment.blunders.readmission import agreeing
from georef.estimation.adjustment.equations.constraint_terms import (
    DISTANCES,
    POSE_PRIORS,
    POSITION_PRIORS,
    RELATIVE_POSES,
)
from georef.estimation.adjustment.equations.eliminate import IMAGE_OBSERVATIONS
from georef.estimation.adjustment.equations.prepared import Prepared
from georef.estimation.adjustment.quality.block_quality import Quality, quality
from georef.estimation.adjustment.solver import BlockSolution, Solve, SolverOptions, solve_block

_GATE_ROUNDS, _ROBUST_ROUNDS = 4, 2
_ROBUST_COST_TOLERANCE = 1e-5  # a looser one leaves gates that differ from those of an updated adjustment
_FAR_OFF = 1.25  # of a sigma against its residuals
SETTLED_SHARE = 1e-4  # of the observations: a gate that drops fewer changes nothing
_FACTOR_TOLERANCE = 0.05
_GROSS = 1e-3  # share of the false alarms of a gate that the first one may give: a robust solution is not the best one


@dataclass(frozen=True)
class BlockOptions:
    """losses: scale in sigmas of the Cauchy loss of each kind. gate_probability: what good observations pass with.
    reference_m: 1-sigma of the errors that right poses or points of a stretch may share, beside those of references."""

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
class AdjustedBlock:
    """A block that passed its gates, its solution and its quality.

    sigma_scale: of the image observations, against the block as it was given; dropped: how many of them were. wrong:
    coherent blocks of poses or points; undecidable: which of their sides is wrong, nothing but their number tells.
    """

    block: Block
    solution: BlockSolution
    quality: Quality
    rejected: tuple[RejectedConstraint, ...]
    wrong: tuple[CoherentBlock, ...]
    undecidable: bool
    dropped: int
    sigma_scale: float


@dataclass(frozen=True, eq=False)
class _InHand:
    """A block on its way through the gates, with what is prepared for it, and the scale of its image sigmas."""

    block: Block
    prepared: Prepared
    scale: float = 1.0

    def given(self, block: Block) -> _InHand:
        """With other constraints, fewer ones perhaps, or other sigmas; the same image observations."""
        return replace(self, block=block, prepared=self.prepared.restricted(block))

    def scaled(self, factor: float) -> _InHand:
        return replace(self.given(scaled_images(self.block, factor)), scale=self.scale * factor)

    def gated(self, found: Quality, probability: float) -> _InHand:
        """Without image observations that contradict the rest."""
        kept = ~found.images.rejected(probability, found.images.scale)
        block = replace(self.block, observations=self.block.observations.take(kept))
        return replace(self, block=block, prepared=self.prepared.restricted(block, kept))

    def quality(self, state: State) -> Quality:
        return quality(self.block, state, self.prepared)


def adjust_block(
    block: Block, options: BlockOptions, solve: Solve = solve_block, start: State | None = None
) -> AdjustedBlock:
    """Adjusts a block in which observations and constraints may be wrong.

    start: another state than the approximate values; the robust stage begins there. solve: how its solves are done,
    such as `checkpoints.Resumable`. Image sigmas are scaled by their own variance component; sigmas of constraints are
    tested and reported, never changed. Raises GeorefError where the constraints leave the datum open.
    """
    options = replace(options, reference_m=float(np.hypot(options.reference_m, shared_by_references(block))))
    hand = _InHand(block, Prepared.of(block))
    hand, state, found = _robust(hand, start or block.start(), options, solve)
    gated = hand.gated(found, _gross(options))
    search = search_coherent(
        *(gated.block, state, options.losses), reference_m=options.reference_m, prepared=gated.prepared
    )
    hand, state, search, wrong = _without_wrong(gated, state, found, search, options, solve)
    hand, solution, found, wrong = _refined(hand, wrong, state, options, solve)
    return AdjustedBlock(
        *(hand.block, solution, found, wrong.rejected, search.blocks, search.undecidable),
        *(len(block.observations) - len(hand.block.observations), hand.scale),
    )


def _robust(hand: _InHand, state: State, options: BlockOptions, solve: Solve) -> tuple[_InHand, State, Quality]:
    """The robust solution, with image sigmas near what the residuals show: a loss far too narrow fits too few."""
    for _ in range(_ROBUST_ROUNDS):
        state = _robust_state(hand, state, options, solve)
        found = hand.quality(state)
        factor = min(max(found.images.scale, 0.1), 10.0)
        if 1.0 / _FAR_OFF < factor < _FAR_OFF:
            return hand, state, found
        hand = hand.scaled(factor)
    state = _robust_state(hand, state, options, solve)
    return hand, state, hand.quality(state)


def _robust_state(hand: _InHand, state: State, options: BlockOptions, solve: Solve) -> State:
    """The robust solution as closely as gates need it."""
    solver = replace(options.solver, cost_tolerance=max(options.solver.cost_tolerance, _ROBUST_COST_TOLERANCE))
    return solve(hand.block, losses=options.losses, options=solver, start=state, prepared=hand.prepared).state


def _without_wrong(
    hand: _InHand, state: State, found: Quality, search: CoherentSearch, options: BlockOptions, solve: Solve
) -> tuple[_InHand, State, CoherentSearch, Contradictions]:
    """What is named is taken out, but for what agrees with the rest once the others are out, and gross contradictions
    are told. state, found: before that, of the same constraints."""
    lacking = hand
    if search.blocks:
        lacking = hand.given(without_named(hand.block, search))
        state = _robust_state(lacking, state, options, solve)
        found = lacking.quality(state)
    poses, points = named_rows(hand.block, search)
    none = Contradictions.none(hand.block)
    before = Contradictions({**none.out, "pose_priors": poses, "point_priors": points}, {})
    wrong = before.joined(hand.block, found.constraints, _gross(options))
    search = settled(
        *(search, hand.block, state, found.cofactors, found.images.points),
        probability=options.gate_probability,
        reference_m=options.reference_m,
    )
    poses, points = named_rows(hand.block, search)
    named = {"pose_priors": poses, "point_priors": points}
    return hand.given(without_named(hand.block, search)), state, search, wrong.in_the_rest(named)


def _gross(options: BlockOptions) -> float:
    return 1.0 - _GROSS * (1.0 - options.gate_probability)


def _refined(
    whole: _InHand, wrong: Contradictions, state: State, options: BlockOptions, solve: Solve
) -> tuple[_InHand, BlockSolution, Quality, Contradictions]:
    """Solutions without robust losses and gates by turns, until a gate changes nothing. whole: with all constraints
    that may take part; wrong: those that do not for the time being."""
    hand = whole.given(wrong.without(whole.block))
    hand, solution, found = _rescaled(*_solved(hand, state, options.solver, solve), options.solver, solve)
    settled = SETTLED_SHARE * len(hand.block.observations)
    for _ in range(_GATE_ROUNDS):
        every = replace(scaled_images(whole.block, hand.scale / whole.scale), observations=hand.block.observations)
        again = agreeing(wrong, every, solution.state, found, options.gate_probability)
        more = wrong.joined(every, found.constraints, options.gate_probability).readmitted(again)
        gated = hand.given(more.without(every)).gated(found, options.gate_probability)
        dropped = len(hand.block.observations) - len(gated.block.observations)
        if more.failed.keys() == wrong.failed.keys() and dropped <= settled:
            break
        wrong = more
        hand, solution, found = _solved(gated, solution.state, options.solver, solve)
    return (*_rescaled(hand, solution, found, options.solver, solve), wrong)


def _solved(hand: _InHand, state: State, solver: SolverOptions, solve: Solve) -> tuple[_InHand, BlockSolution, Quality]:
    solution = solve(hand.block, options=solver, start=state, prepared=hand.prepared)
    return hand, solution, hand.quality(solution.state)


def _rescaled(
    hand: _InHand, solution: BlockSolution, found: Quality, solver: SolverOptions, solve: Solve
) -> tuple[_InHand, BlockSolution, Quality]:
    """The image sigmas brought to what the residuals show, the solution for them and its quality."""
    component = found.components.get(IMAGE_OBSERVATIONS)
    factor = None if component is None else component.factor
    if factor is None or abs(factor - 1.0) < _FACTOR_TOLERANCE:
        return hand, solution, found
    return _solved(hand.scaled(factor), solution.state, solver, solve)


def scaled_images(block: Block, factor: float) -> Block:
    """The block with the sigmas of all keypoints scaled, those behind the automatic GCPs included; marks of control
    points are measured by other means and keep theirs."""
    priors, obs = block.point_priors, block.observations
    marked = np.zeros(len(block.points), bool)
    marked[priors.point[priors.kind == KINDS_OF_POINT.index("control")]] = True
    automatic = priors.kind == KINDS_OF_POINT.index("automatic")
    weight = np.where(automatic, factor**-2, 1.0)[:, None, None]
    given = replace(priors, information=priors.information * weight)
    scaled = replace(obs, sigma_px=obs.sigma_px * np.where(marked[obs.point], 1.0, factor))
    return replace(block, observations=scaled, point_priors=given)
