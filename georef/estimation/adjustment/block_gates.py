"""Takes what contradicts the rest out of a block, and says what it was."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from georef.estimation.adjustment.block import KINDS_OF_POINT, KINDS_OF_POSE, Block
from georef.estimation.adjustment.constraint_terms import DISTANCES, POSITION_PRIORS, RELATIVE_POSES
from georef.estimation.adjustment.group_tests import TermTests

GATED = (*KINDS_OF_POSE, *KINDS_OF_POINT, POSITION_PRIORS, RELATIVE_POSES, DISTANCES)
"""Kinds of constraints that may be rejected; weights of mountings, calibrations, lever arms and drift only count."""


@dataclass(frozen=True)
class RejectedConstraint:
    """A constraint that contradicts the rest: its kind, a name, and its test."""

    kind: str
    name: str
    statistic: float
    dof: int


@dataclass(frozen=True, eq=False)
class Contradictions:
    """What fails its test: masks over the lists of a block, and what it was."""

    poses: NDArray[np.bool_]
    points: NDArray[np.bool_]
    positions: NDArray[np.bool_]
    motions: NDArray[np.bool_]
    distances: NDArray[np.bool_]
    rejected: tuple[RejectedConstraint, ...]

    @staticmethod
    def of(block: Block, tests: list[TermTests], probability: float) -> Contradictions:
        """Constraints that fail their test at a probability that good ones pass."""
        rejected: list[RejectedConstraint] = []
        drop: dict[str, NDArray[np.bool_]] = {
            "poses": np.zeros(len(block.pose_priors), bool),
            "points": np.zeros(len(block.point_priors), bool),
            POSITION_PRIORS: np.zeros(len(block.position_priors), bool),
            RELATIVE_POSES: np.zeros(len(block.relative_poses), bool),
            DISTANCES: np.zeros(len(block.distances), bool),
        }
        for test in tests:
            if test.name not in GATED:
                continue
            part = "poses" if test.name in KINDS_OF_POSE else "points" if test.name in KINDS_OF_POINT else test.name
            for k in np.flatnonzero(test.rejected(probability)):
                row = int(test.row[k])
                drop[part][row] = True
                name = name_of(block, test.name, row)
                rejected.append(RejectedConstraint(test.name, name, float(test.statistic[k]), int(test.dof[k])))
        return Contradictions(*drop.values(), rejected=tuple(rejected))

    def without(self, block: Block) -> Block:
        return replace(
            block,
            pose_priors=block.pose_priors.take(~self.poses),
            point_priors=block.point_priors.take(~self.points),
            position_priors=block.position_priors.take(~self.positions),
            relative_poses=block.relative_poses.take(~self.motions),
            distances=block.distances.take(~self.distances),
        )


def name_of(block: Block, kind: str, row: int) -> str:
    """What a user knows a constraint by: image, station or point."""
    if kind in KINDS_OF_POSE:
        return block.image_ids[block.pose_priors.image[row]]
    if kind in KINDS_OF_POINT:
        return block.point_priors.point_ids[row]
    if kind == POSITION_PRIORS:
        return block.station_ids[block.position_priors.station[row]]
    if kind == RELATIVE_POSES:
        pair = block.relative_poses.a[row], block.relative_poses.b[row]
        return " to ".join(block.station_ids[i] for i in pair)
    names = dict(zip(block.point_priors.point.tolist(), block.point_priors.point_ids, strict=True))
    ends = int(block.distances.a[row]), int(block.distances.b[row])
    return " to ".join(names.get(end, f"point {end}") for end in ends)
