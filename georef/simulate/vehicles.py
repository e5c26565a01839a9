"""Parked cars: a lofted body with smooth sides, windows, lamps, number plates and wheels."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator

from georef.geometry.rigid import Array
from georef.simulate import materials as m
from georef.simulate.mesh import Builder

_COLOURS = (
    *((0.02, 0.02, 0.022), (0.55, 0.56, 0.57), (0.72, 0.72, 0.70), (0.16, 0.17, 0.18), (0.30, 0.02, 0.02)),
    *((0.02, 0.06, 0.22), (0.05, 0.16, 0.10), (0.35, 0.33, 0.30), (0.08, 0.09, 0.10), (0.70, 0.70, 0.69)),
)
# Stations along the car, front to back in shares of its length: height of the body's shoulder and of the roof,
# in shares of the full height; where both are equal there is bonnet or boot.
_SALOON = np.array(
    [
        *((0.00, 0.36, 0.37), (0.02, 0.44, 0.46), (0.06, 0.50, 0.52), (0.26, 0.60, 0.62), (0.40, 0.62, 0.94)),
        *((0.48, 0.62, 1.00), (0.64, 0.63, 1.00), (0.72, 0.64, 0.94), (0.86, 0.66, 0.68), (0.97, 0.64, 0.66)),
        (1.00, 0.50, 0.51),
    ]
)
_HATCH = np.array(
    [
        *((0.00, 0.36, 0.37), (0.03, 0.46, 0.48), (0.20, 0.57, 0.59), (0.36, 0.60, 0.92), (0.46, 0.60, 0.99)),
        *((0.70, 0.61, 1.00), (0.88, 0.62, 0.95), (0.97, 0.62, 0.68), (1.00, 0.50, 0.51)),
    ]
)
_STATIONS = 30
_VAN = np.array(
    [
        *((0.00, 0.28, 0.29), (0.03, 0.40, 0.42), (0.10, 0.48, 0.50), (0.24, 0.52, 0.95), (0.30, 0.52, 1.00)),
        *((0.60, 0.52, 1.00), (0.96, 0.52, 0.99), (0.99, 0.52, 0.90), (1.00, 0.48, 0.49)),
    ]
)


def car(b: Builder, kind: float, seed: int) -> None:
    """A car that looks along +y, its middle at the origin."""
    rng = np.random.default_rng(seed)
    profile, length, width, height = (
        (_SALOON, 4.6, 1.80, 1.45)
        if kind < 0.45
        else (_HATCH, 4.0, 1.74, 1.50)
        if kind < 0.85
        else (_VAN, 5.2, 2.0, 2.15)
    )
    scale = float(rng.uniform(0.96, 1.04))
    length, colour = length * scale, _COLOURS[int(rng.integers(len(_COLOURS)))]
    paint = b.surface(m.LACQUER, colour, seed)
    pane = b.surface(m.LACQUER, (0.025, 0.03, 0.035), seed + 1)
    _body(b, profile, length, width, height, (paint, pane))
    _wheels(b, length, width, seed)
    _ends(b, length, width, height, seed)


def _body(b: Builder, profile: Array, length: float, width: float, height: float, surfaces: tuple[int, int]) -> None:
    """Cross-sections from sill to roof, lofted; the glass is what lies between shoulder and roof."""
    half, shares = 0.5 * width, np.union1d(profile[:, 0], np.linspace(0, 1, _STATIONS))
    profile = np.column_stack([shares, PchipInterpolator(profile[:, 0], profile[:, 1:])(shares)])
    rings = []
    for share, shoulder, roof in profile:
        end = 1.0 - 0.10 * (abs(2 * share - 1) ** 6)
        w, y, s, r = half * end, length * (0.5 - share), shoulder * height, roof * height
        inset = 0.0 if roof - shoulder < 0.05 else 0.16 * half / 0.4 * min(roof - shoulder, 0.4)
        side = [(w * 0.90, 0.17), (w * 0.97, 0.24), (w, 0.5 * s), (w * 0.985, s * 0.93), (w * 0.95, s)]
        side += [(w * 0.95 - inset, s + 0.86 * (r - s)), (w * 0.95 - inset - 0.12, r)]
        ring = [(x, y, z) for x, z in side] + [(-x, y, z) for x, z in reversed(side)]
        rings.append(ring)
    grid = np.array(rings)
    corners = np.stack([grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]], axis=2)
    normals = _normals(grid)
    around = np.stack([normals[:-1, :-1], normals[1:, :-1], normals[1:, 1:], normals[:-1, 1:]], axis=2)
    cabin = np.minimum(profile[:-1, 2] - profile[:-1, 1], profile[1:, 2] - profile[1:, 1])
    steep = np.abs(np.diff(profile[:, 2]) / np.diff(shares)) > 1.2
    inner = (shares[:-1] > 0.05) & (shares[1:] < 0.985)
    glazed = np.zeros(corners.shape[:2], dtype=bool)
    pillar = np.abs(0.5 * (shares[1:] + shares[:-1]) - 0.56) < 0.012
    glazed[:, [4, 8]] = ((cabin > 0.16) & inner & ~pillar)[:, None]
    glazed[steep & (cabin > 0.03) & inner, 5:8] = True
    surface: NDArray[np.int32] = np.where(glazed, surfaces[1], surfaces[0]).astype(np.int32)
    uv = np.stack([corners[..., 1], corners[..., 2] + corners[..., 0]], axis=-1)
    b.smooth(corners.reshape(-1, 4, 3), around.reshape(-1, 4, 3), uv.reshape(-1, 4, 2), surface.ravel())
    for ring, facing in ((grid[0], 1.0), (grid[-1], -1.0)):
        points = [(float(x), float(y), float(z)) for x, y, z in (ring if facing > 0 else ring[::-1])]
        for i in range(len(points) // 2 - 1):
            b.quad(points[i], points[i + 1], points[-i - 2], points[-i - 1], surfaces[0])


def _normals(grid: Array) -> Array:
    """Normals (n, k, 3) of a lofted grid of points, outwards."""
    normal = np.cross(np.gradient(grid, axis=1), np.gradient(grid, axis=0))
    normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-9)
    outward = grid - [0.0, 0.0, 0.6]
    return normal * np.where(np.sum(normal * outward, axis=-1, keepdims=True) < 0, -1.0, 1.0)


def _wheels(b: Builder, length: float, width: float, seed: int) -> None:
    tyre, rim = b.surface(m.RUBBER, (0.03, 0.03, 0.03), seed), b.surface(m.METAL, (0.45, 0.45, 0.46), seed + 2)
    arch, radius = b.surface(m.RUBBER, (0.01, 0.01, 0.01), seed + 3), 0.32
    for side in (-1.0, 1.0):
        x = side * 0.5 * width
        for y in (0.32 * length, -0.30 * length):
            b.disc((x + side * 0.004, y, radius + 0.03), radius + 0.07, arch, "x", 24)
            b.tube((x - side * 0.20, y, radius), (x + side * 0.012, y, radius), (radius, radius), tyre, 20)
            b.disc((x + side * 0.013, y, radius), radius, tyre, "x", 24)
            b.disc((x + side * 0.017, y, radius), 0.66 * radius, rim, "x", 20)
            for spoke in np.arange(5) * 2 * np.pi / 5 + seed:
                centre = (x + side * 0.020, y + 0.12 * np.cos(spoke), radius + 0.12 * np.sin(spoke))
                b.disc(centre, 0.045, tyre, "x", 8)
    under = b.surface(m.RUBBER, (0.015, 0.015, 0.015), seed)
    b.box((-0.44 * width, -0.46 * length, 0.13), (0.44 * width, 0.46 * length, 0.25), under, ("top",))


def _ends(b: Builder, length: float, width: float, height: float, seed: int) -> None:
    """Lamps, plates, handles, mirrors."""
    half, w = 0.5 * length, 0.45 * width
    white, red = b.surface(m.LACQUER, (0.75, 0.75, 0.72), seed), b.surface(m.LACQUER, (0.40, 0.015, 0.01), seed)
    black = b.surface(m.RUBBER, (0.03, 0.03, 0.03), seed)
    for x in (-w, w - 0.36):
        b.box((x, half - 0.10, 0.30 * height), (x + 0.36, half - 0.005, 0.36 * height), white)
        b.box((x + 0.02, -half - 0.01, 0.38 * height), (x + 0.30, -half + 0.12, 0.47 * height), red)
    b.box((-w, half - 0.06, 0.17), (w, half + 0.02, 0.22 * height), black)
    b.box((-w, -half - 0.02, 0.17), (w, -half + 0.06, 0.24 * height), black)
    plate = b.surface(m.PLATE, (0.72, 0.72, 0.68), seed + 5)
    for y, turn in ((half + 0.025, 1.0), (-half - 0.025, -1.0)):
        x, low, uv = 0.26 * turn, 0.30, [(0.0, 0.0), (0.52, 0.0), (0.52, 0.11), (0.0, 0.11)]
        b.quad((x, y, low), (-x, y, low), (-x, y, low + 0.11), (x, y, low + 0.11), plate, uv)
    for side in (-1.0, 1.0):
        x = side * 0.5 * width
        ends = sorted((x, x + side * 0.2))
        b.box((ends[0], 0.16 * length, 0.62 * height), (ends[1], 0.16 * length + 0.1, 0.62 * height + 0.14), black)
        for y in (0.02, -0.22):
            ends = sorted((x, x + side * 0.015))
            b.box((ends[0], y * length, 0.53 * height), (ends[1], y * length + 0.16, 0.55 * height), black)
