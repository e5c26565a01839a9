"""Compiled kernels of one image observation: residual, and derivatives by camera point, mounting and calibration.

The same lenses as georef.geometry.lenses, one point at a time. A row of parameters is fx, fy, cx, cy, the coefficients,
and the limit last, as in `Camera.parameters`.

The compiler's cache looks at the file of a kernel alone, not at those it calls: after a change here, remove the *.nbi
files of this folder's __pycache__.
"""

from __future__ import annotations

from math import atan2, sqrt
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from georef.geometry.lenses import MODELS
from georef.geometry.rigid import Array

# NaN and infinity keep their meaning: only sums may be reordered and multiplications joined with additions.
kernel = numba.njit(cache=True, error_model="numpy", fastmath={"contract", "reassoc", "nsz"})

PINHOLE, BROWN, FISHEYE, RATIONAL = (list(MODELS).index(name) for name in ("pinhole", "brown", "fisheye", "rational"))
FOCAL, ASPECT, CENTRE_X, CENTRE_Y, FIRST_COEFFICIENT = range(5)
_ON_AXIS = 1e-9


class Images(NamedTuple):
    """What images consist of, and where their unknowns stand, counted from the start of the border (-1: held)."""

    station: NDArray[np.int32]  # (M,)
    mounting: NDArray[np.int32]  # (M,)
    calibration: NDArray[np.int32]  # (M,)
    mounting_column: NDArray[np.int64]  # (R,)
    calibration_column: NDArray[np.int64]  # (C,)
    code: NDArray[np.int64]  # (C, Q) FOCAL to CENTRE_Y, or FIRST_COEFFICIENT + index of a coefficient
    unknowns: NDArray[np.int64]  # (C,) how many codes a calibration has


class Placed(NamedTuple):
    """Stations, mountings and calibrations of a state."""

    rig_rotation: Array  # (S, 3, 3) rig_from_world
    rig_translation: Array  # (S, 3)
    cam_rotation: Array  # (R, 3, 3) cam_from_rig
    cam_translation: Array  # (R, 3)
    model: NDArray[np.int64]  # (C,)
    parameters: Array  # (C, 4 + coefficients + 1)


@kernel
def lens(model, parameters, row, x, y, z):
    """Whether a lens shows a point, its image coordinates at unit focal length, and their derivatives by the point (3
    of the first, 3 of the second). parameters (C, ...), of which the row is meant."""
    limit = parameters[row, parameters.shape[1] - 1]
    if model == FISHEYE:
        return _fisheye(parameters, row, limit, x, y, z)
    if not z > 0.0:
        return False, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    inverse = 1.0 / z
    a, b = x * inverse, y * inverse
    u, v, xx, xy, yy = a, b, 1.0, 0.0, 1.0
    if model != PINHOLE:
        if not a * a + b * b <= limit * limit:
            return False, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        u, v, xx, xy, yy = _bend(model, parameters, row, a, b)
    xz, yz = -(xx * a + xy * b) * inverse, -(xy * a + yy * b) * inverse
    return True, u, v, xx * inverse, xy * inverse, xz, xy * inverse, yy * inverse, yz


@kernel
def _bend(model, k, row, x, y):
    """Slopes distorted by Brown's or the rational model, and the symmetric derivative xx, xy, yy."""
    k1, k2, p1, p2, k3 = k[row, 4], k[row, 5], k[row, 6], k[row, 7], k[row, 8]
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    rate = k1 + r2 * (2.0 * k2 + 3.0 * r2 * k3)
    if model == RATIONAL:
        k4, k5, k6 = k[row, 9], k[row, 10], k[row, 11]
        below = 1.0 + r2 * (k4 + r2 * (k5 + r2 * k6))
        radial /= below
        rate = (rate - radial * (k4 + r2 * (2.0 * k5 + 3.0 * r2 * k6))) / below
    rate *= 2.0
    return (
        x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
        y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
        radial + rate * x * x + 2.0 * p1 * y + 6.0 * p2 * x,
        rate * x * y + 2.0 * p1 * x + 2.0 * p2 * y,
        radial + rate * y * y + 6.0 * p1 * y + 2.0 * p2 * x,
    )


@kernel
def _fisheye(k, row, limit, x, y, z):
    across = sqrt(x * x + y * y)
    angle = atan2(across, z)
    if not (angle <= limit and (across > 0.0 or z > 0.0)):
        return False, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    k1, k2, k3, k4 = k[row, 4], k[row, 5], k[row, 6], k[row, 7]
    t2 = angle * angle
    radius = angle * (1.0 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))
    rate = 1.0 + t2 * (3.0 * k1 + t2 * (5.0 * k2 + t2 * (7.0 * k3 + t2 * 9.0 * k4)))
    inverse = 1.0 / (across * across + z * z)
    if across <= _ON_AXIS * abs(z):
        ex, ey, sideways = 1.0, 0.0, 1.0 / z
        u, v = x * sideways, y * sideways
    else:
        unit = 1.0 / across
        ex, ey, sideways = x * unit, y * unit, radius * unit
        u, v = radius * ex, radius * ey
    turn, back = rate * z * inverse - sideways, -rate * across * inverse
    mixed = turn * ex * ey
    return True, u, v, sideways + turn * ex * ex, mixed, back * ex, mixed, sideways + turn * ey * ey, back * ey


@kernel
def _by_coefficient(index, model, k, row, x, y, z):
    """Derivative of the image coordinates by one coefficient of a lens that shows the point."""
    if model == FISHEYE:
        across = sqrt(x * x + y * y)
        if across <= _ON_AXIS * abs(z):
            return 0.0, 0.0
        power = atan2(across, z) ** (2 * index + 3)
        return power * x / across, power * y / across
    a, b = x / z, y / z
    r2 = a * a + b * b
    if index == 2:
        return 2.0 * a * b, r2 + 2.0 * b * b
    if index == 3:
        return r2 + 2.0 * a * a, 2.0 * a * b
    below = 1.0
    if model == RATIONAL:
        below = 1.0 + r2 * (k[row, 9] + r2 * (k[row, 10] + r2 * k[row, 11]))
    if index <= 4:  # k1, k2, k3
        power = r2 ** (index + 1 if index < 2 else 3) / below
    else:  # k4, k5, k6
        above = 1.0 + r2 * (k[row, 4] + r2 * (k[row, 5] + r2 * k[row, 8]))
        power = -(r2 ** (index - 4)) * above / (below * below)
    return a * power, b * power


@kernel
def by_unknown(code, model, parameters, row, cam_x, cam_y, cam_z, image_x, image_y):
    """Derivative of a pixel by an unknown of its calibration; see `Images.code`."""
    fx, fy = parameters[row, 0], parameters[row, 1]
    if code == FOCAL:
        return image_x * fx, image_y * fy
    if code == ASPECT:
        return 0.0, image_y * fy
    if code == CENTRE_X:
        return fx, 0.0
    if code == CENTRE_Y:
        return 0.0, fx
    a, b = _by_coefficient(code - FIRST_COEFFICIENT, model, parameters, row, cam_x, cam_y, cam_z)
    return a * fx, b * fy
