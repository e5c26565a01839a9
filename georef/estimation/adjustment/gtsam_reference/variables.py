"""What the keys of a block's graph in GTSAM stand for, and the way between its values and a state.

Plain integer keys: stations, mountings, calibrations, antennas, drift nodes, points, held ones counted too. Stations
and mountings are gtsam.Pose3, calibrations vectors of steps from the cameras of a state.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property

import gtsam
import numpy as np

from georef.estimation.adjustment.block import Block, Indices, State
from georef.estimation.adjustment.equations.reduced import Layout
from georef.estimation.adjustment.gtsam_reference.factors import Lens
from georef.geometry.poses import Poses
from georef.geometry.rigid import Array, Rigid3


@dataclass(frozen=True, eq=False)
class Variables:
    """The variables of a block, where what is held has its values of a state."""

    block: Block
    state: State

    @cached_property
    def _first(self) -> tuple[int, ...]:
        """First keys of mountings, calibrations, antennas, drift nodes and points."""
        block = self.block
        counts = [len(g) for g in (block.station_ids, block.mountings, block.calibrations, block.antennas)]
        return tuple(int(first) for first in np.cumsum([*counts, len(block.drift_information)]))

    def mounting(self, index: int) -> int | gtsam.Pose3:
        """Key of a mounting, its value where it is held."""
        held = self.block.mountings[index].information is None
        return pose3(self.state.rig_from_cam[index]) if held else self._first[0] + index

    def lens(self, index: int) -> Lens:
        unknown = self.block.calibrations[index].camera.estimate
        camera = replace(self.state.cameras[index], estimate=unknown)
        return Lens(camera, self._first[1] + index if unknown else None)

    def antenna(self, index: int) -> int | Array:
        """Key of a lever arm, its value where it is held."""
        held = self.block.antennas[index].information is None
        return self.state.lever_arms_m[index] if held else self._first[2] + index

    def drift(self, index: int) -> int:
        return self._first[3] + index

    def point(self, index: int) -> int:
        return self._first[4] + index

    def values(self) -> gtsam.Values:
        """All variables at the state."""
        block, state, values = self.block, self.state, gtsam.Values()
        for key, pose in enumerate(state.world_from_rig.to_list()):
            values.insert(key, pose3(pose))
        for i in range(len(block.mountings)):
            if isinstance(key := self.mounting(i), int):
                values.insert(key, pose3(state.rig_from_cam[i]))
        for i in range(len(block.calibrations)):
            if (key := self.lens(i).key) is not None:
                values.insert(key, np.zeros(len(self.lens(i).unknown)))
        for i in range(len(block.antennas)):
            if isinstance(key := self.antenna(i), int):
                values.insert(key, state.lever_arms_m[i])
        for i, shift in enumerate(state.drift_m):
            values.insert(self.drift(i), shift)
        for i, point in enumerate(state.points):
            values.insert(self.point(i), point)
        return values

    def state_of(self, values: gtsam.Values) -> State:
        """The values as a state of the block."""
        block, state = self.block, self.state
        mountings = [self.mounting(i) for i in range(len(block.mountings))]
        levers = [self.antenna(i) for i in range(len(block.antennas))]
        return State(
            Poses.of(rigid3(values.atPose3(i)) for i in range(len(block.station_ids))),
            Poses.of(rigid3(values.atPose3(m) if isinstance(m, int) else m) for m in mountings),
            tuple(self.lens(i).at(values) for i in range(len(block.calibrations))),
            _rows(values.atPoint3(lever) if isinstance(lever, int) else lever for lever in levers),
            _rows(values.atPoint3(self.drift(i)) for i in range(len(state.drift_m))),
            _rows(values.atPoint3(self.point(i)) for i in range(len(state.points))),
        )

    def places(self) -> dict[int, Indices]:
        """Where each variable's unknowns stand: stations, the border of the layout, points that are eliminated."""
        kept = Layout.of(self.block).kept_point >= 0
        points, zeros = self.point(0) + np.arange(len(kept)), self.values().zeroVectors()
        others = sorted(set(self.values().keys()) - set(points.tolist()))
        keys = [*others, *points[kept].tolist(), *points[~kept].tolist()]
        sizes = [len(zeros.at(key)) for key in keys]
        ends = np.cumsum(sizes)
        return {key: np.arange(end - size, end) for key, size, end in zip(keys, sizes, ends, strict=True)}


def pose3(pose: Rigid3) -> gtsam.Pose3:
    return gtsam.Pose3(pose.matrix())


def rigid3(pose: gtsam.Pose3) -> Rigid3:
    return Rigid3.from_matrix(pose.matrix())


def _rows(vectors: Iterable[Array]) -> Array:
    return np.array(list(vectors), dtype=np.float64).reshape(-1, 3)
