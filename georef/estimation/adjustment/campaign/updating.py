"""An adjusted campaign with images or control added: from what stands, with gates where what is new reaches.

New images are posed against their neighbours, which stay where they are within their covariances; that block is small
and passes all gates by itself. Then the whole is solved from there, all old decisions kept: few iterations are needed.
 What is new, and what shares points with it, is tested with the cofactors of the whole.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from georef.estimation.adjustment.adjust_block import (
    SETTLED_SHARE,
    AdjustedBlock,
    BlockOptions,
    Quality,
    adjust_block,
    quality,
    scaled_images,
)
from georef.estimation.adjustment.block import KINDS_OF_POINT, KINDS_OF_POSE, Block, PosePriors, State
from georef.estimation.adjustment.blunders.gates import GATED, RejectedConstraint, name_of
from georef.estimation.adjustment.campaign.partition import Partition, part_of
from georef.estimation.adjustment.campaign.standing import Standing, without_constraints
from georef.estimation.adjustment.equations.block_equations import BlockEquations
from georef.estimation.adjustment.equations.constraint_terms import POSITION_PRIORS
from georef.estimation.adjustment.solver import Solve, solve_block

_log = logging.getLogger(__name__)
_ROUNDS, _POINT_STEPS = 3, 2


@dataclass(frozen=True, eq=False)
class _New:
    """What is new in a block: images, stations; points that new images see or new constraints give; and the stations
    that see those."""

    images: NDArray[np.bool_]  # (M,)
    stations: NDArray[np.bool_]  # (S,)
    points: NDArray[np.bool_]  # (P,)
    reached: NDArray[np.bool_]  # (S,)

    @staticmethod
    def of(standing: Standing, block: Block) -> _New:
        obs, images = block.observations, ~standing.known_images(block)
        points = np.zeros(len(block.points), bool)
        points[obs.point[images[obs.view]]] = True
        given = block.point_priors
        names = zip(given.kind.tolist(), given.point_ids, strict=True)
        unknown = [(KINDS_OF_POINT[kind], name) not in standing.constraints for kind, name in names]
        points[given.point[np.array(unknown, dtype=bool)]] = True
        reached = ~standing.known_stations(block)
        stations = reached.copy()
        reached[block.station[images]] = True
        reached[block.station[obs.view[points[obs.point]]]] = True
        return _New(images, stations, points, reached)


def updated(standing: Standing, given: Block, options: BlockOptions, solve: Solve = solve_block) -> AdjustedBlock:
    """Adjusts a block of which most stands adjusted already.

    given: the whole block with what was added, nothing rejected. What was rejected stays so, image sigmas keep their
    scale. Automatic GCPs are triangulated anew where matches were added: they go by their names all the same. Raises
    GeorefError where the constraints leave the datum open.
    """
    out = {(r.kind, r.name) for r in standing.rejected} | standing.coherent
    block = without_constraints(scaled_images(given, standing.sigma_scale), out)
    block = replace(block, observations=block.observations.take(standing.passed(block)))
    new = _New.of(standing, block)
    start = standing.start(block)
    if new.stations.any() or new.images.any():
        block, start = _placed(standing, block, new, start, options)
    start = _intersected(block, start)
    return _settled(standing, given, block, start, options, solve)


def _placed(standing: Standing, block: Block, new: _New, start: State, options: BlockOptions) -> tuple[Block, State]:
    """The block without image observations of new images that contradict their neighbours, and its new stations posed
    by these."""
    stations = len(block.station_ids)
    inside = np.where(new.points, 0, 1)
    cut = Partition(2, np.where(new.stations, 0, 1), np.zeros(stations, bool), inside)
    part = part_of(block.started(start), cut, 0)
    local = replace(part.block, pose_priors=_held(standing, part.block, part.block.pose_priors, start))
    local = replace(local, distances=local.distances.take(np.zeros(len(local.distances), bool)))
    found = adjust_block(local, options)
    known = ~new.stations[part.stations]
    posed = found.solution.state.world_from_rig
    start.world_from_rig.rotation[part.stations[~known]] = posed.rotation[~known]
    start.world_from_rig.translation[part.stations[~known]] = posed.translation[~known]
    images = np.flatnonzero(np.isin(block.station, part.stations))
    obs, left = block.observations, found.block.observations
    kept = set(zip(images[left.view].tolist(), part.points[left.point].tolist(), strict=True))
    doubtful = np.flatnonzero(new.images[obs.view])
    pairs = zip(obs.view[doubtful].tolist(), obs.point[doubtful].tolist(), strict=True)
    keep = np.ones(len(obs), bool)
    keep[doubtful[[pair not in kept for pair in pairs]]] = False
    _log.info("new images: %d of %d observations rejected", np.count_nonzero(~keep), len(doubtful))
    return replace(block, observations=obs.take(keep)), start


def _held(standing: Standing, local: Block, own: PosePriors, start: State) -> PosePriors:
    """The priors of new stations, and the poses that stand of the others with their covariances."""
    at = {name: i for i, name in enumerate(standing.station_ids)}
    first = np.unique(local.station, return_index=True)[1]
    images = [int(i) for i in first if local.station_ids[local.station[i]] in at]
    old = [at[local.station_ids[local.station[i]]] for i in images]
    rig_from_cam = start.rig_from_cam.take(local.mounting[images])
    turned = rig_from_cam.inverse().adjoint()
    cov = turned @ standing.station_cov[old] @ np.swapaxes(turned, 1, 2)
    poses = standing.world_from_rig.take(np.array(old, dtype=np.int64)) @ rig_from_cam
    kind = np.full(len(images), KINDS_OF_POSE.index("orientation"))
    joined = (np.concatenate(pair) for pair in ((own.cov, cov), (own.kind, kind)))
    both = type(poses)(
        np.concatenate([own.world_from_cam.rotation, poses.rotation]),
        np.concatenate([own.world_from_cam.translation, poses.translation]),
    )
    return PosePriors(np.concatenate([own.image, np.array(images, dtype=np.int64)]), both, *joined)


def _intersected(block: Block, state: State) -> State:
    """The points where their rays meet, stations held: steps of Gauss and Newton, of points alone."""
    equations = BlockEquations(block)
    for _ in range(_POINT_STEPS):
        equations.linearized(state, 0.0)
        state = equations.moved(state, np.zeros(equations.layout.size), 0.0).state
    return state


def _settled(
    standing: Standing, given: Block, block: Block, state: State, options: BlockOptions, solve: Solve
) -> AdjustedBlock:
    """Solutions of the whole, and gates where what is new reaches, until these change nothing."""
    rejected = standing.rejected
    undamped = replace(options.solver, damping=0.0)
    solution = solve(block, options=undamped, start=state)
    found = quality(block, solution.state)
    for _ in range(_ROUNDS):
        new = _New.of(standing, block)
        more = _contradicting(standing, block, new, found, options.gate_probability)
        obs = block.observations
        bad = found.images.rejected(options.gate_probability, found.images.scale) & new.points[obs.point]
        if not more and bad.sum() <= SETTLED_SHARE * len(given.observations):
            break
        block = without_constraints(block, {(r.kind, r.name) for r in more})
        block = replace(block, observations=obs.take(~bad))
        rejected = rejected + more
        solution = solve(block, options=undamped, start=solution.state)
        found = quality(block, solution.state)
    dropped = len(given.observations) - len(block.observations)
    return AdjustedBlock(block, solution, found, rejected, (), False, dropped, standing.sigma_scale)


def _contradicting(
    standing: Standing, block: Block, new: _New, found: Quality, probability: float
) -> tuple[RejectedConstraint, ...]:
    """Constraints that fail their test, of those that are new or stand where what is new reaches."""
    out: list[RejectedConstraint] = []
    for test in found.constraints:
        if test.name not in GATED:
            continue
        for k in np.flatnonzero(test.rejected(probability)):
            row = int(test.row[k])
            name = name_of(block, test.name, row)
            if (test.name, name) not in standing.constraints or _reached(block, new, test.name, row):
                out.append(RejectedConstraint(test.name, name, float(test.statistic[k]), int(test.dof[k])))
    return tuple(out)


def _reached(block: Block, new: _New, kind: str, row: int) -> bool:
    if kind in KINDS_OF_POSE:
        return bool(new.reached[block.station[block.pose_priors.image[row]]])
    if kind in KINDS_OF_POINT:
        return bool(new.points[block.point_priors.point[row]])
    return kind == POSITION_PRIORS and bool(new.reached[block.position_priors.station[row]])
