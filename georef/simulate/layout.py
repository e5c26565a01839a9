"""Fills the street with objects: houses in lots, cars at the kerbs, trees, furniture, markings, fences."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
from numpy.random import Generator

from georef.geometry.rigid import Rigid3
from georef.simulate.axis import Axis, ground_height
from georef.simulate.street import CORNER_RADIUS_M, ChangeKind, Item, StreetOptions

ROAD_HALF_M, FACADE_M, LANE_HALF_M = 5.4, 8.6, 3.3
BEYOND_M = 45.0  # a straight street goes on this far beyond its ends
BLOCK_M, CROSSING_HALF_M = 130.0, 7.0
DEPTH_M, VISTA_M = 9.0, 12.0
AROUND_M, TILE_M = 90.0, 40.0
Triple = tuple[float, float, float]
VISTA_BOX: tuple[Triple, Triple] = ((-6.4, -1.8, -1.0), (6.4, DEPTH_M + 0.6, 27.0))


@dataclass
class Plan:
    """The objects so far; each draws from its own stream, so that one more object changes no other."""

    options: StreetOptions
    axis: Axis
    items: list[Item] = field(default_factory=list)
    planned: int = 0  # objects so far, with those that stand in neither epoch

    def stream(self, *key: int) -> Generator:
        return np.random.default_rng([self.options.seed, *key])

    def add(
        self,
        kind: str,
        along_m: float,
        frame: Rigid3,
        box: tuple[Triple, Triple],
        versions: tuple[int | None, int | None] = (1, 1),
        values: tuple[float, ...] = (),
    ) -> None:
        number = self.planned
        self.planned += 1
        if versions == (None, None):
            return
        seed = int(self.stream(1, number).integers(1 << 30))
        self.items.append(Item(number, kind, along_m, seed, frame, *box, versions, values))

    def versions(
        self, rng: Generator, kind: ChangeKind, chance: float, gone: float, present: float = 1.0
    ) -> tuple[int | None, int | None]:
        """Present in the first epoch with a chance; changed in the second with `chance` times the amount."""
        here, changed, leaves, comes = rng.random(4)
        first = 1 if here < present else None
        if changed >= chance * self.options.amount(kind):
            return first, first
        if first is None:
            return None, (2 if comes < present else None)
        return first, (None if leaves < gone else 2)


def plan(options: StreetOptions, axis: Axis) -> tuple[Item, ...]:
    """All objects of the street, in a fixed order."""
    out = Plan(options, axis)
    stretches = list(_stretches(axis))
    _roads(out)
    for number, (start, end) in enumerate(stretches):
        for side in (-1, 1):
            rng = out.stream(2, number, side + 1)
            _lots(out, rng, start, end, side)
            _parked(out, out.stream(3, number, side + 1), start, end, side)
            _greenery(out, out.stream(4, number, side + 1), start, end, side)
            _furniture(out, out.stream(5, number, side + 1), start, end, side)
            _fences(out, out.stream(7, number, side + 1), start, end, side)
        _markings(out, out.stream(6, number), start, end)
    _vistas(out)
    _ground_tiles(out)
    return _with_rebuilt(out)


def _stretches(axis: Axis) -> Iterator[tuple[float, float]]:
    """Where houses stand: between the crossings of a straight street, along the sides of a loop."""
    if axis.closed:
        bounds = [*axis.starts[:, 0], axis.length_m]
        yield from ((bounds[i] + 1.0, bounds[i + 1] - 1.0) for i in range(0, 8, 2))
        return
    end, start = axis.length_m + BEYOND_M, -BEYOND_M
    crossing = 95.0
    while crossing + CROSSING_HALF_M + 30.0 < end:
        yield start, crossing - CROSSING_HALF_M
        start, crossing = crossing + CROSSING_HALF_M, crossing + BLOCK_M
    yield start, end


def crossings(axis: Axis) -> list[float]:
    """Centres of the cross streets of a straight street."""
    ends = list(_stretches(axis))
    return [] if axis.closed else [end + CROSSING_HALF_M for _, end in ends[:-1]]


def _roads(out: Plan) -> None:
    start, end = (0.0, out.axis.length_m) if out.axis.closed else (-BEYOND_M, out.axis.length_m + BEYOND_M)
    edges = np.append(np.arange(start, end - 1.0, 15.0), end)
    for low, high in pairwise(edges.tolist()):
        middle = 0.5 * (low + high)
        out.add("road", middle, Rigid3.identity(), ((0, 0, 0), (0, 0, 0)), values=(low, high))
    if out.axis.closed:
        for piece in (1, 3, 5, 7):
            s = float(out.axis.starts[piece, 0])
            out.add("corner", s, Rigid3.identity(), ((0, 0, 0), (0, 0, 0)), values=(s, float(CORNER_RADIUS_M)))


def _lots(out: Plan, rng: Generator, start: float, end: float, side: int) -> None:
    along = start
    while end - along > 5.0:
        width = float(rng.uniform(8.0, 15.0))
        if end - along - width < 7.0:
            width = end - along
        middle = along + 0.5 * width
        gap = 0.0 if rng.random() < 0.8 else 1.2
        frame = out.axis.frame(middle, side * FACADE_M, turn_rad=side * 0.5 * np.pi)
        half = 0.5 * (width - gap)
        box = ((-half - 0.4, -1.8, -1.0), (half + 0.4, DEPTH_M + 0.6, 27.0))
        out.add("house", middle, frame, box, values=(width - gap, DEPTH_M, float(rng.random())))
        along += width


def _parked(out: Plan, rng: Generator, start: float, end: float, side: int) -> None:
    along = start + 4.0
    while along < end - 6.0:
        along += float(rng.uniform(5.4, 6.2))
        shift, kind = float(rng.uniform(-0.15, 0.15)), float(rng.random())
        frame = out.axis.frame(along, side * (ROAD_HALF_M - 1.12) + shift, turn_rad=0.0 if side > 0 else np.pi)
        versions = out.versions(rng, "cars", chance=1.0, gone=0.45, present=0.5)
        out.add("car", along, frame, ((-1.2, -2.9, -0.05), (1.2, 2.9, 2.4)), versions, (kind,))


def _greenery(out: Plan, rng: Generator, start: float, end: float, side: int) -> None:
    along = start + float(rng.uniform(3.0, 9.0))
    while along < end - 3.0:
        season = 1.0 if out.options.amount("season") > 0 else 0.0
        versions = out.versions(rng, "vegetation", chance=0.25, gone=0.5)
        if versions == (1, 1) and season:
            versions = (1, 3)
        frame = out.axis.frame(along, side * (ROAD_HALF_M + 0.75))
        if rng.random() < 0.62:
            out.add("tree", along, frame, ((-3.6, -3.6, -0.3), (3.6, 3.6, 11.0)), versions, (float(rng.random()),))
        else:
            box = ((-0.7, -2.2, 0.0), (0.7, 2.2, 2.2))
            out.add("hedge", along, frame, box, versions, (float(rng.random()),))
        along += float(rng.uniform(9.0, 17.0))


def _furniture(out: Plan, rng: Generator, start: float, end: float, side: int) -> None:
    along = start + float(rng.uniform(1.0, 4.0))
    while along < end - 1.0:
        kind = str(rng.choice(["lamp", "sign", "bin", "bollards", "cabinet", "bench", "rack", "column"]))
        turn = (0.0 if side > 0 else np.pi) + float(rng.normal(0, 0.03))
        frame = out.axis.frame(along, side * (ROAD_HALF_M + 0.55), turn_rad=turn)
        out.add(kind, along, frame, ((-1.6, -2.5, -0.2), (1.6, 2.5, 9.0)), values=(float(rng.random()),))
        along += float(rng.uniform(3.5, 7.5))


def _fences(out: Plan, rng: Generator, start: float, end: float, side: int) -> None:
    """Construction fences: of one epoch only, at the facade line, one in about 40 m."""
    for along in np.arange(start + 8.0, end - 8.0, 40.0):
        amount, length = out.options.amount("fences"), float(rng.uniform(6.0, 11.0))
        shown, late, shift = rng.random(3)
        middle = float(along + 18.0 * shift)
        frame = out.axis.frame(middle, side * (FACADE_M - 1.3), turn_rad=side * 0.5 * np.pi)
        box = ((-0.5 * length - 0.3, -0.6, -0.2), (0.5 * length + 0.3, 0.6, 2.4))
        versions = (None, None) if shown >= 0.9 * amount else (None, 1) if late < 0.6 else (1, None)
        out.add("fence", middle, frame, box, versions, (length,))


def _markings(out: Plan, rng: Generator, start: float, end: float) -> None:
    """Pieces of markings, each repainted or not: dashes, parking bays, a zebra, arrows."""

    def piece(along: float, right: float, what: int, half: tuple[float, float], turn: float = 0.0) -> None:
        versions = out.versions(rng, "markings", chance=0.45, gone=0.15)
        box = ((-half[0] - 0.5, -half[1] - 0.5, -0.05), (half[0] + 0.5, half[1] + 0.5, 0.05))
        frame = out.axis.frame(along, right, turn_rad=turn)
        out.add("marking", along, frame, box, versions, (float(what), *half))

    zebras = np.arange(start + 12.0, end - 6.0, 55.0)
    for along in np.arange(start + 2.0, end - 2.0, 6.0):
        if np.abs(zebras - along).min(initial=np.inf) > 3.2:
            piece(float(along), 0.0, 0, (0.07, 1.5))
        for side in (-1, 1):
            piece(float(along), side * LANE_HALF_M, 1, (0.06, 2.9))
            piece(float(along) + 2.95, side * (0.5 * (LANE_HALF_M + ROAD_HALF_M)), 2, (1.0, 0.06))
    for along in zebras:
        piece(float(along), 0.0, 3, (3.1, 1.5))
    for along in np.arange(start + 22.0, end - 6.0, 31.0):
        piece(float(along), 0.5 * LANE_HALF_M, 4, (0.5, 2.0))
        piece(float(along) + 9.0, -0.5 * LANE_HALF_M, 4, (0.5, 2.0), np.pi)


def _vistas(out: Plan) -> None:
    """Houses that close the view at the ends of a straight street and along cross streets."""
    rng, axis = out.stream(8), out.axis
    for s, frame in _loop_vistas(axis) if axis.closed else _straight_vistas(axis):
        out.add("house", s, frame, VISTA_BOX, values=(VISTA_M, DEPTH_M, float(rng.random())))


def _straight_vistas(axis: Axis) -> Iterator[tuple[float, Rigid3]]:
    for s, turn in ((-BEYOND_M, np.pi), (axis.length_m + BEYOND_M, 0.0)):
        for offset in np.arange(-24.0, 25.0, VISTA_M):
            yield s, axis.frame(s + (1.5 if turn == 0.0 else -1.5), float(offset), turn_rad=turn)
    for s in crossings(axis):
        for side in (-1, 1):
            for row in range(4):
                right = side * (FACADE_M + DEPTH_M + 6.0 + VISTA_M * row)
                for edge in (-1, 1):
                    turn = 0.0 if edge > 0 else np.pi
                    yield s, axis.frame(s + edge * (CROSSING_HALF_M + 0.05), right, turn_rad=turn)


def _loop_vistas(axis: Axis) -> Iterator[tuple[float, Rigid3]]:
    """Along the two streets that leave each corner outwards, on both their sides, and across their ends."""
    for piece in (1, 3, 5, 7):
        start, end = axis.starts[piece, 0], axis.starts[(piece + 1) % 8, 0]
        for s, back in ((float(start), 0.0), (float(end), np.pi)):
            arm = axis.frame(s, 0.0, back)
            places = [(side, side * 7.9, 32.0 + VISTA_M * row) for side in (-1, 1) for row in range(4)]
            for side, x, y in [*places, (0, -6.0, 71.0), (0, 6.0, 71.0)]:
                turned = axis.frame(s, 0.0, back + side * 0.5 * np.pi).rotation
                place = arm.apply([x, y, 0.0])
                place[2] = ground_height(place[0], place[1])
                yield float(start), Rigid3(turned, place)


def _ground_tiles(out: Plan) -> None:
    """The ground of a loop, inside and around, in squares that belong to the nearest part of the street."""
    if not out.axis.closed:
        return
    along = np.arange(0.0, out.axis.length_m, 4.0)
    line = out.axis.at(along)[:, :2]
    low, high = line.min(axis=0) - AROUND_M, line.max(axis=0) + AROUND_M
    for east in np.arange(low[0], high[0], TILE_M):
        for north in np.arange(low[1], high[1], TILE_M):
            apart = np.linalg.norm(line - [east + 0.5 * TILE_M, north + 0.5 * TILE_M], axis=1)
            nearest, values = float(along[int(np.argmin(apart))]), (float(east), float(north), TILE_M)
            out.add("ground", nearest, Rigid3.identity(), ((0, 0, 0), (0, 0, 0)), values=values)


def _with_rebuilt(out: Plan) -> tuple[Item, ...]:
    """Some facades are rebuilt: about one in eight at full change, at least one wherever facades change at all."""
    inside = (0.0, out.axis.length_m)
    houses = [i.number for i in out.items if i.kind == "house" and inside[0] <= i.along_m <= inside[1]]
    amount = out.options.amount("facade")
    count = int(np.ceil(amount * len(houses) / 8))
    chosen = set(out.stream(9).permutation(houses)[:count].tolist())
    return tuple(replace(item, versions=(1, 2)) if item.number in chosen else item for item in out.items)
