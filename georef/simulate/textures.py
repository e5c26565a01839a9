"""Albedo of every material at a point of its surface, filtered by the pixel's footprint."""

from __future__ import annotations

from math import floor, sin

from georef.simulate import materials as m
from georef.simulate.noise import (
    clip,
    grain,
    kept,
    kernel,
    lattice,
    line_noise,
    octaves,
    ramp,
    small_kernel,
    specks,
    stripes,
    value_noise,
)
from georef.simulate.patterns import glass, shop, sign

PLASTER, BRICK, STONE, WOOD, GLASS, TILES, ASPHALT, PAVING = (
    *(m.PLASTER, m.BRICK, m.STONE, m.WOOD),
    *(m.GLASS, m.TILES, m.ASPHALT, m.PAVING),
)
KERB, PAINT, SIGN, LACQUER, LEAF, METAL = m.KERB, m.PAINT, m.SIGN, m.LACQUER, m.LEAF, m.METAL
GRASS, CONCRETE, MANHOLE, MESH, SHOP, PLATE, BARK = m.GRASS, m.CONCRETE, m.MANHOLE, m.MESH, m.SHOP, m.PLATE, m.BARK


@small_kernel
def _blocks(u, v, fp, seed, length, height, joint, tint):
    """Courses of blocks with joints, every other course shifted: factor of the albedo."""
    row = floor(v / height)
    x = u / length + 0.5 * (row % 2) + 0.15 * lattice(row, 0, seed)
    jx = stripes(x, joint / length, fp / length)
    jy = stripes(v / height, joint / height, fp / height)
    fade = kept(height, fp)
    block = fade * tint * (2.0 * lattice(floor(x), row, seed + 1) - 1.0)
    return (1.0 + block) * (1.0 - 0.55 * max(jx, jy) - 0.1 * min(jx, jy))


@kernel
def _plaster(u, v, fp, seed, age):
    stains = octaves(u, 0.35 * v, fp, seed, 2.6, 4, 0.6)
    rough = grain(u, v, fp, seed + 11, 0.0015)
    cracks = line_noise(u, v, fp, seed + 21, 0.9, 0.0016)
    splash = clip(1.0 - v / 0.7) * (0.6 + 0.5 * value_noise(u, v, 0.3, seed + 5))
    flakes = clip(4.0 * value_noise(u, v, 0.45, seed + 31) + 1.5 * value_noise(u, v, 0.11, seed + 32) - 2.6)
    return 1.0 + (0.12 + 0.10 * age) * stains + 0.19 * rough - 0.45 * cracks - 0.22 * splash - 0.4 * age * flakes


@kernel
def _asphalt(u, v, fp, seed):
    stones = 0.0
    for octave in range(3):
        stones += specks(u, v, fp, seed + 17 * octave, 0.011 * 2.1**octave, 0.8)
    worn = octaves(u, v, fp, seed + 1, 3.0, 5, 0.65)
    patch = value_noise(u, v, 5.0, seed + 2)
    old = ramp(patch - 0.35, 0.02 + fp / 5.0) * 0.22
    cracks = line_noise(u, v, fp, seed + 3, 1.7, 0.004) + line_noise(u, v, fp, seed + 4, 0.45, 0.002)
    spots = specks(u, v, fp, seed + 5, 0.4, 0.3) + specks(u, v, fp, seed + 6, 0.13, 0.3)
    return (1.0 + 0.17 * worn + 0.45 * stones + 0.35 * spots + 0.22 * grain(u, v, fp, seed + 8, 0.003) - old) * (
        1.0 - 0.5 * min(cracks, 1.0)
    )


@kernel
def _paving(u, v, fp, seed, size):
    slabs = _blocks(u, v, fp, seed, size, size * 0.66, 0.008, 0.2)
    gum = clip(-2.0 * specks(u, v, fp, seed + 4, 0.22, 0.25))
    return (
        slabs
        * (1.0 + 0.10 * octaves(u, v, fp, seed + 2, 2.0, 3, 0.6) + 0.3 * grain(u, v, fp, seed + 3, 0.0015))
        * (1.0 - 0.45 * gum)
    )


@kernel
def _wood(u, v, fp, seed, plank):
    board = lattice(floor(u / plank), 3, seed)
    rings = octaves(u * 1.0 + 0.02 * sin(3.0 * v + 6.0 * board), 0.06 * v, fp, seed + int(1000 * board), 0.03, 4, 0.7)
    gap = stripes(u / plank, 0.006 / plank, fp / plank)
    return (
        (0.85 + 0.3 * board * kept(plank, fp))
        * (1.0 + 0.16 * rings + 0.08 * grain(u, v, fp, seed, 0.002))
        * (1.0 - 0.6 * gap)
    )


@kernel
def _tiles(u, v, fp, seed):
    width, height = 0.24, 0.33
    row = floor(v / height)
    x = u / width + 0.5 * (row % 2)
    tint = kept(height, fp) * 0.3 * (2.0 * lattice(floor(x), row, seed) - 1.0)
    lip = stripes(v / height, 0.10, fp / height)
    side = stripes(x, 0.12, fp / width)
    moss = clip(2.0 * octaves(u, v, fp, seed + 2, 1.3, 4, 0.6) - 0.7)
    return (1.0 + tint + 0.15 * grain(u, v, fp, seed + 1, 0.004)) * (1.0 - 0.5 * lip) * (1.0 - 0.3 * side), moss


@kernel
def _manhole(u, v, fp, seed):
    bars = stripes(u / 0.055, 0.45, fp / 0.055) * stripes(v / 0.055, 0.45, fp / 0.055)
    ring = ramp((u * u + v * v) ** 0.5 - 0.27, fp)
    return (1.0 - ring) * (0.7 + 0.7 * bars) + ring * 1.2 + 0.15 * grain(u, v, fp, seed, 0.003)


@kernel
def _worn_paint(u, v, fp, seed, wear):
    """How much of the paint is left, 0 to 1."""
    field = 0.7 * octaves(u, v, fp, seed, 0.5, 6, 0.72) + 0.5 * grain(u, v, fp, seed + 9, 0.003)
    return clip(0.5 + (0.95 - wear + 0.55 * field - 0.3 * line_noise(u, v, fp, seed + 3, 0.5, 0.004)))


@kernel
def albedo(material, seed, colour, values, u, v, fp, damp):
    """Linear albedo (r, g, b); values are the material's own, damp darkens what soaks water up."""
    r, g, b = colour[0], colour[1], colour[2]
    f = 1.0
    if material == PLASTER:
        f = _plaster(u, v, fp, seed, values[0]) * (1.0 - 0.12 * damp)
    elif material == BRICK:
        f = _blocks(u, v, fp, seed, 0.24, 0.075, 0.011, 0.35) * (1.0 + 0.32 * grain(u, v, fp, seed + 3, 0.0015))
        f *= (1.0 + 0.16 * octaves(u, 0.5 * v, fp, seed + 4, 2.0, 3, 0.6)) * (1.0 - 0.12 * damp)
    elif material == STONE:
        f = _blocks(u, v, fp, seed, values[0], values[1], 0.012, 0.16) * (
            1.0 + 0.34 * grain(u, v, fp, seed + 3, 0.0015)
        )
        f *= (1.0 + 0.12 * octaves(u, 0.4 * v, fp, seed + 4, 1.6, 4, 0.6)) * (1.0 - 0.15 * damp)
    elif material == WOOD:
        f = _wood(u, v, fp, seed, values[0])
    elif material == GLASS:
        return glass(u, v, fp, seed, r, g, b, values[0], values[1])
    elif material == SHOP:
        return shop(u, v, fp, seed, r, g, b, values[0], values[1])
    elif material == SIGN:
        return sign(u, v, fp, seed, r, g, b, values)
    elif material == TILES:
        f, moss = _tiles(u, v, fp, seed)
        r, g, b = r + (0.12 - r) * 0.5 * moss, g + (0.13 - g) * 0.5 * moss, b + (0.07 - b) * 0.5 * moss
    elif material == ASPHALT:
        f = _asphalt(u, v, fp, seed) * (1.0 - 0.35 * damp)
    elif material == PAINT:
        left = _worn_paint(u, v, fp, seed, values[0])
        ground = 0.12 * _asphalt(u, v, fp, 5) * (1.0 - 0.35 * damp)
        f = 1.0 + 0.08 * grain(u, v, fp, seed + 5, 0.003)
        return (
            left * r * f + (1.0 - left) * ground,
            left * g * f + (1.0 - left) * ground,
            left * b * f + (1.0 - left) * ground,
        )
    elif material == PAVING:
        f = _paving(u, v, fp, seed, values[0]) * (1.0 - 0.25 * damp)
    elif material == KERB:
        joint = stripes(u / 1.0, 0.012, fp)
        f = (1.0 + 0.3 * grain(u, v, fp, seed, 0.0015)) * (1.0 - 0.6 * joint) * (1.0 - 0.2 * damp)
        f *= 1.0 + 0.2 * kept(0.5, fp) * (lattice(floor(u), 0, seed) - 0.5)
    elif material == CONCRETE:
        f = 1.0 + 0.3 * grain(u, v, fp, seed, 0.0015) + 0.12 * octaves(u, 0.5 * v, fp, seed + 7, 1.5, 4, 0.6)
        f *= 1.0 - 0.15 * damp
    elif material == LEAF:
        vein = grain(u, v, fp, seed, 0.004)
        f = 1.0 + 0.35 * vein
    elif material == GRASS:
        f = 1.0 + 0.5 * grain(u, 0.6 * v, fp, seed, 0.004) + 0.2 * octaves(u, v, fp, seed + 4, 2.0, 4, 0.6)
    elif material == BARK:
        f = 1.0 + 0.5 * octaves(u, 0.25 * v, fp, seed, 0.08, 5, 0.7) + 0.3 * grain(u, v, fp, seed + 5, 0.002)
    elif material == METAL:
        f = 1.0 + 0.10 * grain(u, v, fp, seed, 0.0015) - 0.35 * clip(3.0 * specks(u, v, fp, seed + 1, 0.06, 0.12))
    elif material == LACQUER:
        f = 1.0 + 0.05 * grain(u, v, fp, seed, 0.003)
    elif material == MANHOLE:
        f = _manhole(u, v, fp, seed)
    elif material == MESH:
        hole = stripes(u / 0.05, 0.85, fp / 0.05) * stripes(v / 0.15, 0.95, fp / 0.15)
        f = 1.0 - 0.75 * hole + 0.1 * grain(u, v, fp, seed, 0.002)
    elif material == PLATE:
        f = (
            1.0
            + 0.08 * grain(u, v, fp, seed, 0.0015)
            - 0.8 * stripes(u / 0.07, 0.55, fp / 0.07) * ramp(0.035 - abs(v - 0.055), fp)
        )
    else:
        f = 1.0 + 0.12 * grain(u, v, fp, seed, 0.003)
    f = max(f, 0.05)
    return min(r * f, 0.95), min(g * f, 0.95), min(b * f, 0.95)
