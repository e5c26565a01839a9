"""The mathematics of camera models: points in the camera frame <-> image coordinates at unit focal length.

All functions take N points or image coordinates with one row of coefficients each, (N, 5) or (1, 5), and the limit of
the model, (N,) or (1,), up to which it has an inverse. Outside of it results are NaN.

pinhole: m = (x/z, y/z). brown: the same times 1 + k1 r^2 + k2 r^4 + k3 r^6, and decentring p1, p2 (Brown 1966; COLMAP's
OPENCV, gtsam's Cal3DS2); coefficients k1, k2, p1, p2, k3. fisheye: equidistant, r = t + k1 t^3 + k2 t^5 + k3 t^7 +
k4 t^9 of the angle t from the optical axis, rays beyond 90 degrees included (Kannala and Brandt 2006; OPENCV_FISHEYE,
Cal3Fisheye); coefficients k1, k2, k3, k4, 0.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from georef.geometry.rigid import Array

COEFFICIENTS = 5
_UNDISTORT_ITERATIONS, _UNDISTORTED = 12, 1e-15
_SMALLEST_DETERMINANT, _LARGEST_STEP = 1e-3, 0.5  # of Newton's method
_BISECTIONS, _ON_AXIS = 60, 1e-9
_NEGLIGIBLE = 1e-12  # coefficients that bend nothing, and would overflow where roots are looked for
_WIDEST_RAD = float(np.pi - 1e-3)  # straight behind, a direction has no single pixel


@dataclass(frozen=True)
class LensModel:
    """One camera model. `parameters` names the coefficients in the order of `Camera.distortion`."""

    parameters: tuple[str, ...]
    project: Callable[[Array, Array, Array], Array]  # points (N, 3), coefficients, limit -> m (N, 2)
    derivatives: Callable[[Array, Array, Array], tuple[Array, Array, Array]]  # -> m, by point (N, 2, 3), by k (N, 2, 5)
    rays: Callable[[Array, Array, Array], Array]  # m (N, 2), coefficients, limit -> directions (N, 3), z = 1 or unit
    limit: Callable[[Array], float]  # coefficients (5,) -> the largest slope or angle


def first_turning_point(rate: Array) -> float:
    """Smallest positive x at which 1 + rate[0] x^2 + rate[1] x^4 + ... is zero; infinite where it is nowhere."""
    rate = np.where(np.abs(rate) > _NEGLIGIBLE, rate, 0.0)
    roots = np.roots([*rate[::-1], 1.0]) if np.any(rate) else np.zeros(0)
    real = roots.real[(np.abs(roots.imag) < 1e-9 * np.maximum(1.0, np.abs(roots.real))) & (roots.real > 0)]
    return float(np.sqrt(real.min())) if len(real) else np.inf


# --- pinhole --------------------------------------------------------------------------------------


def _slopes(points: Array) -> tuple[Array, Array]:
    """x/z, y/z (N, 2) and depths (N,); NaN for points that are not in front."""
    depth = np.where(points[..., 2] > 0, points[..., 2], np.nan)
    return points[..., :2] / depth[..., None], depth


def _slope_derivatives(points: Array, depth: Array) -> Array:
    by_point = np.zeros((*points.shape[:-1], 2, 3))
    by_point[..., 0, 0] = by_point[..., 1, 1] = 1.0 / depth
    by_point[..., 2] = -points[..., :2] / (depth * depth)[..., None]
    return by_point


def _pinhole_project(points: Array, _k: Array, _limit: Array) -> Array:
    return _slopes(points)[0]


def _pinhole_derivatives(points: Array, _k: Array, _limit: Array) -> tuple[Array, Array, Array]:
    slopes, depth = _slopes(points)
    return slopes, _slope_derivatives(points, depth), np.zeros((*points.shape[:-1], 2, COEFFICIENTS))


def _pinhole_rays(image: Array, _k: Array, _limit: Array) -> Array:
    return np.concatenate([image, np.ones((*image.shape[:-1], 1))], axis=-1)


# --- brown ----------------------------------------------------------------------------------------


def distort(slopes: Array, k: Array) -> Array:
    """Brown's distortion of slopes (N, 2)."""
    x, y = slopes[..., 0], slopes[..., 1]
    p1, p2 = k[..., 2], k[..., 3]
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k[..., 0] + r2 * (k[..., 1] + r2 * k[..., 4]))
    return np.stack(
        [
            x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
            y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
        ],
        axis=-1,
    )


def _distort_rate(slopes: Array, k: Array) -> tuple[Array, Array, Array]:
    """Derivative of `distort` by the slopes, which is symmetric: xx, xy, yy, each (N,)."""
    x, y = slopes[..., 0], slopes[..., 1]
    k1, k2, p1, p2, k3 = (k[..., i] for i in range(COEFFICIENTS))
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    radial_rate = 2.0 * (k1 + r2 * (2.0 * k2 + 3.0 * r2 * k3))
    xx = radial + radial_rate * x * x + 2.0 * p1 * y + 6.0 * p2 * x
    xy = radial_rate * x * y + 2.0 * p1 * x + 2.0 * p2 * y
    yy = radial + radial_rate * y * y + 6.0 * p1 * y + 2.0 * p2 * x
    return xx, xy, yy


def _brown_project(points: Array, k: Array, limit: Array) -> Array:
    return distort(_inside(_slopes(points)[0], limit), k)


def _brown_derivatives(points: Array, k: Array, limit: Array) -> tuple[Array, Array, Array]:
    slopes, depth = _slopes(points)
    slopes = _inside(slopes, limit)
    xx, xy, yy = _distort_rate(slopes, k)
    by_slope = np.stack([np.stack([xx, xy], axis=-1), np.stack([xy, yy], axis=-1)], axis=-2)
    x, y = slopes[..., 0], slopes[..., 1]
    r2 = (x * x + y * y)[..., None]
    by_k = np.stack(
        [
            slopes * r2,
            slopes * r2**2,
            np.stack([2.0 * x * y, r2[..., 0] + 2.0 * y * y], axis=-1),
            np.stack([r2[..., 0] + 2.0 * x * x, 2.0 * x * y], axis=-1),
            slopes * r2**3,
        ],
        axis=-1,
    )
    return distort(slopes, k), by_slope @ _slope_derivatives(points, depth), by_k


def _brown_rays(image: Array, k: Array, limit: Array) -> Array:
    return _pinhole_rays(_inside(undistort(image, k), limit), k, limit)


def undistort(image: Array, k: Array) -> Array:
    """The slopes (N, 2) that are distorted to image coordinates (N, 2), by Newton's method.

    Exact wherever the distortion has an inverse; beyond it the result is finite, and `distort` does not return it.
    """
    slopes = image.copy()
    for _ in range(_UNDISTORT_ITERATIONS):
        error = distort(slopes, k) - image
        if np.abs(np.nan_to_num(error)).max(initial=0.0) < _UNDISTORTED:
            break
        xx, xy, yy = _distort_rate(slopes, k)
        determinant = np.maximum(xx * yy - xy * xy, _SMALLEST_DETERMINANT)
        step = np.stack([yy * error[..., 0] - xy * error[..., 1], xx * error[..., 1] - xy * error[..., 0]], axis=-1)
        slopes = slopes - np.clip(step / determinant[..., None], -_LARGEST_STEP, _LARGEST_STEP)
    return slopes


def _inside(slopes: Array, limit: Array) -> Array:
    """The slopes, NaN beyond the radius at which the distortion folds the image back on itself."""
    with np.errstate(invalid="ignore"):
        return np.where((np.square(slopes).sum(axis=-1) <= limit * limit)[..., None], slopes, np.nan)


def _brown_limit(k: Array) -> float:
    return first_turning_point(np.array([3.0 * k[0], 5.0 * k[1], 7.0 * k[4]]))


# --- fisheye --------------------------------------------------------------------------------------


def _fisheye_radius(angle: Array, k: Array) -> tuple[Array, Array]:
    """Image radius and its derivative by the angle, both (N,)."""
    t2 = angle * angle
    k1, k2, k3, k4 = (k[..., i] for i in range(4))
    radius = angle * (1.0 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))
    rate = 1.0 + t2 * (3.0 * k1 + t2 * (5.0 * k2 + t2 * (7.0 * k3 + t2 * 9.0 * k4)))
    return radius, rate


def _fisheye_polar(points: Array, limit: Array) -> tuple[Array, Array, Array]:
    """Angle from the axis (N,), NaN beyond the limit; distance from the axis (N,); direction across it (N, 2)."""
    across = np.linalg.norm(points[..., :2], axis=-1)
    angle = np.arctan2(across, points[..., 2])
    with np.errstate(invalid="ignore"):
        angle = np.where((angle <= limit) & ((across > 0) | (points[..., 2] > 0)), angle, np.nan)
    on_axis = across <= _ON_AXIS * np.abs(points[..., 2])
    direction = np.where(on_axis[..., None], [1.0, 0.0], points[..., :2] / np.where(on_axis, 1.0, across)[..., None])
    return angle, across, direction


def _fisheye_project(points: Array, k: Array, limit: Array) -> Array:
    angle, across, direction = _fisheye_polar(points, limit)
    radius, _ = _fisheye_radius(angle, k)
    on_axis = (across <= _ON_AXIS * np.abs(points[..., 2]))[..., None]
    safe_depth = np.where(points[..., 2] > 0, points[..., 2], np.nan)
    return np.where(on_axis, points[..., :2] / safe_depth[..., None], radius[..., None] * direction)


def _fisheye_derivatives(points: Array, k: Array, limit: Array) -> tuple[Array, Array, Array]:
    angle, across, e = _fisheye_polar(points, limit)
    radius, rate = _fisheye_radius(angle, k)
    depth = points[..., 2]
    squared = across * across + depth * depth
    on_axis = across <= _ON_AXIS * np.abs(depth)
    sideways = np.where(on_axis, 1.0 / np.where(on_axis, depth, 1.0), radius / np.where(on_axis, 1.0, across))
    outward = rate * depth / squared
    along = e[..., :, None] * e[..., None, :]
    by_point = np.empty((*points.shape[:-1], 2, 3))
    by_point[..., :2] = outward[..., None, None] * along + sideways[..., None, None] * (np.eye(2) - along)
    by_point[..., 2] = -(rate * across / squared)[..., None] * e
    powers = np.stack([angle**3, angle**5, angle**7, angle**9, np.zeros_like(angle)], axis=-1)
    return _fisheye_project(points, k, limit), by_point, e[..., :, None] * powers[..., None, :]


def _fisheye_rays(image: Array, k: Array, limit: Array) -> Array:
    radius = np.linalg.norm(image, axis=-1)
    angle = _fisheye_angle(radius, np.broadcast_to(k, (*radius.shape, COEFFICIENTS)), limit)
    small = radius < 1e-8
    scale = np.where(small, 1.0, np.sin(angle) / np.where(small, 1.0, radius))
    return np.concatenate([image * scale[..., None], np.cos(angle)[..., None]], axis=-1)


def _fisheye_angle(radius: Array, k: Array, limit: Array) -> Array:
    """The angle (N,) of image radii (N,): Newton's method, bisecting where a step leaves the bracket."""
    low, high = np.zeros_like(radius), np.broadcast_to(limit, radius.shape).astype(np.float64).copy()
    farthest, _ = _fisheye_radius(high, k)
    angle = np.minimum(radius, high)
    for _ in range(_BISECTIONS):
        value, rate = _fisheye_radius(angle, k)
        error = value - radius
        if np.abs(np.where(radius <= farthest, error, 0.0)).max(initial=0.0) < _UNDISTORTED:
            break
        low, high = np.where(error < 0, angle, low), np.where(error > 0, angle, high)
        with np.errstate(divide="ignore", invalid="ignore"):
            newton = angle - error / rate
        inside = (newton >= low) & (newton <= high)
        angle = np.where(error == 0, angle, np.where(inside, newton, 0.5 * (low + high)))
    return np.where(radius <= farthest, angle, np.nan)


def _fisheye_limit(k: Array) -> float:
    return min(first_turning_point(np.array([3.0, 5.0, 7.0, 9.0]) * k[:4]), _WIDEST_RAD)


MODELS: dict[str, LensModel] = {
    "pinhole": LensModel((), _pinhole_project, _pinhole_derivatives, _pinhole_rays, lambda _: np.inf),
    "brown": LensModel(("k1", "k2", "p1", "p2", "k3"), _brown_project, _brown_derivatives, _brown_rays, _brown_limit),
    "fisheye": LensModel(
        ("k1", "k2", "k3", "k4"), _fisheye_project, _fisheye_derivatives, _fisheye_rays, _fisheye_limit
    ),
}
