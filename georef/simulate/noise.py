"""Noise on an endless lattice, hashed from integer coordinates and a seed, so that nothing ever repeats.

Each function takes the footprint of the pixel on the surface and leaves out what the pixel cannot show.
"""

from __future__ import annotations

from math import floor

import numba

_K1, _K2, _K3 = -7046029254386353131, -4417276706812531889, 1609587929392839161
_MIX = -4658895280553007687
_LOW35, _LOW32, _LOW31 = (1 << 35) - 1, (1 << 32) - 1, (1 << 31) - 1
_UNIT = 1.0 / (1 << 31)

kernel = numba.njit(cache=True, fastmath=True, inline="never", error_model="numpy")
small_kernel = numba.njit(cache=True, fastmath=True, error_model="numpy")


@small_kernel
def lattice(i, j, seed):
    """A number in [0, 1) of a lattice point."""
    h = i * _K1 + j * _K2 + seed * _K3
    h = (h ^ ((h >> 29) & _LOW35)) * _MIX
    h = (h ^ ((h >> 32) & _LOW32)) * _K3
    return ((h >> 31) & _LOW31) * _UNIT


@small_kernel
def clip(x):
    return min(max(x, 0.0), 1.0)


@small_kernel
def kept(width_m, footprint_m):
    """How much of an octave of this lattice width the pixel shows: 0 below the Nyquist limit, 1 well above."""
    return clip((width_m / footprint_m - 0.8) * 0.9)


@small_kernel
def ramp(distance_m, footprint_m):
    """Coverage of a pixel by the half-plane distance > 0."""
    return clip(distance_m / footprint_m + 0.5)


@small_kernel
def value_noise(u, v, width_m, seed):
    """Smooth noise in [-1, 1], zero mean."""
    x, y = u / width_m, v / width_m
    i, j = floor(x), floor(y)
    fx, fy = x - i, y - j
    fx, fy = fx * fx * (3.0 - 2.0 * fx), fy * fy * (3.0 - 2.0 * fy)
    low = lattice(i, j, seed) * (1.0 - fx) + lattice(i + 1, j, seed) * fx
    high = lattice(i, j + 1, seed) * (1.0 - fx) + lattice(i + 1, j + 1, seed) * fx
    return 2.0 * (low * (1.0 - fy) + high * fy) - 1.0


@small_kernel
def octaves(u, v, footprint_m, seed, coarsest_m, count, gain):
    """Sum of `count` octaves of value noise, each half as wide and `gain` times as strong as the one before."""
    total, strength, width = 0.0, 1.0, coarsest_m
    for octave in range(count):
        k = kept(width, footprint_m)
        if k <= 0.0:
            break
        total += k * strength * value_noise(u, v, width, seed + 131 * octave)
        strength *= gain
        width *= 0.47
    return total


@small_kernel
def specks(u, v, footprint_m, seed, width_m, share):
    """Bright and dark spots, one in `share` of the cells, in [-1, 1], zero mean."""
    k = kept(width_m * 0.5, footprint_m)
    if k <= 0.0:
        return 0.0
    x, y = u / width_m, v / width_m
    i, j = floor(x), floor(y)
    pick = lattice(i, j, seed)
    if pick > share:
        return 0.0
    pick = pick / share
    radius = 0.10 + 0.30 * pick * pick
    stretch = 0.7 + 0.6 * lattice(i, j, seed + 3)
    dx = (x - i - radius - (1.0 - 2.0 * radius) * lattice(i, j, seed + 1)) * stretch
    dy = y - j - radius - (1.0 - 2.0 * radius) * lattice(i, j, seed + 2)
    soft = max(footprint_m / width_m, 0.25 * radius)
    inside = clip((radius * 0.75 - (dx * dx + dy * dy) ** 0.5) / soft + 0.5)
    return k * inside * (2.0 * lattice(i, j, seed + 4) - 1.0)


@small_kernel
def grain(u, v, footprint_m, seed, finest_m):
    """Rough texture at all scales from `finest_m` upwards."""
    total, width = 0.0, 0.35
    octave = 0
    while width >= finest_m and width > 0.7 * footprint_m:
        total += kept(width, footprint_m) * 0.5 * value_noise(u, v, width, seed + octave)
        if octave % 2 == 1:
            total += 1.1 * specks(u, v, footprint_m, seed + 50 + octave, 2.5 * width, 0.5)
        width *= 0.47
        octave += 1
    return total


@small_kernel
def stripes(x, width, footprint):
    """Mean over the footprint of a pulse train of period 1 that is 1 in [0, width)."""
    footprint = max(footprint, 1e-6)
    a, b = x - 0.5 * footprint, x + 0.5 * footprint
    fa, fb = floor(a), floor(b)
    return (fb * width + min(b - fb, width) - fa * width - min(a - fa, width)) / footprint


@small_kernel
def line_noise(u, v, footprint_m, seed, cell_m, half_width_m):
    """Thin wandering lines, such as cracks: coverage in [0, 1]."""
    k = kept(cell_m, footprint_m)
    if k <= 0.0:
        return 0.0
    wander = 0.3 * value_noise(u, v, 0.25 * cell_m, seed + 7) + 0.12 * value_noise(u, v, 0.08 * cell_m, seed + 8)
    field = value_noise(u, v, cell_m, seed) + 0.6 * wander
    gate = clip(3.0 * value_noise(u, v, 2.3 * cell_m, seed + 9) - 0.4)
    distance = abs(field) * cell_m * 0.5
    return (
        k
        * gate
        * clip((half_width_m - distance) / max(footprint_m, 0.5 * half_width_m) + 0.5)
        * clip(2.0 * half_width_m / max(footprint_m, 1e-6))
    )
