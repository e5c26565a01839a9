"""Houses of several kinds: facade with real relief, windows, doors, shops, balconies, roofs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.random import Generator

from georef.simulate import materials as m
from georef.simulate.mesh import Builder
from georef.simulate.openings import balcony, door, shopfront, window

_PLASTER = ((0.72, 0.66, 0.52), (0.66, 0.52, 0.38), (0.70, 0.69, 0.66), (0.52, 0.56, 0.55), (0.62, 0.44, 0.36))
_PLASTERS = (*_PLASTER, (0.45, 0.55, 0.60), (0.74, 0.62, 0.36), (0.50, 0.58, 0.44))
_BRICKS = ((0.36, 0.15, 0.10), (0.42, 0.22, 0.14), (0.30, 0.14, 0.11), (0.50, 0.40, 0.28))
_STONES = ((0.55, 0.50, 0.42), (0.46, 0.44, 0.40), (0.60, 0.56, 0.48))
_ROOFS = ((0.36, 0.14, 0.08), (0.28, 0.12, 0.08), (0.12, 0.12, 0.13), (0.22, 0.20, 0.18))
_PAINTS = ((0.72, 0.72, 0.70), (0.55, 0.50, 0.40), (0.12, 0.20, 0.14), (0.20, 0.12, 0.08), (0.10, 0.12, 0.16))


@dataclass(frozen=True)
class Style:
    """One house's looks; surfaces are the builder's."""

    wall: int
    base: int
    trim: int
    frame: int
    roof: int
    ground_m: float
    floor_m: float
    floors: int
    columns: int
    window_m: tuple[float, float]
    reveal_m: float
    shop: bool
    surrounds: bool
    balconies: bool
    muntins: int
    shutters: bool


def house(b: Builder, width: float, depth: float, seed: int) -> None:
    """A house whose front (-y) stands on y = 0, centred on x = 0."""
    rng = np.random.default_rng(seed)
    style = _style(b, rng, width)
    top = style.ground_m + style.floor_m * (style.floors - 1)
    _facade(b, rng, style, width)
    _body(b, style, width, depth, top)
    _bands(b, style, width, top)
    _roof(b, rng, style, width, depth, top)
    _fittings(b, rng, style, width, top)


def _style(b: Builder, rng: Generator, width: float) -> Style:
    seed = int(rng.integers(1 << 30))
    kind = rng.random()
    if kind < 0.5:
        wall = b.surface(m.PLASTER, _choice(rng, _PLASTERS), seed, (float(rng.random()), 0, 0, 0))
    elif kind < 0.8:
        wall = b.surface(m.BRICK, _choice(rng, _BRICKS), seed)
    else:
        wall = b.surface(m.STONE, _choice(rng, _STONES), seed, (float(rng.uniform(0.5, 0.9)), 0.31, 0, 0))
    base = wall if rng.random() < 0.3 else b.surface(m.STONE, _choice(rng, _STONES), seed + 1, (0.75, 0.42, 0, 0))
    floor = float(rng.uniform(2.8, 3.5))
    tall = float(rng.uniform(0.5, 0.62)) * floor
    return Style(
        wall=wall,
        base=base,
        trim=b.surface(m.CONCRETE, _choice(rng, (*_STONES, m.WHITE)), seed + 2),
        frame=b.surface(m.WOOD, _choice(rng, _PAINTS), seed + 3, (0.4, 0, 0, 0)),
        roof=b.surface(m.TILES, _choice(rng, _ROOFS), seed + 4),
        ground_m=float(rng.uniform(3.3, 4.2)),
        floor_m=floor,
        floors=int(rng.integers(2, 6)),
        columns=max(2, int(width / rng.uniform(2.2, 3.4))),
        window_m=(float(rng.uniform(0.95, 1.45)), tall),
        reveal_m=float(rng.uniform(0.12, 0.24)),
        shop=bool(rng.random() < 0.5),
        surrounds=bool(rng.random() < 0.6),
        balconies=bool(rng.random() < 0.35),
        muntins=int(rng.integers(0, 3)),
        shutters=bool(rng.random() < 0.25),
    )


def _choice(rng: Generator, options: tuple[tuple[float, float, float], ...]) -> tuple[float, float, float]:
    r, g, b = np.array(options[int(rng.integers(len(options)))]) * rng.uniform(0.85, 1.12)
    return float(r), float(g), float(b)


def _facade(b: Builder, rng: Generator, style: Style, width: float) -> None:
    """The front wall, floor by floor, with holes for what is in it."""
    half, pitch = 0.5 * width, width / style.columns
    centres = [-half + pitch * (i + 0.5) for i in range(style.columns)]
    entrance = int(rng.integers(style.columns))
    _ground_floor(b, rng, style, centres, entrance, half, pitch)
    for floor in range(1, style.floors):
        low = style.ground_m + style.floor_m * (floor - 1)
        sill, lintel = low + 0.27 * style.floor_m, low + 0.27 * style.floor_m + style.window_m[1]
        wide = 0.5 * min(style.window_m[0], 0.62 * pitch)
        holes = [(c - wide, c + wide, sill, lintel) for c in centres]
        wall_with_holes(b, (-half, half), (low, low + style.floor_m), holes, style.wall)
        for column, hole in enumerate(holes):
            window(b, rng, style, hole)
            if style.balconies and (column + floor) % 2 == 0:
                balcony(b, hole, low, style.trim, style.frame)


def _ground_floor(
    b: Builder, rng: Generator, style: Style, centres: list[float], entrance: int, half: float, pitch: float
) -> None:
    top, holes = style.ground_m, []
    for column, centre in enumerate(centres):
        if column == entrance:
            holes.append((centre - 0.55, centre + 0.55, 0.0, 2.5))
        elif style.shop:
            wide = 0.5 * pitch - 0.22
            holes.append((centre - wide, centre + wide, 0.45, 2.75))
        else:
            wide = 0.5 * min(style.window_m[0], 0.62 * pitch)
            holes.append((centre - wide, centre + wide, 1.1, min(1.1 + style.window_m[1], top - 0.5)))
    wall_with_holes(b, (-half, half), (-0.8, top), holes, style.base)
    for column, hole in enumerate(holes):
        if column == entrance:
            door(b, rng, style, hole)
        elif style.shop:
            shopfront(b, rng, style, hole, top)
        else:
            window(b, rng, style, hole)
    if not style.shop and half > 3.5 and rng.random() < 0.6:
        _poster(b, rng, centres, entrance)


def wall_with_holes(
    b: Builder,
    across: tuple[float, float],
    up: tuple[float, float],
    holes: list[tuple[float, float, float, float]],
    surface: int,
) -> None:
    """A wall on y = 0 from which rectangles (x0, x1, z0, z1), ordered in x, are left out."""
    x, uncut = across[0], [(across[0], across[1])]
    uncut.clear()
    for x0, x1, z0, z1 in holes:
        uncut.append((x, x0))
        b.quad((x0, 0, up[0]), (x1, 0, up[0]), (x1, 0, z0), (x0, 0, z0), surface)
        b.quad((x0, 0, z1), (x1, 0, z1), (x1, 0, up[1]), (x0, 0, up[1]), surface)
        x = x1
    for left, right in [*uncut, (x, across[1])]:
        b.quad((left, 0, up[0]), (right, 0, up[0]), (right, 0, up[1]), (left, 0, up[1]), surface)


def _body(b: Builder, style: Style, width: float, depth: float, top: float) -> None:
    half = 0.5 * width
    b.box((-half, 0, -0.8), (half, depth, top), style.wall, without=("front", "bottom", "top"))


def _bands(b: Builder, style: Style, width: float, top: float) -> None:
    """Plinth, string course and cornice."""
    half = 0.5 * width
    b.box((-half, -0.06, style.ground_m - 0.12), (half, 0, style.ground_m + 0.10), style.trim, ("back",))
    b.box((-half, -0.10, style.ground_m + 0.10), (half, 0, style.ground_m + 0.16), style.trim, ("back",))
    for out, low, high in ((0.10, -0.55, -0.35), (0.22, -0.35, -0.18), (0.36, -0.18, 0.02)):
        b.box((-half, -out, top + low), (half, 0, top + high), style.trim, ("back",))
    x = -half + 0.35
    while x < half - 0.2:  # brackets under the cornice
        b.box((x - 0.07, -0.2, top - 0.62), (x + 0.07, 0, top - 0.35), style.trim, ("back", "top"))
        x += 0.62
    for side in (-1, 1):
        corner = (side * half, -0.06, style.ground_m - 0.12)
        b.mark(corner, (0, -1, 0))


def _roof(b: Builder, rng: Generator, style: Style, width: float, depth: float, top: float) -> None:
    half, eave, ridge = 0.5 * width, -0.42, 0.5 * depth
    if rng.random() < 0.25:
        b.quad((-half, 0, top), (half, 0, top), (half, depth, top), (-half, depth, top), style.trim)
        b.box((-half, -0.02, top), (half, 0.22, top + 0.8), style.wall, ("bottom",))
        return
    rise = float(rng.uniform(0.55, 0.95)) * ridge
    low, high = top + 0.03, top + rise
    b.quad((-half, eave, low), (half, eave, low), (half, ridge, high), (-half, ridge, high), style.roof)
    b.quad((half, depth, low), (-half, depth, low), (-half, ridge, high), (half, ridge, high), style.roof)
    for side in (-1.0, 1.0):
        x = side * half
        ends = [(x, depth, top), (x, 0.0, top)] if side < 0 else [(x, 0.0, top), (x, depth, top)]
        b.quad(ends[0], ends[1], (x, ridge, high), (x, ridge, high), style.wall)
    gutter = b.surface(m.METAL, m.GREY, 3)
    b.tube((-half, eave - 0.06, low), (half, eave - 0.06, low), (0.08, 0.08), gutter, 8)
    x = float(rng.uniform(-0.6, 0.6)) * half
    b.box((x - 0.4, ridge + 0.3, high - 1.0), (x + 0.4, ridge + 1.0, high + 1.1), style.wall, ("bottom",))
    if rise > 2.8:
        for centre in np.linspace(-half, half, max(3, style.columns)).tolist()[1:-1]:
            _dormer(b, style, centre, top + 0.55, eave + 0.55 * (ridge - eave) / rise)


def _dormer(b: Builder, style: Style, x: float, z: float, y: float) -> None:
    b.box((x - 0.75, y, z), (x + 0.75, y + 2.0, z + 1.35), style.wall, ("back", "bottom"))
    b.box((x - 0.9, y - 0.15, z + 1.35), (x + 0.9, y + 2.2, z + 1.47), style.trim)
    pane = b.surface(m.GLASS, m.DARK, int(1000 * abs(x)) + 7, (1.1, 1.0, 0, 0))
    b.box((x - 0.6, y - 0.05, z + 0.15), (x + 0.6, y, z + 1.25), style.frame, ("back",))
    b.panel(x - 0.5, x - 0.04, z + 0.25, z + 1.15, y - 0.06, pane)
    b.panel(x + 0.04, x + 0.5, z + 0.25, z + 1.15, y - 0.06, pane)


def _fittings(b: Builder, rng: Generator, style: Style, width: float, top: float) -> None:
    """Downpipe, plates, lamp: small things on the wall."""
    half, metal = 0.5 * width, b.surface(m.METAL, (0.30, 0.31, 0.30), int(rng.integers(1 << 30)))
    side = -1 if rng.random() < 0.5 else 1
    x = side * (half - 0.12)
    b.tube((x, -0.09, -0.2), (x, -0.09, top - 0.6), (0.05, 0.05), metal, 8)
    z = 0.9
    while z < top - 1.0:
        b.box((x - 0.07, -0.15, z), (x + 0.07, 0, z + 0.05), metal, ("back",))
        z += 1.9
    for _ in range(int(rng.integers(1, 4))):
        x0, z0 = (
            float(rng.uniform(-half + 0.3, half - 0.7)),
            float(rng.uniform(style.ground_m + 0.25, style.ground_m + 0.6)),
        )
        plate = b.surface(m.SIGN, (0.55, 0.56, 0.5), int(rng.integers(1 << 30)), (0.4, 0.28, 2.0, 0))
        b.box((x0, -0.03, z0), (x0 + 0.4, 0, z0 + 0.28), metal, ("back", "front"))
        b.panel(x0, x0 + 0.4, z0, z0 + 0.28, -0.03, plate)
        b.mark((x0, -0.03, z0 + 0.28), (0, -1, 0))


def _poster(b: Builder, rng: Generator, centres: list[float], entrance: int) -> None:
    other = entrance + 1 if entrance + 1 < len(centres) else entrance - 1
    x, z = 0.5 * (centres[entrance] + centres[other]) - 0.28, 1.15
    colour = (float(rng.random()) * 0.7, float(rng.random()) * 0.6, float(rng.random()) * 0.6)
    sheet = b.surface(m.SIGN, colour, int(rng.integers(1 << 30)), (0.56, 0.8, 1.0, 0))
    b.panel(x, x + 0.56, z, z + 0.8, -0.012, sheet)
    b.mark((x, -0.012, z), (0, -1, 0))
    b.mark((x + 0.56, -0.012, z + 0.8), (0, -1, 0))
