"""A reference that is itself imperfect: a smooth deformation of the whole, and small errors of each image.

The deformation bends the surveyed street like a beam: a place along it moves by d(s) and turns with the slope of d, so
that images near each other stay consistent and what is triangulated from them moves along. `moved` of an exact point
is what the reference says of it: coordinates relative to the reference.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial import KDTree

from georef.geometry.rigid import Array, Rigid3, exp_so3, nearest_rotation
from georef.simulate.axis import Axis
from georef.simulate.trajectory import SmoothProcess

_AXIS_STEP_M = 0.25


@dataclass(frozen=True)
class ReferenceQuality:
    """1-sigma of a published exterior orientation: smooth absolute errors, and relative ones of each image."""

    absolute_m: float = 0.015
    absolute_length_m: float = 100.0
    relative_m: float = 0.005
    relative_deg: float = 0.01


@dataclass(frozen=True, eq=False)
class Deformation:
    """The smooth part of the reference's errors as a field over the street."""

    axis: Axis
    process: SmoothProcess

    @staticmethod
    def draw(axis: Axis, quality: ReferenceQuality, rng: np.random.Generator) -> Deformation:
        sigmas = [quality.absolute_m] * 3
        return Deformation(axis, SmoothProcess.draw(rng, sigmas, quality.absolute_length_m))

    def moved(self, points_in_world: Array) -> Array:
        """Exact points (N, 3) -> where the reference has them (N, 3)."""
        points = np.asarray(points_in_world, dtype=np.float64).reshape(-1, 3)
        shift, turn, on_axis = self._at(points)
        return points + shift + np.cross(turn, points - on_axis)

    def moved_pose(self, world_from_cam: Rigid3) -> Rigid3:
        """An exact pose as it is relative to the reference."""
        centre = world_from_cam.translation[None]
        _, turn, _ = self._at(centre)
        rotation = nearest_rotation(exp_so3(turn[0]) @ world_from_cam.rotation)
        return Rigid3(rotation, self.moved(centre)[0])

    def _at(self, points: Array) -> tuple[Array, Array, Array]:
        """Shift (N, 3), turn (N, 3) rad and nearest point of the axis (N, 3) of points (N, 3)."""
        s, tangent = self._nearest(points)
        turn = np.cross(tangent, self.process.slope(s))
        return self.process.at(s), turn, self.axis.at(s)

    def _nearest(self, points: Array) -> tuple[Array, Array]:
        samples, positions, tree = self._samples
        index = np.asarray(tree.query(points[:, :2])[1], dtype=np.int64)
        heading = self.axis.heading_rad(samples[index])
        tangent = np.column_stack([np.sin(heading), np.cos(heading), np.zeros(len(points))])
        along = np.sum((points - positions[index]) * tangent, axis=1)
        s = samples[index] + np.clip(along, -_AXIS_STEP_M, _AXIS_STEP_M)
        return np.clip(s, 0.0, self.axis.length_m), tangent  # beyond the ends the last place's shift and turn go on

    @cached_property
    def _samples(self) -> tuple[Array, Array, KDTree]:
        s = np.linspace(0.0, self.axis.length_m, max(2, int(self.axis.length_m / _AXIS_STEP_M) + 1))
        positions = self.axis.at(s)
        return s, positions, KDTree(positions[:, :2])


def published(
    poses: Sequence[Rigid3], deformation: Deformation, quality: ReferenceQuality, rng: np.random.Generator
) -> list[Rigid3]:
    """The exterior orientation that is published for exact poses: deformed, with errors of each image.

    Relative errors: the position along world axes, the rotation about the camera axes.
    """
    out = []
    for pose in poses:
        moved = deformation.moved_pose(pose)
        turn = exp_so3(np.radians(quality.relative_deg) * rng.normal(size=3))
        shift = quality.relative_m * rng.normal(size=3)
        out.append(Rigid3(nearest_rotation(moved.rotation @ turn), moved.translation + shift))
    return out
