"""A grid of streets between blocks of houses, and a drive through it: where a vehicle goes, and what it can see.

Streets run north at x = i STREETS_EAST_M and east at y = j STREETS_NORTH_M, with facades FACADE_M beside their axes.
Some blocks are open: what stands beyond is seen from the streets on their other side. Around the grid all is built.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from georef.geometry.poses import Poses
from georef.geometry.rigid import Array
from georef.simulate.axis import ground_height
from georef.simulate.trajectory import SmoothProcess, Wander, rig_rotations

STREETS_EAST_M, STREETS_NORTH_M, FACADE_M = 75.0, 105.0, 8.0
REACH_M = 75.0  # of a ray: no more than one block on the way can be open
_LANE_M, _CORNER_M, _STEP_M = 1.7, 3.5, 0.5
_OPEN_SHARE, _HEIGHTS_M = 0.15, (6.0, 20.0)
_DRIVEN_TWICE = 1.35  # length of the drive over the length of the streets


@dataclass(frozen=True, eq=False)
class City:
    """Streets (columns north, rows east), and the blocks between, left of and right of them, with their heights."""

    columns: int
    rows: int
    height_m: Array  # (columns + 1, rows + 1); 0: open

    @staticmethod
    def draw(columns: int, rows: int, rng: np.random.Generator) -> City:
        shape = (columns + 1, rows + 1)
        is_open = rng.random(shape) < _OPEN_SHARE
        is_open[[0, -1]] = is_open[:, [0, -1]] = False
        return City(columns, rows, np.where(is_open, 0.0, rng.uniform(*_HEIGHTS_M, shape)))

    def first_facade(self, origins: Array, directions: Array) -> tuple[Array, Array]:
        """Where horizontal rays (N, 2), directions of unit length, first meet houses, and how high those are.

        Distances (N,), infinite beyond two streets; heights (N,). Rays start in streets.
        """
        best, height = np.full(len(origins), np.inf), np.zeros(len(origins))
        for axis, spacing, count in ((0, STREETS_EAST_M, self.columns), (1, STREETS_NORTH_M, self.rows)):
            forward = directions[:, axis] > 0
            side = np.where(forward, 1.0, -1.0)
            # the facade that is entered first beyond the origin, and the one of the next street
            street = np.floor(side * origins[:, axis] / spacing - FACADE_M / spacing) + 1.0
            for further in (0, 1):
                index = (side * (street + further)).astype(np.int64)
                inside = (index >= 0) & (index < count)
                with np.errstate(divide="ignore", invalid="ignore"):
                    distance = (index * spacing + side * FACADE_M - origins[:, axis]) / directions[:, axis]
                distance = np.where(inside & np.isfinite(distance), distance, np.inf)
                entered = index + forward
                found = self._height(axis, entered, origins, directions, distance)
                nearer = (found > 0) & (distance < best)
                best, height = np.where(nearer, distance, best), np.where(nearer, found, height)
        return best, height

    def _height(
        self, axis: int, entered: NDArray[np.int64], origins: Array, directions: Array, distance: Array
    ) -> Array:
        """Heights (N,) of the blocks that rays enter across an axis; 0 where they are open, or a street is."""
        other = 1 - axis
        spacing, count = ((STREETS_EAST_M, self.columns), (STREETS_NORTH_M, self.rows))[other]
        here = origins[:, other] + np.where(np.isfinite(distance), distance, 0.0) * directions[:, other]
        nearest = np.clip(np.round(here / spacing), 0, count - 1)
        in_block = np.isfinite(distance) & (np.abs(here - nearest * spacing) > FACADE_M)
        block = np.clip(np.floor(here / spacing).astype(np.int64) + 1, 0, count)
        entered = np.clip(entered, 0, self.height_m.shape[axis] - 1)
        height = self.height_m[entered, block] if axis == 0 else self.height_m[block, entered]
        return np.where(in_block, height, 0.0)

    def sees(self, origins: Array, points: Array, slack_m: float = 0.6) -> NDArray[np.bool_]:
        """Whether no house stands between origins (N, 2 or more) and points (N, 2 or more), as seen from above."""
        way = points[:, :2] - origins[:, :2]
        distance = np.linalg.norm(way, axis=1)
        facade, _ = self.first_facade(origins[:, :2], way / np.maximum(distance, 1e-9)[:, None])
        return facade >= distance - slack_m


@dataclass(frozen=True, eq=False)
class Route:
    """True poses of a rig (x right, y forward, z up, on the road) at its stations, in the order of the drive."""

    city: City
    s_m: Array  # (S,) along the drive
    street: NDArray[np.int64]  # (S,) rising: which passage of a street a station belongs to
    world_from_rig: Poses


def draw_route(stations: int, rng: np.random.Generator) -> Route:
    """Stations 3 to 5 m apart along streets of a city that fits, with loops and with streets driven again."""
    s = np.cumsum(rng.uniform(3.0, 5.0, stations))
    city = _fitting(float(s[-1]), rng)
    corners = _corners(city, float(s[-1]) + 20.0, rng)
    dense = np.arange(0.0, float(s[-1]) + 10.0, _STEP_M)
    lengths = np.linalg.norm(np.diff(corners, axis=0), axis=1)
    ends = np.concatenate([[0.0], np.cumsum(lengths)])
    way = np.column_stack([np.interp(dense, ends, corners[:, k]) for k in (0, 1)])
    way = gaussian_filter1d(way, _CORNER_M / _STEP_M, axis=0, mode="nearest")
    ahead = np.gradient(way, _STEP_M, axis=0)
    heading = np.unwrap(np.arctan2(ahead[:, 0], ahead[:, 1]))
    right = np.column_stack([np.cos(heading), -np.sin(heading)])
    lane = way + _LANE_M * right
    flat = np.column_stack([np.interp(s, dense, lane[:, k]) for k in (0, 1)])
    turn = np.interp(s, dense, heading)
    street = np.searchsorted(ends, s, side="right") - 1
    return Route(city, s, street.astype(np.int64), _swaying(s, flat, turn, rng))


def _swaying(s: Array, flat: Array, heading: Array, rng: np.random.Generator) -> Poses:
    """Poses on the road that stray from the lane as a vehicle does."""
    wander = Wander()
    motions = (wander.lateral, wander.bounce, wander.yaw_deg, wander.pitch_deg, wander.roll_deg)
    lateral, bounce, yaw, pitch, roll = (SmoothProcess.draw(rng, [m[0]], m[1]).at(s)[:, 0] for m in motions)
    flat = flat + lateral[:, None] * np.column_stack([np.cos(heading), -np.sin(heading)])
    ahead = np.column_stack([np.sin(heading), np.cos(heading)])
    grade = np.arctan(ground_height(ahead[:, 0], ahead[:, 1]))
    angles = np.column_stack([heading + np.radians(yaw), grade + np.radians(pitch), np.radians(roll)])
    height = ground_height(flat[:, 0], flat[:, 1]) + bounce
    return Poses(rig_rotations(angles), np.column_stack([flat, height]))


def _fitting(length_m: float, rng: np.random.Generator) -> City:
    """The smallest city about as wide as long whose streets are a little shorter than the drive."""
    wanted, columns, rows = length_m / _DRIVEN_TWICE, 2, 2

    def streets_m(columns: int, rows: int) -> float:
        return columns * (rows - 1) * STREETS_NORTH_M + rows * (columns - 1) * STREETS_EAST_M

    while streets_m(columns, rows) < wanted:
        if columns * STREETS_EAST_M <= rows * STREETS_NORTH_M:
            columns += 1
        else:
            rows += 1
    return City.draw(columns, rows, rng)


def _corners(city: City, length_m: float, rng: np.random.Generator) -> Array:
    """Crossings (K, 2) that a drive of a length passes: at each into the street driven least so far, never back."""
    driven: dict[frozenset[tuple[int, int]], int] = {}
    before, here = (-1, -1), (0, 0)
    out, total = [here], 0.0
    while total < length_m:
        steps = [(here[0] + a, here[1] + b) for a, b in ((1, 0), (0, 1), (-1, 0), (0, -1))]
        ways = [n for n in steps if 0 <= n[0] < city.columns and 0 <= n[1] < city.rows and n != before]
        tired = np.array([driven.get(frozenset((here, n)), 0) for n in ways]) + 0.5 * rng.random(len(ways))
        following = ways[int(np.argmin(tired))]
        way = frozenset((here, following))
        driven[way] = driven.get(way, 0) + 1
        total += STREETS_EAST_M if following[0] != here[0] else STREETS_NORTH_M
        before, here = here, following
        out.append(here)
    return np.array(out) * [STREETS_EAST_M, STREETS_NORTH_M]
