"""Radial curves of lenses: where they stop to rise, and their inverse."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from georef.geometry.rigid import Array

_NEGLIGIBLE = 1e-12  # coefficients that bend nothing, and would overflow where roots are looked for
_BISECTIONS, _FOUND = 60, 1e-15


def first_turning_point(rate: Array) -> float:
    """Smallest positive x at which 1 + rate[0] x^2 + rate[1] x^4 + ... is zero; infinite where it is nowhere."""
    rate = np.where(np.abs(rate) > _NEGLIGIBLE, rate, 0.0)
    roots = np.roots([*rate[::-1], 1.0]) if np.any(rate) else np.zeros(0)
    real = roots.real[(np.abs(roots.imag) < 1e-9 * np.maximum(1.0, np.abs(roots.real))) & (roots.real > 0)]
    return float(np.sqrt(real.min())) if len(real) else np.inf


def inverse_of_rising(curve: Callable[[Array], tuple[Array, Array]], value: Array, limit: Array) -> Array:
    """The x (N,) in [0, limit] at which a rising curve, which gives values and derivatives, has the values (N,); NaN
    for values above that at the limit. Newton's method, bisecting where a step leaves the bracket."""
    low, high = np.zeros_like(value), np.broadcast_to(limit, value.shape).astype(np.float64).copy()
    farthest, _ = curve(high)
    x = np.minimum(value, high)
    for _ in range(_BISECTIONS):
        found, rate = curve(x)
        error = found - value
        if np.abs(np.where(value <= farthest, error, 0.0)).max(initial=0.0) < _FOUND:
            break
        low, high = np.where(error < 0, x, low), np.where(error > 0, x, high)
        with np.errstate(divide="ignore", invalid="ignore"):
            newton = x - error / rate
        inside = (newton >= low) & (newton <= high)
        x = np.where(error == 0, x, np.where(inside, newton, 0.5 * (low + high)))
    return np.where(value <= farthest, x, np.nan)
