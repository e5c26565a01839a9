"""Compiled kernels of one image observation: residual, and derivatives by camera point, mounting and calibration.

The same lenses as georef.geometry.lenses, one point at a time. A row of parameters is fx, fy, cx, cy, the coefficients,
and the limit last, as in `Camera.parameters`.
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

PINHOLE, BROWN, FISHEYE = (list(MODELS).index(name) for name in ("pinhole", "brown", "fisheye"))
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
def lens(model, k, x, y, z, image, by_point):
    """Image coordinates (2,) at unit focal length and their derivatives (2, 3); False where the lens shows nothing."""
    limit = k[k.shape[0] - 1]
    if model == FISHEYE:
        return _fisheye(k, limit, x, y, z, image, by_point)
    if not z > 0.0:
        return False
    a, b, inverse = x / z, y / z, 1.0 / z
    image[0], image[1] = a, b
    xx, xy, yy = 1.0, 0.0, 1.0
    if model == BROWN:
        if not a * a + b * b <= limit * limit:
            return False
        xx, xy, yy = _brown(k, a, b, image)
    by_point[0, 0], by_point[0, 1], by_point[0, 2] = xx * inverse, xy * inverse, -(xx * a + xy * b) * inverse
    by_point[1, 0], by_point[1, 1], by_point[1, 2] = xy * inverse, yy * inverse, -(xy * a + yy * b) * inverse
    return True


@kernel
def _brown(k, x, y, image):
    """Distorts slopes into image (2,); the symmetric derivative xx, xy, yy."""
    k1, k2, p1, p2, k3 = k[4], k[5], k[6], k[7], k[8]
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    rate = 2.0 * (k1 + r2 * (2.0 * k2 + 3.0 * r2 * k3))
    image[0] = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
    image[1] = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y
    return (
        radial + rate * x * x + 2.0 * p1 * y + 6.0 * p2 * x,
        rate * x * y + 2.0 * p1 * x + 2.0 * p2 * y,
        radial + rate * y * y + 6.0 * p1 * y + 2.0 * p2 * x,
    )


@kernel
def _fisheye(k, limit, x, y, z, image, by_point):
    across = sqrt(x * x + y * y)
    angle = atan2(across, z)
    if not (angle <= limit and (across > 0.0 or z > 0.0)):
        return False
    t2 = angle * angle
    radius = angle * (1.0 + t2 * (k[4] + t2 * (k[5] + t2 * (k[6] + t2 * k[7]))))
    rate = 1.0 + t2 * (3.0 * k[4] + t2 * (5.0 * k[5] + t2 * (7.0 * k[6] + t2 * 9.0 * k[7])))
    squared = across * across + z * z
    if across <= _ON_AXIS * abs(z):
        ex, ey, sideways = 1.0, 0.0, 1.0 / z
        image[0], image[1] = x / z, y / z
    else:
        ex, ey, sideways = x / across, y / across, radius / across
        image[0], image[1] = radius * ex, radius * ey
    turn = rate * z / squared - sideways
    by_point[0, 0], by_point[0, 1] = sideways + turn * ex * ex, turn * ex * ey
    by_point[1, 0], by_point[1, 1] = turn * ex * ey, sideways + turn * ey * ey
    back = -rate * across / squared
    by_point[0, 2], by_point[1, 2] = back * ex, back * ey
    return True


@kernel
def by_coefficient(model, index, x, y, z):
    """Derivative of the image coordinates by one coefficient of a lens that shows the point."""
    if model == FISHEYE:
        across = sqrt(x * x + y * y)
        angle = atan2(across, z)
        if across <= _ON_AXIS * abs(z):
            return 0.0, 0.0
        power = angle ** (2 * index + 3)
        return power * x / across, power * y / across
    a, b = x / z, y / z
    r2 = a * a + b * b
    if index == 2:
        return 2.0 * a * b, r2 + 2.0 * b * b
    if index == 3:
        return r2 + 2.0 * a * a, 2.0 * a * b
    power = r2 if index == 0 else (r2 * r2 if index == 1 else r2 * r2 * r2)
    return a * power, b * power


@kernel
def observe(placed, mounting, calibration, q, pixel, weight, cam, image, residual, by_cam):
    """Residual (2,), projected minus observed, of a point q (3,) in the rig frame, and its derivatives (2, 3) by the
    point in the camera frame, both times weight. Fills cam (3,) and image (2,) too. False where nothing is shown."""
    rotation, k = placed.cam_rotation[mounting], placed.parameters[calibration]
    for i in range(3):
        cam[i] = (
            rotation[i, 0] * q[0] + rotation[i, 1] * q[1] + rotation[i, 2] * q[2] + placed.cam_translation[mounting, i]
        )
    if not lens(placed.model[calibration], k, cam[0], cam[1], cam[2], image, by_cam):
        return False
    for i in range(2):
        residual[i] = (image[i] * k[i] + k[2 + i] - pixel[i]) * weight
        for j in range(3):
            by_cam[i, j] *= k[i] * weight
    return True


@kernel
def by_shared(images, placed, mounting, calibration, cam, image, weight, by_cam, out, column):
    """Derivatives (2, n) of an observation by its mounting and calibration, where unknown, and their columns (n,) in
    the border; n. From cam (3,), image (2,) and by_cam (2, 3) of `observe`, with the same weight."""
    count = 0
    first = images.mounting_column[mounting]
    if first >= 0:
        for i in range(2):
            a, b, c = by_cam[i, 0], by_cam[i, 1], by_cam[i, 2]
            out[i, 0], out[i, 1], out[i, 2] = b * cam[2] - c * cam[1], c * cam[0] - a * cam[2], a * cam[1] - b * cam[0]
            out[i, 3], out[i, 4], out[i, 5] = -a, -b, -c
        for j in range(6):
            column[j] = first + j
        count = 6
    first = images.calibration_column[calibration]
    if first >= 0:
        for j in range(images.unknowns[calibration]):
            _by_code(images.code[calibration, j], placed, calibration, cam, image, weight, out, count)
            column[count] = first + j
            count += 1
    return count


@kernel
def _by_code(code, placed, calibration, cam, image, weight, out, at):
    k = placed.parameters[calibration]
    u, v = image[0] * k[0], image[1] * k[1]
    if code == ASPECT:
        u = 0.0
    elif code == CENTRE_X:
        u, v = k[0], 0.0
    elif code == CENTRE_Y:
        u, v = 0.0, k[0]
    elif code >= FIRST_COEFFICIENT:
        a, b = by_coefficient(placed.model[calibration], code - FIRST_COEFFICIENT, cam[0], cam[1], cam[2])
        u, v = a * k[0], b * k[1]
    out[0, at], out[1, at] = u * weight, v * weight
