"""What is in the holes of a facade: windows, doors, shop fronts, and the balconies before them."""

from __future__ import annotations

from typing import Protocol

from numpy.random import Generator

from georef.simulate import materials as m
from georef.simulate.mesh import Builder

Hole = tuple[float, float, float, float]
_SIGNS = ((0.45, 0.05, 0.05), (0.05, 0.12, 0.35), (0.05, 0.22, 0.10), (0.72, 0.68, 0.55), (0.65, 0.45, 0.05))
_DOORS = ((0.16, 0.08, 0.04), (0.05, 0.12, 0.08), (0.30, 0.05, 0.05), (0.06, 0.09, 0.16), (0.32, 0.22, 0.12))


class Looks(Protocol):
    """The parts of a house's style that openings use."""

    @property
    def base(self) -> int: ...
    @property
    def wall(self) -> int: ...
    @property
    def trim(self) -> int: ...
    @property
    def frame(self) -> int: ...
    @property
    def reveal_m(self) -> float: ...
    @property
    def surrounds(self) -> bool: ...
    @property
    def muntins(self) -> int: ...
    @property
    def shutters(self) -> bool: ...


def reveal(b: Builder, hole: Hole, depth: float, surface: int) -> None:
    """The four sides of a hole, from the wall plane inwards."""
    x0, x1, z0, z1 = hole
    b.quad((x0, 0, z0), (x0, depth, z0), (x0, depth, z1), (x0, 0, z1), surface)
    b.quad((x1, depth, z0), (x1, 0, z0), (x1, 0, z1), (x1, depth, z1), surface)
    b.quad((x0, 0, z0), (x1, 0, z0), (x1, depth, z0), (x0, depth, z0), surface)
    b.quad((x0, depth, z1), (x1, depth, z1), (x1, 0, z1), (x0, 0, z1), surface)


def bars(b: Builder, hole: Hole, y: float, wide: float, surface: int) -> None:
    """A frame of four bars that fills the border of a hole, its front at y."""
    x0, x1, z0, z1 = hole
    for low, high in (
        ((x0, z0), (x0 + wide, z1)),
        ((x1 - wide, z0), (x1, z1)),
        ((x0 + wide, z0), (x1 - wide, z0 + wide)),
        ((x0 + wide, z1 - wide), (x1 - wide, z1)),
    ):
        b.box((low[0], y, low[1]), (high[0], y + 0.06, high[1]), surface, ("back",))


def window(b: Builder, rng: Generator, style: Looks, hole: Hole) -> None:
    x0, x1, z0, z1 = hole
    depth, middle = style.reveal_m, 0.5 * (x0 + x1)
    reveal(b, hole, depth, style.wall)
    dim = float(rng.uniform(0.03, 0.13))
    pane = b.surface(m.GLASS, (dim, 1.1 * dim, 1.3 * dim), int(rng.integers(1 << 30)), (x1 - x0, z1 - z0, 0, 0))
    b.panel(x0, x1, z0, z1, depth - 0.005, pane)
    bars(b, hole, depth - 0.06, 0.07, style.frame)
    if style.muntins >= 1:
        b.box((middle - 0.035, depth - 0.065, z0), (middle + 0.035, depth, z1), style.frame, ("back",))
    if style.muntins >= 2:
        z = z0 + 0.68 * (z1 - z0)
        b.box((x0, depth - 0.06, z - 0.03), (x1, depth, z + 0.03), style.frame, ("back",))
    b.box((x0 - 0.08, -0.12, z0 - 0.07), (x1 + 0.08, depth - 0.06, z0), style.trim, ("back",))
    if style.surrounds:
        _surround(b, hole, style.trim)
    elif style.shutters:
        for a in (x0 - 0.5, x1 + 0.03):
            b.box((a, -0.05, z0), (a + 0.47, 0, z1), style.frame, ("back",))
    else:
        for x, z in ((x0, z1), (x1, z1)):
            b.mark((x, 0, z), (0, -1, 0))


def _surround(b: Builder, hole: Hole, surface: int) -> None:
    """A raised moulding around the sides and the top of an opening."""
    (x0, x1, z0, z1), wide = hole, 0.15
    b.box((x0 - wide, -0.05, z0), (x0, 0, z1), surface, ("back",))
    b.box((x1, -0.05, z0), (x1 + wide, 0, z1), surface, ("back",))
    b.box((x0 - wide, -0.05, z1), (x1 + wide, 0, z1 + 0.2), surface, ("back",))
    b.box((x0 - wide - 0.06, -0.13, z1 + 0.2), (x1 + wide + 0.06, 0, z1 + 0.28), surface, ("back",))
    for x in (x0, x1):
        b.mark((x, -0.05, z1), (0, -1, 0))


def door(b: Builder, rng: Generator, style: Looks, hole: Hole) -> None:
    x0, x1, z0, z1 = hole
    depth, leaf_top = style.reveal_m + 0.12, z0 + 2.05
    reveal(b, hole, depth, style.base)
    seed = int(rng.integers(1 << 30))
    leaf = b.surface(m.WOOD, _DOORS[int(rng.integers(len(_DOORS)))], seed, (0.14, 0, 0, 0))
    b.panel(x0, x1, z0, leaf_top, depth - 0.01, leaf)
    bars(b, (x0, x1, z0, leaf_top), depth - 0.06, 0.09, style.frame)
    for low in (z0 + 0.2, z0 + 1.1):
        b.box((x0 + 0.2, depth - 0.035, low), (x1 - 0.2, depth, low + 0.75), leaf, ("back",))
    light = b.surface(m.GLASS, m.DARK, seed + 1, (x1 - x0, z1 - leaf_top, 0, 0))
    b.panel(x0, x1, leaf_top, z1, depth - 0.01, light)
    bars(b, (x0, x1, leaf_top, z1), depth - 0.06, 0.06, style.frame)
    b.box((x0 - 0.1, -0.42, -0.4), (x1 + 0.1, depth, 0.15), style.trim, ("back", "bottom"))
    _surround(b, (x0, x1, 0.15, z1), style.trim)


def shopfront(b: Builder, rng: Generator, style: Looks, hole: Hole, top: float) -> None:
    x0, x1, z0, z1 = hole
    depth = style.reveal_m
    reveal(b, hole, depth, style.base)
    seed, colour = int(rng.integers(1 << 30)), _SIGNS[int(rng.integers(len(_SIGNS)))]
    goods = b.surface(m.SHOP, (0.05, 0.05, 0.05), seed, (x1 - x0, z1 - z0, 0, 0))
    b.panel(x0, x1, z0, z1, depth - 0.01, goods)
    bars(b, hole, depth - 0.06, 0.08, style.frame)
    low, high = z1 + 0.12, min(z1 + 0.62, top - 0.18)
    rim = b.surface(m.METAL, tuple(0.6 * c for c in colour), seed + 1)
    board = b.surface(m.SIGN, colour, seed + 2, (x1 - x0, high - low, 0.0, 0))
    b.box((x0, -0.12, low), (x1, 0, high), rim, ("back", "front"))
    b.panel(x0, x1, low, high, -0.12, board)
    for x, z in ((x0, low), (x1, low), (x0, high), (x1, high)):
        b.mark((x, -0.12, z), (0, -1, 0))
    if rng.random() < 0.3:
        cloth = b.surface(m.WOOD, colour, seed + 3, (0.25, 0, 0, 0))
        b.quad((x0, -1.2, z1 - 0.35), (x1, -1.2, z1 - 0.35), (x1, -0.12, low), (x0, -0.12, low), cloth)
        b.quad((x0, -1.2, z1 - 0.55), (x1, -1.2, z1 - 0.55), (x1, -1.2, z1 - 0.35), (x0, -1.2, z1 - 0.35), cloth)


def balcony(b: Builder, hole: Hole, floor_z: float, slab: int, rail: int) -> None:
    x0, x1 = hole[0] - 0.35, hole[1] + 0.35
    out, low, high = -0.95, floor_z + 0.12, floor_z + 1.05
    b.box((x0, out, floor_z), (x1, 0, low), slab, ("back",))
    b.box((x0, out, high - 0.05), (x1, out + 0.05, high), rail)
    for x in (x0, x1 - 0.05):
        b.box((x, out, high - 0.05), (x + 0.05, 0, high), rail, ("back",))
    x = x0
    while x <= x1 - 0.02:
        b.box((x, out + 0.01, low), (x + 0.022, out + 0.032, high - 0.05), rail, ("top", "bottom"))
        x += 0.115
    for y in (-0.25, -0.5, -0.75):
        for x in (x0 + 0.01, x1 - 0.032):
            b.box((x, y, low), (x + 0.022, y + 0.022, high - 0.05), rail, ("top", "bottom"))
    b.mark((x0, out, low), (0, -1, 0))
    b.mark((x1, out, low), (0, -1, 0))
