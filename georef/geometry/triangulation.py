"""Triangulation (forward intersection) of many points from posed views, with covariances.

Least squares on reprojection errors from a linear start; poses are taken as given, so the covariances hold for the
image noise alone. Hartley and Zisserman, "Multiple View Geometry" (2004), chapter 12.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from georef.geometry.projection import Views, linearize
from georef.geometry.rigid import Array

_ITERATIONS = 8
_HUBER = 2.0


@dataclass(frozen=True, eq=False)
class Triangulated:
    """P points; a point that could not be triangulated is NaN."""

    points: Array  # (P, 3) in world
    cov: Array  # (P, 3, 3) of the image noise alone
    residual_px: Array  # (n, 2) projected minus observed, in the order of the observations


def segment_sum(values: Array, index: NDArray[np.integer], count: int) -> Array:
    """Sums the rows of `values` (n, ...) that share an index (n,): (count, ...)."""
    flat = values.reshape(len(values), int(np.prod(values.shape[1:])))
    out = np.empty((count, flat.shape[1]))
    for column in range(flat.shape[1]):
        out[:, column] = np.bincount(index, weights=flat[:, column], minlength=count)
    return out.reshape(count, *values.shape[1:])


def triangulate(
    views: Views,
    point: NDArray[np.integer],
    view: NDArray[np.integer],
    pixel: Array,
    sigma_px: Array,
    count: int,
) -> Triangulated:
    """Triangulates `count` points from n observations: point and view index (n,), pixel (n, 2), sigma (n,).

    Points with fewer than two observations, or where a camera that sees them does not show them, are NaN.
    """
    points = _intersect_rays(views, point, view, pixel, count)
    for _ in range(_ITERATIONS - 1):
        normal, gradient, _ = _normal_equations(views, point, view, pixel, sigma_px, points)
        points = points - np.einsum("pij,pj->pi", _inverse(normal), gradient)
    normal, _, residual = _normal_equations(views, point, view, pixel, sigma_px, points)
    bad = np.bincount(point[~np.isfinite(residual).all(axis=1)], minlength=count) > 0
    points[bad | (np.bincount(point, minlength=count) < 2)] = np.nan
    return Triangulated(points, _inverse(normal), residual)


def _normal_equations(
    views: Views, point: NDArray[np.integer], view: NDArray[np.integer], pixel: Array, sigma_px: Array, points: Array
) -> tuple[Array, Array, Array]:
    """Normal matrices (P, 3, 3) and gradients (P, 3) with Huber weights, and the residuals (n, 2)."""
    lin = linearize(views, view, points[point])
    residual = lin.pixel - pixel
    distance = np.linalg.norm(residual, axis=1) / sigma_px
    weight = np.minimum(1.0, _HUBER / np.maximum(distance, 1e-12)) / np.square(sigma_px)
    by_point = np.nan_to_num(lin.by_point)
    weighted = by_point * weight[:, None, None]
    normal = segment_sum(np.einsum("nki,nkj->nij", weighted, by_point), point, len(points))
    gradient = segment_sum(np.einsum("nki,nk->ni", weighted, np.nan_to_num(residual)), point, len(points))
    return normal, gradient, residual


def _intersect_rays(
    views: Views, point: NDArray[np.integer], view: NDArray[np.integer], pixel: Array, count: int
) -> Array:
    """Points nearest to their rays: sum (I - d d^T) (x - c) = 0."""
    rays = views.rays(view, pixel)
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    normal = segment_sum(across, point, count)
    right = segment_sum(np.einsum("nij,nj->ni", across, views.centres[view]), point, count)
    return np.einsum("pij,pj->pi", _inverse(normal), right)


def _inverse(matrices: Array) -> Array:
    """Inverses of (P, 3, 3) symmetric matrices; NaN where one is singular to working precision."""
    scale = np.trace(matrices, axis1=1, axis2=2) / 3.0
    scale = np.where(scale > 0, scale, np.nan)
    scaled = np.nan_to_num(matrices / scale[:, None, None])
    singular = ~(np.abs(np.linalg.det(scaled)) > 1e-12)
    scaled[singular] = np.eye(3)
    out: Array = np.linalg.inv(scaled).astype(np.float64) / scale[:, None, None]
    out[singular] = np.nan
    return out
