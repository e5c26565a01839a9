"""Lenses that bend the slopes x/z, y/z of what is in front of them: pinhole, brown and rational.

Brown and rational multiply the slopes by a radial factor of r^2 and add the decentring of p1, p2.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from georef.geometry.lens_curves import first_turning_point, inverse_of_rising
from georef.geometry.rigid import Array

_UNDISTORT_ITERATIONS, _UNDISTORTED = 12, 1e-15
_SMALLEST_DETERMINANT, _LARGEST_STEP = 1e-3, 0.5  # of Newton's method
_DOUBLINGS, _SHORT_OF_POLE = 40, 1.0 - 1e-9
Radial = Callable[[Array, Array], tuple[Array, Array]]  # r^2 (N,), coefficients -> factor, its derivative by r^2 (N,)


def _slopes(points: Array) -> tuple[Array, Array]:
    """x/z, y/z (N, 2) and depths (N,); NaN for points that are not in front."""
    depth = np.where(points[..., 2] > 0, points[..., 2], np.nan)
    return points[..., :2] / depth[..., None], depth


def _slope_derivatives(points: Array, depth: Array) -> Array:
    by_point = np.zeros((*points.shape[:-1], 2, 3))
    by_point[..., 0, 0] = by_point[..., 1, 1] = 1.0 / depth
    by_point[..., 2] = -points[..., :2] / (depth * depth)[..., None]
    return by_point


def _inside(slopes: Array, limit: Array) -> Array:
    """The slopes, NaN beyond the radius at which the distortion folds the image back on itself."""
    with np.errstate(invalid="ignore"):
        return np.where((np.square(slopes).sum(axis=-1) <= limit * limit)[..., None], slopes, np.nan)


# --- pinhole --------------------------------------------------------------------------------------


def pinhole_project(points: Array, _k: Array, _limit: Array) -> Array:
    return _slopes(points)[0]


def pinhole_derivatives(points: Array, _k: Array, _limit: Array) -> tuple[Array, Array, Array]:
    slopes, depth = _slopes(points)
    return slopes, _slope_derivatives(points, depth), np.zeros((*points.shape[:-1], 2, 0))


def pinhole_rays(image: Array, _k: Array, _limit: Array) -> Array:
    return np.concatenate([image, np.ones((*image.shape[:-1], 1))], axis=-1)


# --- what brown and rational share ----------------------------------------------------------------


def _distort(slopes: Array, k: Array, radial: Radial) -> Array:
    x, y = slopes[..., 0], slopes[..., 1]
    p1, p2 = k[..., 2], k[..., 3]
    r2 = x * x + y * y
    factor, _ = radial(r2, k)
    return np.stack(
        [
            x * factor + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
            y * factor + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
        ],
        axis=-1,
    )


def _distort_rate(slopes: Array, k: Array, radial: Radial) -> tuple[Array, Array, Array]:
    """Derivative of the distortion by the slopes, which is symmetric: xx, xy, yy, each (N,)."""
    x, y = slopes[..., 0], slopes[..., 1]
    p1, p2 = k[..., 2], k[..., 3]
    factor, by_r2 = radial(x * x + y * y, k)
    rate = 2.0 * by_r2
    xx = factor + rate * x * x + 2.0 * p1 * y + 6.0 * p2 * x
    xy = rate * x * y + 2.0 * p1 * x + 2.0 * p2 * y
    yy = factor + rate * y * y + 6.0 * p1 * y + 2.0 * p2 * x
    return xx, xy, yy


def _undistort(image: Array, k: Array, radial: Radial, start: Array) -> Array:
    """The slopes (N, 2) that are distorted to image coordinates (N, 2), by Newton's method from slopes to start at."""
    slopes = start.copy()
    for _ in range(_UNDISTORT_ITERATIONS):
        error = _distort(slopes, k, radial) - image
        if np.abs(np.nan_to_num(error)).max(initial=0.0) < _UNDISTORTED:
            break
        xx, xy, yy = _distort_rate(slopes, k, radial)
        determinant = np.maximum(xx * yy - xy * xy, _SMALLEST_DETERMINANT)
        step = np.stack([yy * error[..., 0] - xy * error[..., 1], xx * error[..., 1] - xy * error[..., 0]], axis=-1)
        slopes = slopes - np.clip(step / determinant[..., None], -_LARGEST_STEP, _LARGEST_STEP)
    return slopes


def _derivatives(points: Array, k: Array, limit: Array, radial: Radial) -> tuple[Array, Array, Array, Array, Array]:
    """Image coordinates, their derivatives by the point, by p1 and by p2 (N, 2), and the slopes."""
    slopes, depth = _slopes(points)
    slopes = _inside(slopes, limit)
    xx, xy, yy = _distort_rate(slopes, k, radial)
    by_slope = np.stack([np.stack([xx, xy], axis=-1), np.stack([xy, yy], axis=-1)], axis=-2)
    x, y = slopes[..., 0], slopes[..., 1]
    r2 = x * x + y * y
    by_p1 = np.stack([2.0 * x * y, r2 + 2.0 * y * y], axis=-1)
    by_p2 = np.stack([r2 + 2.0 * x * x, 2.0 * x * y], axis=-1)
    return _distort(slopes, k, radial), by_slope @ _slope_derivatives(points, depth), by_p1, by_p2, slopes


# --- brown ----------------------------------------------------------------------------------------


def _brown_radial(r2: Array, k: Array) -> tuple[Array, Array]:
    k1, k2, k3 = k[..., 0], k[..., 1], k[..., 4]
    return 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3)), k1 + r2 * (2.0 * k2 + 3.0 * r2 * k3)


def brown_project(points: Array, k: Array, limit: Array) -> Array:
    return _distort(_inside(_slopes(points)[0], limit), k, _brown_radial)


def brown_derivatives(points: Array, k: Array, limit: Array) -> tuple[Array, Array, Array]:
    image, by_point, by_p1, by_p2, slopes = _derivatives(points, k, limit, _brown_radial)
    r2 = np.square(slopes).sum(axis=-1, keepdims=True)
    return image, by_point, np.stack([slopes * r2, slopes * r2**2, by_p1, by_p2, slopes * r2**3], axis=-1)


def brown_rays(image: Array, k: Array, limit: Array) -> Array:
    return pinhole_rays(_inside(undistort(image, k), limit), k, limit)


def undistort(image: Array, k: Array) -> Array:
    """The slopes (N, 2) that Brown's model distorts to image coordinates (N, 2).

    Exact wherever the distortion has an inverse; beyond it the result is finite, and projection does not return it.
    """
    return _undistort(image, k, _brown_radial, image)


def brown_limit(k: Array) -> float:
    return first_turning_point(np.array([3.0 * k[0], 5.0 * k[1], 7.0 * k[4]]))


# --- rational -------------------------------------------------------------------------------------


def _rational_parts(r2: Array, k: Array) -> tuple[Array, Array]:
    """Numerator and denominator (N,) of the radial factor."""
    k1, k2, _, _, k3, k4, k5, k6 = (k[..., i] for i in range(8))
    return 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3)), 1.0 + r2 * (k4 + r2 * (k5 + r2 * k6))


def _rational_radial(r2: Array, k: Array) -> tuple[Array, Array]:
    k1, k2, _, _, k3, k4, k5, k6 = (k[..., i] for i in range(8))
    above, below = _rational_parts(r2, k)
    above_rate, below_rate = k1 + r2 * (2.0 * k2 + 3.0 * r2 * k3), k4 + r2 * (2.0 * k5 + 3.0 * r2 * k6)
    factor = above / below
    return factor, (above_rate - factor * below_rate) / below


def rational_project(points: Array, k: Array, limit: Array) -> Array:
    return _distort(_inside(_slopes(points)[0], limit), k, _rational_radial)


def rational_derivatives(points: Array, k: Array, limit: Array) -> tuple[Array, Array, Array]:
    image, by_point, by_p1, by_p2, slopes = _derivatives(points, k, limit, _rational_radial)
    r2 = np.square(slopes).sum(axis=-1)
    above, below = _rational_parts(r2, k)
    up, down = slopes * (r2 / below)[..., None], -slopes * (r2 * above / below**2)[..., None]
    r2 = r2[..., None]
    by_k = [up, up * r2, by_p1, by_p2, up * r2**2, down, down * r2, down * r2**2]
    return image, by_point, np.stack(by_k, axis=-1)


def rational_rays(image: Array, k: Array, limit: Array) -> Array:
    """The inverse of the radial part alone starts Newton's method, which may have a long way to go here."""
    radius = np.linalg.norm(image, axis=-1)
    slope = inverse_of_rising(lambda r: _rational_curve(r, k), radius, _reach(radius, k, limit))
    slope = np.where(np.isfinite(slope), slope, np.broadcast_to(limit, slope.shape))  # decentring may bring it inside
    scale = np.where(radius > 0.0, slope / np.where(radius > 0.0, radius, 1.0), 1.0)
    slopes = _undistort(image, k, _rational_radial, image * scale[..., None])
    found = np.abs(_distort(slopes, k, _rational_radial) - image).max(axis=-1, keepdims=True) < 1e-9
    return pinhole_rays(np.where(found, _inside(slopes, limit), np.nan), k, limit)


def _rational_curve(slope: Array, k: Array) -> tuple[Array, Array]:
    """Image radius of a slope without decentring, and its derivative, both (N,)."""
    factor, by_r2 = _rational_radial(slope * slope, k)
    return slope * factor, factor + 2.0 * slope * slope * by_r2


def _reach(radius: Array, k: Array, limit: Array) -> Array:
    """A slope (N,) beyond that of an image radius, or the limit."""
    reach = np.maximum(1.0, radius)
    for _ in range(_DOUBLINGS):
        short = (_rational_curve(np.minimum(reach, limit), k)[0] < radius) & (reach < limit)
        if not short.any():
            break
        reach = np.where(short, 2.0 * reach, reach)
    return np.minimum(reach, limit)


def rational_limit(k: Array) -> float:
    """The first slope r at which r times the radial factor stops to rise, or at which its denominator vanishes."""
    above, below = np.array([1.0, k[0], k[1], k[4]]), np.array([1.0, k[5], k[6], k[7]])  # rising powers of r^2
    order = np.arange(4.0)
    crossed = np.convolve(order * above, below) - np.convolve(above, order * below)  # u (n' d - n d'), u = r^2
    rising = np.convolve(above, below) + 2.0 * crossed  # over d^2
    return min(first_turning_point(rising[1:]), _SHORT_OF_POLE * first_turning_point(below[1:]))
