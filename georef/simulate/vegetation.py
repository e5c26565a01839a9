"""Trees and hedges: branches and thousands of small leaves, coloured by the season."""

from __future__ import annotations

import numpy as np
from numpy.random import Generator

from georef.geometry.rigid import Array
from georef.simulate import materials as m
from georef.simulate.mesh import Builder

_SUMMER = ((0.09, 0.17, 0.035), (0.12, 0.20, 0.05), (0.06, 0.13, 0.03), (0.15, 0.22, 0.06))
_AUTUMN = ((0.38, 0.24, 0.04), (0.30, 0.14, 0.03), (0.20, 0.17, 0.05), (0.42, 0.30, 0.06))
_LEAVES, _TINTS = 5200, 6


def tree(b: Builder, kind: float, seed: int, autumn: bool) -> None:
    rng = np.random.default_rng(seed)
    height, spread = 5.5 + 3.5 * kind, 1.7 + 1.3 * float(rng.random())
    bark = b.surface(m.BARK, (0.14, 0.11, 0.08), seed)
    lean = rng.normal(0, 0.12, 2)
    fork = (float(lean[0]), float(lean[1]), 0.42 * height)
    b.tube((0.0, 0.0, -0.1), fork, (0.17, 0.12), bark, 12)
    tips = _branches(b, rng, fork, height, spread, bark)
    soil = b.surface(m.GRASS, (0.10, 0.08, 0.05), seed)
    b.box((-0.6, -0.6, 0.05), (0.6, 0.6, 0.135), soil, ("bottom",))
    count = int(_LEAVES * (0.45 if autumn else 1.0))
    centres = tips[rng.integers(len(tips), size=count)] + rng.normal(0, 0.20 * spread, (count, 3))
    centres = np.clip(centres, [-3.3, -3.3, 0.0], [3.3, 3.3, 10.7])
    _leaves(b, rng, centres, 0.115, _AUTUMN if autumn else _SUMMER, seed)


def _branches(
    b: Builder, rng: Generator, fork: tuple[float, float, float], height: float, spread: float, bark: int
) -> Array:
    """Two generations of branches; their tips (n, 3)."""
    tips = []
    for limb in range(7):
        angle = 2 * np.pi * (limb / 7 + 0.08 * float(rng.random()))
        reach, rise = spread * float(rng.uniform(0.45, 0.75)), float(rng.uniform(0.62, 0.9)) * height
        end = (fork[0] + reach * np.cos(angle), fork[1] + reach * np.sin(angle), rise)
        b.tube(fork, end, (0.08, 0.035), bark, 7)
        for _ in range(4):
            offset = rng.normal([0.0, 0.0, 0.2], 0.32 * spread)
            tip = np.clip(np.array(end) + offset, [-2.4, -2.4, 0.40 * height], [2.4, 2.4, height])
            b.tube(end, tuple(tip.tolist()), (0.03, 0.01), bark, 5)
            tips += [tip, 0.5 * (tip + np.array(end))]
    return np.array(tips)


def hedge(b: Builder, kind: float, seed: int, autumn: bool) -> None:
    """A planter with a shrub."""
    rng = np.random.default_rng(seed)
    long, height = 0.7 + 1.1 * kind, float(rng.uniform(0.5, 0.9))
    trough = b.surface(m.CONCRETE, (0.40, 0.38, 0.35), seed)
    b.box((-0.45, -long, 0.0), (0.45, long, 0.62), trough, ("bottom",))
    for x in (-0.45, 0.45):
        for y in (-long, long):
            b.mark((x, y, 0.62), (0, 0, 1))
    count = int(1700 * long)
    centres = rng.uniform([-0.42, -long, 0.6], [0.42, long, 0.6 + height], (count, 3))
    shrunk = 1.0 - 0.25 * ((centres[:, 2:] - 0.6) / height) ** 2
    centres[:, :2] *= shrunk
    _leaves(b, rng, centres, 0.075, _AUTUMN[2:3] if autumn else _SUMMER, seed)


def _leaves(
    b: Builder, rng: Generator, centres: Array, size: float, palette: tuple[tuple[float, float, float], ...], seed: int
) -> None:
    """Small bent rhombs around the centres (n, 3), each turned its own way."""
    count = len(centres)
    surfaces = []
    for tint in range(_TINTS):
        base = np.array(palette[int(rng.integers(len(palette)))]) * rng.uniform(0.7, 1.3)
        surfaces.append(b.surface(m.LEAF, tuple(base.tolist()), seed + tint))
    stem, facing = _unit(rng.normal(size=(count, 3))), rng.normal(size=(count, 3))
    facing = _unit(np.cross(stem, facing))
    length = size * rng.uniform(0.6, 1.3, (count, 1))
    stem, across = stem * length, np.cross(facing, stem) * length * 0.45
    corners = np.stack([centres - stem, centres + across, centres + stem, centres - across], axis=1)
    outward = _unit(centres - centres.mean(axis=0))
    facing = facing * np.where(np.sum(facing * (outward + np.array([0, 0, 0.5])), axis=1, keepdims=True) < 0, -1.0, 1.0)
    normal = _unit(0.5 * facing + 0.5 * outward)
    shape = np.array([[-1.0, 0.0], [0.0, 0.45], [1.0, 0.0], [0.0, -0.45]])
    uv = shape * length[:, None] + rng.uniform(0, 5, (count, 1, 2))
    surface = np.array(surfaces, np.int32)[rng.integers(_TINTS, size=count)]
    b.smooth(corners, np.repeat(normal[:, None], 4, axis=1), uv, surface)


def _unit(vectors: Array) -> Array:
    return vectors / np.maximum(np.sqrt(np.einsum("ij,ij->i", vectors, vectors)), 1e-9)[:, None]
