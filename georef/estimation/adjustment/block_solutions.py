"""A measured block freed of blunders, and its least-squares solutions with different points as control.

Plain solution from approximate values, solution with Cauchy's loss, gate of image observations, and then plain
solutions of what is left, in which image observations have the sigma that they have shown.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import chi2

from georef.config import AdjustConfig
from georef.estimation.adjustment.block import Block, PointPriors, State
from georef.estimation.adjustment.block_check import BlockCheck, check_block
from georef.estimation.adjustment.cofactors import Cofactors, cofactors
from georef.estimation.adjustment.eliminate import IMAGE_OBSERVATIONS, normal_equations
from georef.estimation.adjustment.prepared import Prepared
from georef.estimation.adjustment.problem import mark_observations
from georef.estimation.adjustment.reduced import Layout
from georef.estimation.adjustment.solver import BlockSolution, SolverOptions, solve_block
from georef.geometry.rigid import Array
from georef.types.constraints import CheckPoint, ControlPoint
from georef.types.scene import Observations

_MEDIAN_OF_TWO = 2.0 * float(np.log(2.0))  # of a chi-square with two degrees of freedom
_APPROXIMATE, _ENOUGH = 1e-3, 1e-7  # relative decrease of the cost at which a solution is good enough

Say = Callable[[str], None]


@dataclass(frozen=True, eq=False)
class CleanBlock:
    """A block without image observations that were rejected, its sigmas as they have shown to be; where it stands."""

    block: Block
    state: State
    rejected: int  # image observations
    dropped_points: int  # which fewer than two images see after that
    sigma_scale: float  # on the stated sigmas of image observations


@dataclass(frozen=True, eq=False)
class Solved:
    """A solution, the inverse of its normal equations, and surveyed points that took no part in it."""

    block: Block
    solution: BlockSolution
    cofactors: Cofactors
    check: BlockCheck
    sigma0: float  # a posteriori, over the stated or rescaled sigmas


def clean(block: Block, config: AdjustConfig, say: Say = lambda _: None) -> CleanBlock:
    """Finds and removes image observations that contradict the others, and the sigma of those that are left."""
    say("first solution")
    first = solve_block(block, options=SolverOptions(config.max_iterations, cost_tolerance=_APPROXIMATE))
    say("robust solution")
    robust = solve_block(
        block,
        losses={IMAGE_OBSERVATIONS: config.cauchy_scale},
        options=SolverOptions(config.max_iterations, cost_tolerance=_APPROXIMATE),
        start=first.state,
    )
    square = squared_norms(block, robust.state)
    share = max(redundancy(block) / (2.0 * len(block.observations)), 0.05)
    scale2 = float(np.median(square)) / (_MEDIAN_OF_TWO * share)
    kept, state, dropped = _kept(block, robust.state, square <= scale2 * float(chi2.ppf(config.gate_probability, 2)))
    say("solution without what was rejected")
    refit = solve_block(kept, options=SolverOptions(config.max_iterations, cost_tolerance=_ENOUGH), start=state)
    scale = float(np.sqrt(2.0 * refit.cost / redundancy(kept)))
    scaled = replace(kept, observations=kept.observations.scaled(scale))
    rejected = len(block.observations) - len(kept.observations)
    return CleanBlock(scaled, refit.state, rejected, dropped, scale)


def solve_with_control(
    given: CleanBlock, control: Sequence[ControlPoint], check: Sequence[CheckPoint], config: AdjustConfig
) -> Solved:
    """Adjusts with some points as control; the others are intersected from its images and take no part."""
    return solved(with_control(given.block, control), start_with(given.state, control), check, config)


def solved(block: Block, start: State, check: Sequence[CheckPoint], config: AdjustConfig) -> Solved:
    """Least-squares solution with the inverse of its normal equations. Raises GeorefError where there is none."""
    prepared = Prepared.of(block)
    options = SolverOptions(config.max_iterations, cost_tolerance=_ENOUGH)
    solution = solve_block(block, options=options, start=start, prepared=prepared)
    found = cofactors(normal_equations(block, solution.state, prepared=prepared).reduced)
    checked = check_block(block, solution.state, found.apply, check)
    sigma0 = float(np.sqrt(2.0 * solution.cost / max(redundancy(block), 1)))
    return Solved(block, solution, found, checked, sigma0)


def with_control(block: Block, control: Sequence[ControlPoint]) -> Block:
    """The block with surveyed points, which start from their given coordinates, and their marks."""
    first, marks = len(block.points), mark_observations(control, block.image_ids)
    positions = np.array([point.point_in_world for point in control]).reshape(-1, 3)
    priors = PointPriors(
        point=first + np.arange(len(control)),
        position=positions,
        information=np.array([np.linalg.inv(point.cov) for point in control], dtype=np.float64).reshape(-1, 3, 3),
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


def squared_norms(block: Block, state: State) -> Array:
    """Squared whitened residuals (n,) of the image observations; infinite where the lens does not show the point."""
    obs = block.observations
    residual = block.views(state).project(obs.view, state.points[obs.point]) - obs.pixel
    return np.nan_to_num(np.sum(np.square(residual), axis=1) / np.square(obs.sigma_px), nan=np.inf)


def redundancy(block: Block) -> int:
    """Observations less unknowns; priors of shared unknowns count where they have weight."""
    priors = sum(int(np.linalg.matrix_rank(m)) for m in (*_weights(block), *block.drift_information))
    points = int(sum(np.linalg.matrix_rank(m) for m in block.point_priors.information))
    poses = 6 * (len(block.pose_priors) + len(block.relative_poses)) + 3 * len(block.position_priors)
    observed = 2 * len(block.observations) + poses + points + len(block.distances) + priors
    kept = int((Layout.of(block).kept_point >= 0).sum())
    return observed - Layout.of(block).size - 3 * (len(block.points) - kept)


def _weights(block: Block) -> list[Array]:
    """Prior weights of mountings, calibrations and lever arms that are not held."""
    shared = [*(m.information for m in block.mountings), *(a.information for a in block.antennas)]
    return [m for m in shared if m is not None] + [c.information for c in block.calibrations if c.camera.estimate]


def _kept(block: Block, state: State, good: np.ndarray) -> tuple[Block, State, int]:
    """The block with some observations, without points that fewer than two images are left for."""
    obs = block.observations.take(good)
    seen = np.bincount(obs.point, minlength=len(block.points)) >= 2
    obs = obs.take(seen[obs.point])
    number = np.cumsum(seen) - 1
    points = state.points[seen]
    kept = replace(block, observations=obs.with_points(number[obs.point]), points=points)
    return kept, replace(state, points=points), int((~seen).sum())


def start_with(state: State, control: Sequence[ControlPoint]) -> State:
    """The state with control points at their given coordinates."""
    given = np.array([point.point_in_world for point in control]).reshape(-1, 3)
    return replace(state, points=np.concatenate([state.points, given]))
