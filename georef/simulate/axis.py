"""The line along which one drives: straight pieces and quarter circles on a gently sloping plane."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from georef.geometry.rigid import Array, Rigid3

START_HEADING_RAD = 0.42
SLOPE_EAST, SLOPE_NORTH = 0.006, 0.011


def ground_height(x: ArrayLike, y: ArrayLike) -> Array:
    """Height of the road surface in world, metres."""
    return SLOPE_EAST * np.asarray(x, np.float64) + SLOPE_NORTH * np.asarray(y, np.float64)


@dataclass(frozen=True, eq=False)
class Axis:
    """Pieces with start (s, x, y, heading) and curvature (1/m, positive to the right); closed ones repeat."""

    length_m: float
    closed: bool
    starts: Array
    curvature: Array

    def _piece(self, s: ArrayLike) -> tuple[Array, Array, Array]:
        along = np.atleast_1d(np.asarray(s, np.float64))
        if self.closed:
            along = along % self.length_m
        index = np.clip(np.searchsorted(self.starts[:, 0], along, side="right") - 1, 0, len(self.starts) - 1)
        start, curvature = self.starts[index], self.curvature[index]
        return along - start[:, 0], start, curvature

    def heading_rad(self, s: ArrayLike) -> Array:
        """Driving direction (N,), clockwise from north."""
        ahead, start, curvature = self._piece(s)
        return start[:, 3] + curvature * ahead

    def at(self, s: ArrayLike) -> Array:
        """Positions (N, 3) on the road surface in world."""
        return self.beside(s, 0.0)

    def beside(self, s: ArrayLike, right_m: ArrayLike, up_m: ArrayLike = 0.0) -> Array:
        """Positions (N, 3) to the right of the axis, above the road."""
        ahead, start, curvature = self._piece(s)
        heading = start[:, 3] + curvature * ahead
        bent = np.abs(curvature) > 0
        radius = 1.0 / np.where(bent, curvature, 1.0)
        straight = start[:, 1:3] + ahead[:, None] * _forward(start[:, 3])
        arc = start[:, 1:3] + radius[:, None] * (_right(start[:, 3]) - _right(heading))
        flat = np.where(bent[:, None], arc, straight) + np.asarray(right_m)[..., None] * _right(heading)
        return np.column_stack([flat, ground_height(flat[:, 0], flat[:, 1]) + np.asarray(up_m)])

    def frame(self, s: float, right_m: float, turn_rad: float = 0.0) -> Rigid3:
        """world_from_object on the ground: y looks along the driving direction turned clockwise, x to its right."""
        heading = float(self.heading_rad(s)[0]) + turn_rad
        c, n = np.cos(heading), np.sin(heading)
        rotation = np.array([[c, n, 0.0], [-n, c, 0.0], [0.0, 0.0, 1.0]])
        return Rigid3(rotation, self.beside(s, right_m)[0])


def _forward(heading: Array) -> Array:
    return np.stack([np.sin(heading), np.cos(heading)], axis=-1)


def _right(heading: Array) -> Array:
    return np.stack([np.cos(heading), -np.sin(heading)], axis=-1)


def straight_axis(length_m: float) -> Axis:
    return Axis(length_m, False, np.array([[0.0, 0.0, 0.0, START_HEADING_RAD]]), np.zeros(1))


def loop_axis(length_m: float, radius_m: float) -> Axis:
    """Four sides, the first twice as long as the second, joined by quarter circles to the right."""
    arc = 0.5 * np.pi * radius_m
    shared = (length_m - 4 * arc) / 6
    return _chain([2 * shared, arc, shared, arc] * 2, [0.0, 1 / radius_m] * 4, length_m)


def _chain(lengths: Sequence[float], curvature: Sequence[float], length_m: float) -> Axis:
    start, starts = np.array([0.0, 0.0, 0.0, START_HEADING_RAD]), []
    for length, bend in zip(lengths, curvature, strict=True):
        starts.append(start)
        piece = Axis(length, False, start[None], np.array([bend]))
        end = piece.at([start[0] + length])[0]
        start = np.array([start[0] + length, end[0], end[1], float(piece.heading_rad([start[0] + length])[0])])
    return Axis(length_m, True, np.array(starts), np.array(curvature))
