"""Carriageway, kerbs, sidewalks, markings: built along the axis."""

from __future__ import annotations

import numpy as np

from georef.geometry.rigid import Array, Rigid3, exp_so3
from georef.simulate import materials as m
from georef.simulate.axis import SLOPE_EAST, SLOPE_NORTH, Axis, ground_height
from georef.simulate.layout import CROSSING_HALF_M, FACADE_M, ROAD_HALF_M, crossings
from georef.simulate.mesh import Builder

KERB_M, KERB_WIDE_M, RAISED_M = 0.12, 0.18, 0.004
SURROUNDINGS_M = 90.0
_TILT = exp_so3([SLOPE_NORTH, -SLOPE_EAST, 0.0])  # road plane from level
_ASPHALT, _PAVING, _KERB, _GROUND = (0.115, 0.115, 0.118), (0.36, 0.345, 0.32), (0.42, 0.41, 0.40), (0.13, 0.17, 0.06)


def _strip(b: Builder, left: Array, right: Array, surface: int) -> None:
    """Level quadrilaterals between two lines (n, 3); texture coordinates are world east and north."""
    corners = np.stack([left[:-1], right[:-1], right[1:], left[1:]], axis=1)
    up = np.broadcast_to([0.0, 0.0, 1.0], corners.shape)
    b.smooth(corners, up, corners[..., :2].copy(), surface)


def _wall(b: Builder, low: Array, high: Array, along: Array, surface: int) -> None:
    """Upright quadrilaterals between a lower and an upper line (n, 3)."""
    corners = np.stack([low[:-1], low[1:], high[1:], high[:-1]], axis=1)
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 3] - corners[:, 0])
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    uv = np.zeros((len(corners), 4, 2))
    uv[:, [0, 3], 0], uv[:, [1, 2], 0], uv[:, 2:, 1] = along[:-1, None], along[1:, None], KERB_M
    b.smooth(corners, np.repeat(across[:, None], 4, axis=1), uv, surface)


def road(b: Builder, axis: Axis, start: float, end: float, seed: int) -> None:
    """A piece of the street from start to end, metres along the axis."""
    along = np.unique(np.concatenate([_bends(axis, start, end), [start, end]]))
    asphalt = b.surface(m.ASPHALT, _ASPHALT, 5)
    _strip(b, axis.beside(along, -ROAD_HALF_M), axis.beside(along, ROAD_HALF_M), asphalt)
    for side in (-1, 1):
        for low, high in _open_sides(axis, start, end, side):
            inside = np.unique(np.concatenate([along[(along > low) & (along < high)], [low, high]]))
            _sidewalk(b, axis, inside, side)
    for crossing in crossings(axis):
        if start <= crossing < end:
            _cross_street(b, axis, crossing, asphalt)
    _ground(b, axis, start, end)
    _covers(b, axis, start, end, seed)


def _bends(axis: Axis, start: float, end: float) -> Array:
    if not axis.closed:
        return np.array([start, end])
    fine = np.arange(start, end, 0.5)
    bounds = [s for s in axis.starts[:, 0] if start < s < end]
    index = np.searchsorted(axis.starts[:, 0], fine, side="right") - 1
    return np.concatenate([fine[axis.curvature[index] > 0], bounds])


def _open_sides(axis: Axis, start: float, end: float, side: int) -> list[tuple[float, float]]:
    """Where the side has a sidewalk: not at cross streets, nor on the outside of a loop's corners."""
    gaps = [(c - CROSSING_HALF_M, c + CROSSING_HALF_M) for c in crossings(axis)]
    if axis.closed and side < 0:
        bounds = [*axis.starts[:, 0], axis.length_m]
        gaps = [(bounds[i], bounds[i + 1]) for i in (1, 3, 5, 7)]
    pieces, low = [], start
    for a, z in gaps:
        if z <= start or a >= end:
            continue
        if a > low:
            pieces.append((low, a))
        low = max(low, z)
    return [*pieces, (low, end)] if low < end else pieces


def _sidewalk(b: Builder, axis: Axis, along: Array, side: int) -> None:
    kerb, paving = b.surface(m.KERB, _KERB, 6), b.surface(m.PAVING, _PAVING, 7, (0.5, 0, 0, 0))
    edge, inner = side * ROAD_HALF_M, side * (ROAD_HALF_M + KERB_WIDE_M)
    low, top = axis.beside(along, edge, -0.05), axis.beside(along, edge, KERB_M)
    rim, facade = axis.beside(along, inner, KERB_M), axis.beside(along, side * (FACADE_M + 0.4), KERB_M)
    lines = (low, top) if side > 0 else (low[::-1], top[::-1])
    _wall(b, *lines, along if side > 0 else along[::-1], kerb)
    for near, far, surface in ((top, rim, kerb), (rim, facade, paving)):
        left, right = (near, far) if side > 0 else (far, near)
        _strip(b, left, right, surface)
    for end, outwards in ((0, -1.0), (-1, 1.0)):  # the ends towards a crossing
        quad = [axis.beside(along[[end]], d, h)[0] for d, h in ((edge, -0.05), (side * FACADE_M, -0.05))]
        quad += [axis.beside(along[[end]], d, h)[0] for d, h in ((side * FACADE_M, KERB_M), (edge, KERB_M))]
        if outwards * side < 0:
            quad = quad[::-1]
        p, q, r, s = (tuple(map(float, corner)) for corner in quad)
        b.quad(p, q, r, s, kerb)  # pyright: ignore[reportArgumentType]


def _cross_street(b: Builder, axis: Axis, crossing: float, asphalt: int) -> None:
    edge = CROSSING_HALF_M - 2.4
    paving, kerb = b.surface(m.PAVING, _PAVING, 8, (0.4, 0, 0, 0)), b.surface(m.KERB, _KERB, 6)
    for side in (-1, 1):
        near, far = side * ROAD_HALF_M, side * (FACADE_M + 75.0)
        ends = np.array([crossing - CROSSING_HALF_M, crossing + CROSSING_HALF_M])
        _strip(b, axis.beside(ends, min(near, far)), axis.beside(ends, max(near, far)), asphalt)
        for low, high in ((-CROSSING_HALF_M, -edge), (edge, CROSSING_HALF_M)):
            ends = np.array([crossing + low, crossing + high])
            corner = side * (FACADE_M - 2.0)
            inner = np.array([crossing + (low if low > 0 else high)] * 2)
            rights = np.array(sorted((corner, far)) if low > 0 else sorted((corner, far), reverse=True))
            _wall(b, axis.beside(inner, rights, -0.05), axis.beside(inner, rights, KERB_M), rights, kerb)
            cross = np.array([crossing + low, crossing + high])[::-side]
            near_ends = np.array([corner, corner])
            _wall(b, axis.beside(cross, near_ends, -0.05), axis.beside(cross, near_ends, KERB_M), cross, kerb)
            _strip(b, axis.beside(ends, min(corner, far), KERB_M), axis.beside(ends, max(corner, far), KERB_M), paving)


def corner(b: Builder, axis: Axis, start: float, radius: float) -> None:
    """The cross streets that leave a loop at one of its corners, straight on and to the left."""
    asphalt, reach = b.surface(m.ASPHALT, _ASPHALT, 5), 70.0
    arc = 0.5 * np.pi * radius
    for s, turn in ((start, 0.0), (start + arc, np.pi)):
        frame = axis.frame(s, 0.0, turn)
        sides = [frame.apply([[x, -0.2, 0.0], [x, reach, 0.0]]) for x in (-ROAD_HALF_M - 2.4, ROAD_HALF_M + 2.4)]
        for line in sides:
            line[:, 2] = ground_height(line[:, 0], line[:, 1]) - 0.002
        _strip(b, sides[0], sides[1], asphalt)


def _ground(b: Builder, axis: Axis, start: float, end: float) -> None:
    """Grass and yards behind the houses of a straight street."""
    if not axis.closed:
        ends, grass = np.array([start, end]), b.surface(m.GRASS, _GROUND, 9)
        left, right = (axis.beside(ends, side * SURROUNDINGS_M, -0.05) for side in (-1, 1))
        _strip(b, left, right, grass)


def ground_tile(b: Builder, east: float, north: float, size: float) -> None:
    """A square of grass from its south-west corner."""
    x, y = np.array([[east, east], [east + size, east + size]]), np.array([north, north + size])
    lines = [np.column_stack([xs, y, ground_height(xs, y) - 0.05]) for xs in x]
    _strip(b, lines[0], lines[1], b.surface(m.GRASS, _GROUND, 9))


def _covers(b: Builder, axis: Axis, start: float, end: float, seed: int) -> None:
    """Manholes and gullies, flush with the asphalt."""
    rng = np.random.default_rng(seed)
    for along in rng.uniform(start + 0.5, end - 0.5, 2):
        level = axis.frame(float(along), float(rng.uniform(-2.8, 2.8)), float(rng.uniform(0, 6)))
        b.start(Rigid3(_TILT @ level.rotation, level.translation), b.item_number)
        iron = b.surface(m.MANHOLE, (0.13, 0.12, 0.11), int(rng.integers(1 << 30)))
        b.disc((0.0, 0.0, 2 * RAISED_M), 0.34, iron, sides=28)


def marking(b: Builder, kind: int, half_x: float, half_y: float, seed: int, version: int) -> None:
    """One painted piece: dash, edge line, bay line, zebra, arrow. A repainted one is shifted, cleaner, a bit longer."""
    rng = np.random.default_rng([seed, version])
    wear = float(rng.uniform(0.35, 0.75)) if version == 1 else 0.1
    shift = (0.0, 0.0) if version == 1 else tuple(rng.uniform(-0.18, 0.18, 2))
    paint = b.surface(m.PAINT, (0.62, 0.62, 0.58), seed + version, (wear, 0, 0, 0))
    if kind == 3:
        polygons = [_rectangle(x, -half_y, x + 0.5, half_y) for x in np.arange(-half_x, half_x - 0.3, 1.0).tolist()]
    elif kind == 4:
        polygons = [_rectangle(-0.08, -half_y, 0.08, half_y - 0.9)]
        polygons.append([(-0.35, half_y - 0.9), (0.35, half_y - 0.9), (0.0, half_y), (0.0, half_y)])
    else:
        polygons = [_rectangle(-half_x, -half_y, half_x, half_y)]
    for polygon in polygons:
        corners = [_on_ground(b, x + shift[0], y + shift[1]) for x, y in polygon]
        b.quad(corners[0], corners[1], corners[2], corners[3], paint)
        for corner_point in corners:
            b.mark(corner_point, (0, 0, 1))


def _rectangle(x0: float, y0: float, x1: float, y1: float) -> list[tuple[float, float]]:
    return [(x0, y0), (x1, y0), (x1, y1), (x0, y1)]


def _on_ground(b: Builder, x: float, y: float) -> tuple[float, float, float]:
    """A point of the object's frame, just above the road plane."""
    world = b.frame.apply([x, y, 0.0])
    return x, y, float(ground_height(world[0], world[1]) + RAISED_M - b.frame.translation[2])
