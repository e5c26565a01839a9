"""Takes what contradicts the rest out of a block, and says what it was."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from georef.estimation.adjustment.block import KINDS_OF_POINT, KINDS_OF_POSE, Block, Indices
from georef.estimation.adjustment.equations.constraint_terms import DISTANCES, POSITION_PRIORS, RELATIVE_POSES
from georef.estimation.adjustment.quality.group_tests import TermTests

GATED = (*KINDS_OF_POSE, *KINDS_OF_POINT, POSITION_PRIORS, RELATIVE_POSES, DISTANCES)
"""Kinds of constraints that may be rejected; weights of mountings, calibrations, lever arms and drift only count."""


@dataclass(frozen=True)
class RejectedConstraint:
    """A constraint that contradicts the rest: its kind, a name, and its test."""

    kind: str
    name: str
    statistic: float
    dof: int


PARTS = ("pose_priors", "point_priors", "position_priors", "relative_poses", "distances")
"""Lists of a block whose rows may be rejected."""


@dataclass(frozen=True, eq=False)
class Contradictions:
    """Which rows of the lists of a block are out, by the names of the lists, and the tests that they failed by list and
    row."""

    out: Mapping[str, NDArray[np.bool_]]
    failed: Mapping[tuple[str, int], RejectedConstraint]

    @staticmethod
    def none(block: Block) -> Contradictions:
        return Contradictions({part: np.zeros(len(getattr(block, part)), bool) for part in PARTS}, {})

    @property
    def rejected(self) -> tuple[RejectedConstraint, ...]:
        return tuple(self.failed.values())

    def without(self, block: Block) -> Block:
        """The block that has all rows, without those that are out."""
        return replace(block, **{part: getattr(block, part).take(~out) for part, out in self.out.items()})

    def joined(self, block: Block, tests: list[TermTests], probability: float) -> Contradictions:
        """With those that fail their test at a probability that good ones pass; tests: of the block without what is out
        already."""
        out, failed = {part: rows.copy() for part, rows in self.out.items()}, dict(self.failed)
        left = {part: np.flatnonzero(~rows) for part, rows in self.out.items()}
        for test in tests:
            if test.name not in GATED:
                continue
            part = _part_of(test.name)
            for k in np.flatnonzero(test.rejected(probability)):
                row = int(left[part][test.row[k]])
                out[part][row] = True
                name, dof = name_of(block, test.name, row), int(test.dof[k])
                failed[part, row] = RejectedConstraint(test.name, name, float(test.statistic[k]), dof)
        return Contradictions(out, failed)

    def readmitted(self, rows: Mapping[str, Indices]) -> Contradictions:
        """With rows of lists that are in again."""
        out = {part: mask.copy() for part, mask in self.out.items()}
        for part, again in rows.items():
            out[part][again] = False
        return Contradictions(out, {(part, row): one for (part, row), one in self.failed.items() if out[part][row]})

    def in_the_rest(self, taken: Mapping[str, NDArray[np.bool_]]) -> Contradictions:
        """What failed its test, in a block without some rows of its lists."""
        left = {part: ~taken.get(part, np.zeros(len(mask), bool)) for part, mask in self.out.items()}
        place = {part: np.cumsum(mask) - 1 for part, mask in left.items()}
        failed = {(part, int(place[part][row])): one for (part, row), one in self.failed.items() if left[part][row]}
        out = {part: np.zeros(int(mask.sum()), bool) for part, mask in left.items()}
        for part, row in failed:
            out[part][row] = True
        return Contradictions(out, failed)


def _part_of(kind: str) -> str:
    if kind in KINDS_OF_POSE:
        return "pose_priors"
    if kind in KINDS_OF_POINT:
        return "point_priors"
    return {POSITION_PRIORS: "position_priors", RELATIVE_POSES: "relative_poses", DISTANCES: "distances"}[kind]


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
