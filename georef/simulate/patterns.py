"""Structured surfaces: window panes with curtains, shop windows with goods, signs and posters with lettering."""

from __future__ import annotations

from math import floor, sin

from georef.simulate.noise import clip, grain, kept, kernel, lattice, octaves, ramp, small_kernel, specks


@kernel
def glass(u, v, fp, seed, r, g, b, width, height):
    """A pane of width x height: a dim room, curtains or blinds, things on the sill."""
    kind = lattice(1, 1, seed)
    dim = 0.75 + 0.5 * v / max(height, 0.1) + 0.25 * octaves(u, v, fp, seed, 0.6, 5, 0.6)
    r, g, b = r * dim, g * dim, b * dim
    cover = 0.0
    if kind < 0.6:  # curtains at both sides, folds
        edge = width * (0.15 + 0.35 * lattice(2, 1, seed)) * (1.0 - 0.35 * v / max(height, 0.1))
        side = min(u, width - u)
        cover = ramp(edge + 0.03 * sin(9.0 * v) - side, fp) * 0.85
    elif kind < 0.85:  # a blind, part of the way down
        cover = ramp(v - height * (0.3 + 0.6 * lattice(3, 1, seed)), fp) * 0.8
    folds = 0.22 + 0.08 * sin(u * (40.0 + 30.0 * kind)) * kept(0.05, fp) + 0.04 * grain(u, v, fp, seed + 3, 0.003)
    thing = ramp(v, fp) * clip(2.5 * specks(u, v - 0.05, fp, seed + 5, 0.28, 0.7)) * ramp(0.32 - v, fp)
    tone = 0.6 + 0.5 * lattice(4, 1, seed)
    r, g, b = (
        r + (folds * tone - r) * cover,
        g + (folds * tone * 0.97 - g) * cover,
        b + (folds * 0.9 * tone - b) * cover,
    )
    dirt = 1.0 + 0.10 * grain(u, v, fp, seed + 9, 0.002)
    return (
        (r + 0.25 * thing * (lattice(5, 1, seed))) * dirt,
        (g + 0.25 * thing * (lattice(6, 1, seed))) * dirt,
        (b + 0.2 * thing * (lattice(7, 1, seed))) * dirt,
    )


@kernel
def shop(u, v, fp, seed, r, g, b, width, height):
    """A shop window: shelves with goods behind glass, a strip of lettering."""
    shelf = 0.42
    row = floor(v / shelf)
    item_width = 0.09 + 0.14 * lattice(row, 5, seed)
    column = floor(u / item_width)
    tall = shelf * (0.35 + 0.5 * lattice(column, row, seed))
    x, y = u - column * item_width, v - row * shelf
    body = ramp(tall - y, fp) * ramp(x - 0.01, fp) * ramp(item_width - 0.015 - x, fp)
    body *= 1.0 if lattice(column, row, seed + 1) < 0.8 else 0.0
    fade = kept(item_width, fp)
    body = body * fade + 0.4 * (1.0 - fade)
    label = 0.6 + 0.5 * ramp(0.035 - abs(y - 0.4 * tall), fp)
    board = ramp(0.025 - y, fp)
    noise = 1.0 + 0.3 * grain(u, v, fp, seed + 3, 0.002)
    tint = 0.35 * body * label
    ir = tint * lattice(column, row, seed + 5) ** 1.5 + 0.20 * board
    ig = tint * lattice(column, row, seed + 6) ** 1.5 + 0.17 * board
    ib = tint * lattice(column, row, seed + 7) ** 1.5 + 0.13 * board
    dim = 0.5 + 0.5 * clip(1.2 - v / max(height, 0.5))
    r, g, b = (r + ir * dim) * noise, (g + ig * dim) * noise, (b + ib * dim) * noise
    letters = _lettering(u, v - 0.62 * height, fp, seed + 11, 0.14, width) * (1.0 if lattice(9, 9, seed) < 0.6 else 0.0)
    return r + (0.6 - r) * letters, g + (0.6 - g) * letters, b + (0.55 - b) * letters


@small_kernel
def _stroke(x, y, i, j, seed):
    """Whether a glyph cell has ink at (x, y) in [0, 1)^2."""
    if x > 0.8 or y > 0.85 or y < 0.0:
        return 0.0
    column, row = int(x / 0.8 * 4.0), int(y / 0.85 * 5.0)
    if (column == 0 and lattice(i, j, seed + 1) < 0.7) or (row == 0 and lattice(i, j, seed + 2) < 0.45):
        return 1.0
    if (row == 4 and lattice(i, j, seed + 3) < 0.5) or (row == 2 and lattice(i, j, seed + 4) < 0.5):
        return 1.0
    if column == 3 and lattice(i, j, seed + 5) < 0.5:
        return 1.0
    return 1.0 if lattice(4 * i + column, 5 * j + row, seed + 6) < 0.12 else 0.0


@small_kernel
def _lettering(u, v, fp, seed, size, width):
    """One line of glyph-like shapes of a height in metres between v = 0 and v = size: coverage."""
    if v < -fp or v > size + fp or u < 0.05 * width or u > 0.95 * width:
        return 0.0
    if size < 3.0 * fp:
        return 0.3
    total, step = 0.0, 0.5 * fp
    pitch = 0.72 * size
    for k in range(4):
        x = (u + (k % 2 - 0.5) * step) / pitch
        y = (v + (k // 2 - 0.5) * step) / size
        i = floor(x)
        if lattice(i, 0, seed + 21) > 0.14:
            total += 0.25 * _stroke(x - i, y, i, 0, seed)
    return total


@small_kernel
def _picture(u, v, fp, seed):
    """A poster's picture: overlapping soft shapes, in [0, 1]."""
    tone = 0.5 + 0.35 * octaves(u, v, fp, seed, 0.35, 6, 0.6)
    return clip(tone + 0.5 * specks(u, v, fp, seed + 3, 0.3, 0.8) + 0.35 * specks(u, v, fp, seed + 4, 0.09, 0.6))


@kernel
def sign(u, v, fp, seed, r, g, b, values):
    """A board of width x height; values[2]: 0 name board, 1 poster, 2 traffic sign or number plate."""
    width, height, kind = values[0], values[1], values[2]
    ink = 0.0
    er, eg, eb = lattice(1, 0, seed), lattice(2, 0, seed), lattice(3, 0, seed)
    bright = 0.3 * r + 0.6 * g + 0.1 * b
    er, eg, eb = (0.7, 0.7, 0.62 + 0.1 * eb) if bright < 0.3 else (0.5 * er * er, 0.3 * eg * eg, 0.4 * eb * eb)
    border = ramp(min(min(u, width - u), min(v, height - v)) - 0.02, fp)
    if kind < 0.5:
        ink = _lettering(u, v - 0.3 * height, fp, seed + 5, 0.45 * height, width)
        ink = max(ink, _lettering(u, v - 0.1 * height, fp, seed + 6, 0.12 * height, width))
    elif kind < 1.5:
        if v > 0.4 * height:
            p = _picture(u, v, fp, seed + 8)
            q = _picture(u, v, fp, seed + 9)
            r, g, b = r * p + 0.3 * q * er, g * q + 0.2 * p, b * (1.0 - 0.6 * p) + 0.2 * q
        else:
            lines = 5.0
            row = floor(v / (0.4 * height) * lines)
            line_height = 0.4 * height / lines
            size = line_height * (0.45 + 0.4 * lattice(row, 4, seed))
            ink = _lettering(u, v - row * line_height - 0.1 * line_height, fp, seed + row, size, width)
    else:
        ink = _lettering(u, v - 0.25 * height, fp, seed + 5, 0.5 * height, width)
        border = ramp(min(min(u, width - u), min(v, height - v)) - 0.04 * width, fp)
    f = 1.0 + 0.06 * grain(u, v, fp, seed + 2, 0.0015)
    f *= 0.75 + 0.25 * border
    return (r + (er - r) * ink) * f, (g + (eg - g) * ink) * f, (b + (eb - b) * ink) * f
