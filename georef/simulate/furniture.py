"""What stands on the sidewalk: lamps, signs, bins, bollards, cabinets, benches, advertising columns, fences."""

from __future__ import annotations

import numpy as np

from georef.simulate import materials as m
from georef.simulate.mesh import Builder
from georef.simulate.roads import KERB_M

_SIGN_COLOURS = ((0.55, 0.03, 0.03), (0.02, 0.08, 0.40), (0.72, 0.72, 0.70), (0.02, 0.20, 0.08), (0.70, 0.50, 0.03))
G = KERB_M


def lamp(b: Builder, seed: int) -> None:
    steel = b.surface(m.METAL, (0.20, 0.24, 0.22), seed)
    b.tube((0, 0, G - 0.1), (0, 0, G + 1.0), (0.10, 0.10), steel, 14)
    b.tube((0, 0, G + 1.0), (0, 0, 6.2), (0.065, 0.05), steel, 12)
    b.tube((0, 0, 6.15), (-1.1, 0, 6.5), (0.04, 0.035), steel, 8)
    b.box((-1.5, -0.12, 6.42), (-0.9, 0.12, 6.56), steel)
    sticker = b.surface(m.SIGN, (0.6, 0.55, 0.1), seed + 1, (0.2, 0.3, 1.0, 0))
    b.panel(-0.1, 0.1, 1.3, 1.6, -0.07, sticker)


def sign(b: Builder, seed: int) -> None:
    rng = np.random.default_rng(seed)
    steel = b.surface(m.METAL, m.GREY, seed)
    b.tube((0, 0, G - 0.1), (0, 0, G + 2.9), (0.035, 0.035), steel, 8)
    colour = _SIGN_COLOURS[int(rng.integers(len(_SIGN_COLOURS)))]
    width, height = float(rng.uniform(0.5, 0.9)), float(rng.uniform(0.4, 0.75))
    low = G + 2.85 - height
    face = b.surface(m.SIGN, colour, seed + 1, (width, height, 2.0, 0))
    b.box((-0.5 * width, -0.06, low), (0.5 * width, -0.04, low + height), steel, ("front",))
    b.panel(-0.5 * width, 0.5 * width, low, low + height, -0.06, face)
    for x in (-0.5 * width, 0.5 * width):
        for z in (low, low + height):
            b.mark((x, -0.06, z), (0, -1, 0))


def bin_(b: Builder, seed: int) -> None:
    body, lid = b.surface(m.METAL, (0.08, 0.14, 0.10), seed), b.surface(m.METAL, (0.20, 0.20, 0.20), seed + 1)
    b.tube((0, 0, G), (0, 0, G + 0.85), (0.24, 0.27), body, 18)
    b.disc((0, 0, G + 0.80), 0.26, lid, sides=18)
    for height in (0.1, 0.72):
        b.tube((0, 0, G + height), (0, 0, G + height + 0.05), (0.275, 0.275), lid, 18)


def bollards(b: Builder, seed: int) -> None:
    post, band = b.surface(m.METAL, (0.06, 0.06, 0.065), seed), b.surface(m.LACQUER, (0.70, 0.70, 0.68), seed)
    for y in (-2.1, -0.7, 0.7, 2.1):
        b.tube((0, y, G - 0.05), (0, y, G + 0.95), (0.055, 0.055), post, 12)
        b.tube((0, y, G + 0.72), (0, y, G + 0.82), (0.058, 0.058), band, 12)
        b.disc((0, y, G + 0.95), 0.055, post, sides=12)


def cabinet(b: Builder, seed: int) -> None:
    """A distribution cabinet with bills and paint on it."""
    rng = np.random.default_rng(seed)
    shell = b.surface(m.CONCRETE, (0.36, 0.37, 0.33), seed)
    b.box((-0.3, -0.6, G), (0.3, 0.6, G + 1.25), shell, ("bottom",))
    b.box((-0.33, -0.63, G + 1.25), (0.33, 0.63, G + 1.32), shell)
    for x, turn in ((-0.305, 1.0), (0.305, -1.0)):
        for y in (-0.5, 0.02):
            colour = tuple((rng.random(3) * 0.7).tolist())
            bill = b.surface(m.SIGN, colour, int(rng.integers(1 << 30)), (0.42, 0.6, 1.0, 0))
            low, a, e = G + float(rng.uniform(0.3, 0.5)), y + 0.42, y
            if turn < 0:
                a, e = e, a
            uv = [(0.0, 0.0), (0.42, 0.0), (0.42, 0.6), (0.0, 0.6)]
            b.quad((x, a, low), (x, e, low), (x, e, low + 0.6), (x, a, low + 0.6), bill, uv)
            for q in (a, e):
                b.mark((x, q, low + 0.6), (-turn, 0, 0))


def bench(b: Builder, seed: int) -> None:
    wood, iron = b.surface(m.WOOD, (0.30, 0.17, 0.08), seed, (0.3, 0, 0, 0)), b.surface(m.METAL, m.DARK, seed)
    for y in (-0.75, 0.7):
        b.box((-0.25, y, G), (-0.20, y + 0.05, G + 0.44), iron)
        b.box((0.20, y, G), (0.25, y + 0.05, G + 0.85), iron)
    for x in (-0.25, -0.09, 0.07):
        b.box((x, -0.9, G + 0.44), (x + 0.13, 0.9, G + 0.48), wood)
    for z in (0.58, 0.74):
        b.box((0.17, -0.9, G + z), (0.20, 0.9, G + z + 0.12), wood)


def rack(b: Builder, seed: int) -> None:
    """Bicycle stands."""
    steel = b.surface(m.METAL, (0.42, 0.43, 0.44), seed)
    for y in (-1.6, -0.8, 0.0, 0.8, 1.6):
        b.tube((-0.35, y, G), (-0.35, y, G + 0.8), (0.025, 0.025), steel, 8)
        b.tube((0.35, y, G), (0.35, y, G + 0.8), (0.025, 0.025), steel, 8)
        b.tube((-0.35, y, G + 0.8), (0.35, y, G + 0.8), (0.025, 0.025), steel, 8)


def column(b: Builder, seed: int) -> None:
    """An advertising column with bills all around."""
    rng = np.random.default_rng(seed)
    shaft = b.surface(m.CONCRETE, (0.42, 0.41, 0.38), seed)
    b.tube((0, 0, G), (0, 0, G + 2.9), (0.5, 0.5), shaft, 24)
    b.tube((0, 0, G + 2.9), (0, 0, G + 3.15), (0.58, 0.15), b.surface(m.METAL, (0.10, 0.16, 0.12), seed), 24)
    for row in range(2):
        for bill in range(5):
            colour = tuple((rng.random(3) * 0.7).tolist())
            sheet = b.surface(m.SIGN, colour, int(rng.integers(1 << 30)), (0.58, 1.0, 1.0, 0))
            angle = 2 * np.pi * (bill + 0.5 * row) / 5 + np.linspace(-0.55, 0.55, 7)
            ring = np.stack([np.cos(angle), np.sin(angle), np.zeros(7)], axis=1)
            up = np.array([0.0, 0.0, 1.0])
            low = ring * 0.505 + [0, 0, G + 0.5 + 1.15 * row]
            corners = np.stack([low[:-1], low[1:], low[1:] + up, low[:-1] + up], axis=1)
            uv = np.zeros((6, 4, 2))
            across = np.linspace(0, 0.58, 7)
            uv[:, [0, 3], 0], uv[:, [1, 2], 0], uv[:, 2:, 1] = across[:-1, None], across[1:, None], 1.0
            normals = np.stack([ring[:-1], ring[1:], ring[1:], ring[:-1]], axis=1)
            b.smooth(corners, normals, uv, sheet)


def fence(b: Builder, length: float, seed: int) -> None:
    """A construction fence: panels of wire or boards, feet, banners."""
    rng = np.random.default_rng(seed)
    steel, foot = b.surface(m.METAL, (0.45, 0.46, 0.47), seed), b.surface(m.CONCRETE, (0.25, 0.25, 0.24), seed)
    count = max(2, round(length / 3.0))
    pitch = length / count
    for number in range(count):
        x0, x1 = -0.5 * length + number * pitch + 0.03, -0.5 * length + (number + 1) * pitch - 0.03
        if rng.random() < 0.5:
            colour = tuple((0.2 + 0.5 * rng.random(3)).tolist())
            skin = b.surface(m.SIGN, colour, int(rng.integers(1 << 30)), (x1 - x0, 1.7, float(rng.integers(2)), 0))
        else:
            skin = b.surface(m.WOOD, (0.42, 0.30, 0.16), int(rng.integers(1 << 30)), (0.5, 0, 0, 0))
        b.panel(x0, x1, G + 0.15, G + 1.85, -0.02, skin)
        b.quad((x1, 0.0, G + 0.15), (x0, 0.0, G + 0.15), (x0, 0.0, G + 1.85), (x1, 0.0, G + 1.85), steel)
        for x in (x0, x1):
            b.tube((x, 0, G), (x, 0, G + 2.0), (0.022, 0.022), steel, 8)
        b.tube((x0, 0, G + 1.98), (x1, 0, G + 1.98), (0.022, 0.022), steel, 8)
        b.box((x0 - 0.1, -0.38, G), (x0 + 0.15, 0.38, G + 0.14), foot, ("bottom",))


MAKERS = {
    "lamp": lamp,
    "sign": sign,
    "bin": bin_,
    "bollards": bollards,
    "cabinet": cabinet,
    "bench": bench,
    "rack": rack,
    "column": column,
}
