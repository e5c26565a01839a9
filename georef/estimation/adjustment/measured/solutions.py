"""A measured block freed of blunders, and its least-squares solutions with different points as control.

Image observations and GNSS positions pass the gates of `adjust_block` once, without any surveyed point where something
else holds the datum. Solutions with control pass them again, so that control points, their marks and GNSS positions
that contradict each other are found and named. Points that are check take part nowhere.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from georef.config import AdjustConfig
from georef.estimation.adjustment.adjust_block import AdjustedBlock, BlockOptions, Quality, adjust_block, quality
from georef.estimation.adjustment.block import KINDS_OF_POINT, Block, PointPriors, State
from georef.estimation.adjustment.blunders.gates import RejectedConstraint
from georef.estimation.adjustment.equations.cofactors import Cofactors
from georef.estimation.adjustment.equations.prepared import Prepared
from georef.estimation.adjustment.measured.check import BlockCheck, check_block
from georef.estimation.adjustment.problem import mark_observations
from georef.estimation.adjustment.solver import BlockSolution, Solve, SolverOptions, solve_block
from georef.geometry.rigid import Array
from georef.types.constraints import CheckPoint, ControlPoint
from georef.types.scene import Observations

_APPROXIMATE, _ENOUGH = 1e-3, 1e-7  # relative decrease of the cost at which a solution is good enough

Say = Callable[[str], None]


@dataclass(frozen=True, eq=False)
class CleanBlock:
    """A block without what was rejected, its image sigmas as they have shown to be; where it stands."""

    block: Block
    state: State
    rejected: tuple[RejectedConstraint, ...]  # GNSS positions, and what else is not an image observation
    dropped: int  # image observations
    dropped_points: int  # which fewer than two images see after that
    sigma_scale: float  # on the stated sigmas of image observations
    kept_points: NDArray[np.bool_] | None = None  # (P,) of the given block; None: all


@dataclass(frozen=True)
class RejectedMark:
    """A mark of a control point that contradicts the rest: what it is off by at the solution without it."""

    point_id: str
    image_id: str
    residual_px: tuple[float, float]
    sigmas: float  # length of the residual over the sigma of the mark


@dataclass(frozen=True, eq=False)
class Solved:
    """A solution with its quality, and surveyed points that took no part in it."""

    block: Block
    solution: BlockSolution
    quality: Quality
    check: BlockCheck
    rejected: tuple[RejectedConstraint, ...] = ()  # in this solution, beside those of the clean block
    rejected_marks: tuple[RejectedMark, ...] = ()
    given_control: tuple[str, ...] = ()  # ids, those that were rejected included

    @property
    def cofactors(self) -> Cofactors:
        return self.quality.cofactors

    @property
    def redundancy(self) -> float:
        """Of all observations and weights: their number less that of the unknowns."""
        return sum(part.redundancy for part in self.quality.components.values())

    @property
    def sigma0(self) -> float:
        """A posteriori standard deviation of unit weight, over the stated or rescaled sigmas."""
        return float(np.sqrt(2.0 * self.solution.cost / max(self.redundancy, 1.0)))


def options_of(config: AdjustConfig) -> BlockOptions:
    """Gates and losses as configured, for all kinds of observations."""
    options = BlockOptions.of(config.cauchy_scale, config.gate_probability)
    return replace(options, solver=SolverOptions(config.max_iterations, cost_tolerance=_ENOUGH))


def clean(
    block: Block,
    config: AdjustConfig,
    say: Say = lambda _: None,
    *,
    datum: Sequence[ControlPoint] = (),
    solve: Solve = solve_block,
) -> CleanBlock:
    """Finds and removes what contradicts the rest, and the sigma of the image observations that are left.

    datum: control points that help, where nothing else says where the block is; they are not part of what is left. A
    plain solution comes first: robust losses want approximate values that are not far off, calibrations included.
    solve: how solves are done, here and below, such as `checkpoints.Resumable`. Raises GeorefError where constraints
    leave the datum open.
    """
    say("first solution")
    given = with_control(block, datum)
    first = solve(given, options=SolverOptions(config.max_iterations, cost_tolerance=_APPROXIMATE))
    say("robust solution, gates, solution without what was rejected")
    found = adjust_block(given, options_of(config), start=first.state, solve=solve)
    kept, state = _without_last_points(found.block, found.solution.state, len(datum))
    marks = sum(len(point.marks) for point in datum)
    dropped = len(block.observations) - len(kept.observations)
    assert dropped <= found.dropped <= dropped + marks
    kept, state, seen = _with_seen_points(kept, state)
    rejected = tuple(entry for entry in found.rejected if entry.kind not in KINDS_OF_POINT)
    return CleanBlock(kept, state, rejected, dropped, int((~seen).sum()), found.sigma_scale, seen)


def solve_with_control(
    given: CleanBlock,
    control: Sequence[ControlPoint],
    check: Sequence[CheckPoint],
    config: AdjustConfig,
    solve: Solve = solve_block,
) -> Solved:
    """Adjusts with some points as control, which pass gates; the others are intersected and take no part."""
    start = start_with(given.state, control)
    block = with_control(given.block, control)
    names = tuple(point.point_id for point in control)
    if not control:
        return solved(block, start, check, config, solve)
    found = adjust_block(block, options_of(config), start=start, solve=solve)
    checked = check_block(found.block, found.solution.state, found.quality.cofactors.apply, check)
    marks = rejected_marks(block, found, control)
    return Solved(found.block, found.solution, found.quality, checked, found.rejected, marks, names)


def solved(
    block: Block, start: State, check: Sequence[CheckPoint], config: AdjustConfig, solve: Solve = solve_block
) -> Solved:
    """Least-squares solution of a block as it is, with its quality. Raises GeorefError where there is none."""
    options = SolverOptions(config.max_iterations, cost_tolerance=_ENOUGH)
    prepared = Prepared.of(block)
    solution = solve(block, options=options, start=start, prepared=prepared)
    found = quality(block, solution.state, prepared)
    return Solved(block, solution, found, check_block(block, solution.state, found.cofactors.apply, check))


def with_control(block: Block, control: Sequence[ControlPoint]) -> Block:
    """The block with surveyed points, which start from their given coordinates, and their marks."""
    first, marks = len(block.points), mark_observations(control, block.image_ids)
    positions = np.array([point.point_in_world for point in control]).reshape(-1, 3)
    priors = PointPriors(
        point=first + np.arange(len(control)),
        position=positions,
        information=np.array([point.information for point in control], dtype=np.float64).reshape(-1, 3, 3),
        kind=np.zeros(len(control), np.int64),
        point_ids=tuple(point.point_id for point in control),
    )
    return replace(
        block,
        points=np.concatenate([block.points, positions]),
        observations=Observations.joined([block.observations, marks.with_points(first + marks.point)]),
        point_priors=priors,
    )


def without_offset(block: Block) -> Block:
    """The block whose GNSS positions are taken as they are: no drift, no offset."""
    priors = block.position_priors
    fixed = replace(priors, drift_node=np.full_like(priors.drift_node, -1))
    return replace(block, position_priors=fixed, drift_information=np.zeros((0, 3, 3)))


def start_with(state: State, control: Sequence[ControlPoint]) -> State:
    """The state with control points at their given coordinates."""
    given = np.array([point.point_in_world for point in control]).reshape(-1, 3)
    return replace(state, points=np.concatenate([state.points, given]))


def residuals_px(block: Block, state: State, observations: Observations) -> Array:
    """Projected less measured pixels (n, 2); NaN where the lens does not show the point."""
    return block.views(state).project(observations.view, state.points[observations.point]) - observations.pixel


def rejected_marks(given: Block, found: AdjustedBlock, control: Sequence[ControlPoint]) -> tuple[RejectedMark, ...]:
    """The marks of control points that an adjustment dropped."""
    first, count = len(given.points) - len(control), len(given.image_ids)
    before, after = given.observations, found.block.observations
    left = set((after.point * count + after.view)[after.point >= first].tolist())
    rows = [
        r for r in np.flatnonzero(before.point >= first) if int(before.point[r] * count + before.view[r]) not in left
    ]
    lost = before.take(np.array(rows, dtype=np.int64))
    off = residuals_px(found.block, found.solution.state, lost)
    rows = zip(lost.point, lost.view, off, lost.sigma_px, strict=True)
    return tuple(
        RejectedMark(control[p - first].point_id, given.image_ids[v], _two(r), float(np.hypot(*r) / sigma))
        for p, v, r, sigma in rows
    )


def _two(values: Array) -> tuple[float, float]:
    return float(values[0]), float(values[1])


def _without_last_points(block: Block, state: State, count: int) -> tuple[Block, State]:
    """The block without its last points, what is given and what is observed of them."""
    left = len(block.points) - count
    kept = replace(
        block,
        points=block.points[:left],
        observations=block.observations.take(block.observations.point < left),
        point_priors=block.point_priors.take(block.point_priors.point < left),
    )
    return kept, replace(state, points=state.points[:left])


def _with_seen_points(block: Block, state: State) -> tuple[Block, State, NDArray[np.bool_]]:
    """The block without points that fewer than two images are left for, ends of distances excepted; which (P,) stay."""
    seen = np.bincount(block.observations.point, minlength=len(block.points)) >= 2
    seen[block.distances.a] = seen[block.distances.b] = True
    obs = block.observations.take(seen[block.observations.point])
    number, points = np.cumsum(seen) - 1, state.points[seen]
    kept = replace(
        block,
        observations=obs.with_points(number[obs.point]),
        points=points,
        distances=replace(block.distances, a=number[block.distances.a], b=number[block.distances.b]),
    )
    return kept, replace(state, points=points), seen
