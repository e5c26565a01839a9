"""Jacobians of the exponential map of SE(3), many at once, in the tangent order (rotation rad, translation m).

Formulas: Sola, Deray, Atchuthan, "A micro Lie theory for state estimation in robotics" (2018), appendix D; Barfoot,
"State estimation for robotics" (2017), section 7.1.5.
"""

from __future__ import annotations

from math import factorial
from typing import cast

import numpy as np

from georef.geometry.poses import left_jacobians
from georef.geometry.rigid import Array, skew

_SERIES_BELOW_RAD, _SERIES_TERMS = 0.5, 7


def inverse_right_jacobians(xi: Array) -> Array:
    """J (N, 6, 6) at tangents xi (N, 6): log(Exp(xi) Exp(d)) = xi + J d to first order in d."""
    turned_back = -xi
    rotation = np.linalg.inv(left_jacobians(turned_back[:, :3]))
    out = np.zeros((len(xi), 6, 6))
    out[:, :3, :3] = out[:, 3:, 3:] = rotation
    out[:, 3:, :3] = -rotation @ _coupling(turned_back) @ rotation
    return out


def _coupling(xi: Array) -> Array:
    """The block (N, 3, 3) of the left Jacobian of SE(3) by which a rotation moves the translation."""
    w, v = skew(xi[:, :3]), skew(xi[:, 3:])
    first, second, third = (c[:, None, None] for c in _remainders(np.linalg.norm(xi[:, :3], axis=1)))
    wv, vw = w @ v, v @ w
    wvw, wwv, vww = wv @ w, w @ wv, vw @ w
    mixed = wvw @ w + w @ wvw
    return cast(
        Array,
        0.5 * v + first * (wv + vw + wvw) + second * (wwv + vww - 3.0 * wvw) + 0.5 * (second - 3.0 * third) * mixed,
    )


def _remainders(angle: Array) -> tuple[Array, Array, Array]:
    """(a - sin a) / a^3, (a^2/2 + cos a - 1) / a^4 and (a^3/6 + sin a - a) / a^5 of angles (N,), stable near zero."""
    safe, square = np.where(angle < _SERIES_BELOW_RAD, 1.0, angle), angle * angle
    exact = (
        (safe - np.sin(safe)) / safe**3,
        (0.5 * safe**2 + np.cos(safe) - 1.0) / safe**4,
        (safe**3 / 6.0 + np.sin(safe) - safe) / safe**5,
    )
    series = (
        sum((-square) ** i / factorial(order + 2 * i) for i in range(_SERIES_TERMS)) for order in (3, 4, 5)
    )  # the rest of sine and cosine after their first terms
    return cast(
        tuple[Array, Array, Array],
        tuple(np.where(angle < _SERIES_BELOW_RAD, s, e) for s, e in zip(series, exact, strict=True)),
    )
