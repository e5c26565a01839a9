"""The equidistant fisheye, rays beyond 90 degrees from the axis included."""

from __future__ import annotations

import numpy as np

from georef.geometry.lens_curves import first_turning_point, inverse_of_rising
from georef.geometry.rigid import Array

_ON_AXIS = 1e-9
_WIDEST_RAD = float(np.pi - 1e-3)  # straight behind, a direction has no single pixel


def _radius(angle: Array, k: Array) -> tuple[Array, Array]:
    """Image radius and its derivative by the angle, both (N,)."""
    t2 = angle * angle
    k1, k2, k3, k4 = (k[..., i] for i in range(4))
    radius = angle * (1.0 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))
    rate = 1.0 + t2 * (3.0 * k1 + t2 * (5.0 * k2 + t2 * (7.0 * k3 + t2 * 9.0 * k4)))
    return radius, rate


def _polar(points: Array, limit: Array) -> tuple[Array, Array, Array]:
    """Angle from the axis (N,), NaN beyond the limit; distance from the axis (N,); direction across it (N, 2)."""
    across = np.linalg.norm(points[..., :2], axis=-1)
    angle = np.arctan2(across, points[..., 2])
    with np.errstate(invalid="ignore"):
        angle = np.where((angle <= limit) & ((across > 0) | (points[..., 2] > 0)), angle, np.nan)
    on_axis = across <= _ON_AXIS * np.abs(points[..., 2])
    direction = np.where(on_axis[..., None], [1.0, 0.0], points[..., :2] / np.where(on_axis, 1.0, across)[..., None])
    return angle, across, direction


def fisheye_project(points: Array, k: Array, limit: Array) -> Array:
    angle, across, direction = _polar(points, limit)
    radius, _ = _radius(angle, k)
    on_axis = (across <= _ON_AXIS * np.abs(points[..., 2]))[..., None]
    safe_depth = np.where(points[..., 2] > 0, points[..., 2], np.nan)
    return np.where(on_axis, points[..., :2] / safe_depth[..., None], radius[..., None] * direction)


def fisheye_derivatives(points: Array, k: Array, limit: Array) -> tuple[Array, Array, Array]:
    angle, across, e = _polar(points, limit)
    radius, rate = _radius(angle, k)
    depth = points[..., 2]
    squared = across * across + depth * depth
    on_axis = across <= _ON_AXIS * np.abs(depth)
    sideways = np.where(on_axis, 1.0 / np.where(on_axis, depth, 1.0), radius / np.where(on_axis, 1.0, across))
    outward = rate * depth / squared
    along = e[..., :, None] * e[..., None, :]
    by_point = np.empty((*points.shape[:-1], 2, 3))
    by_point[..., :2] = outward[..., None, None] * along + sideways[..., None, None] * (np.eye(2) - along)
    by_point[..., 2] = -(rate * across / squared)[..., None] * e
    powers = np.stack([angle**3, angle**5, angle**7, angle**9], axis=-1)
    return fisheye_project(points, k, limit), by_point, e[..., :, None] * powers[..., None, :]


def fisheye_rays(image: Array, k: Array, limit: Array) -> Array:
    radius = np.linalg.norm(image, axis=-1)
    angle = inverse_of_rising(lambda angle: _radius(angle, k), radius, limit)
    small = radius < 1e-8
    scale = np.where(small, 1.0, np.sin(angle) / np.where(small, 1.0, radius))
    return np.concatenate([image * scale[..., None], np.cos(angle)[..., None]], axis=-1)


def fisheye_limit(k: Array) -> float:
    return min(first_turning_point(np.array([3.0, 5.0, 7.0, 9.0]) * k[:4]), _WIDEST_RAD)
