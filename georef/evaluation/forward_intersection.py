"""Forward intersection of check points from adjusted poses, with the derivatives that error propagation needs.

Plain least squares on the marks, weighted by their stated sigmas and without a robust loss: a check point is judged as
it was measured. Rows are whitened, so that a mark of the stated sigma has unit covariance. Hartley and Zisserman,
"Multiple View Geometry" (2004), sections 5.2 and 12.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import cast

import numpy as np
from numpy.typing import NDArray

from georef.geometry.camera import Camera
from georef.geometry.projection import Views, linearize
from georef.geometry.rigid import Array, Rigid3
from georef.geometry.triangulation import triangulate
from georef.types.constraints import CheckPoint

JointPoseCov = Callable[[list[int]], Array]
"""Joint covariance (6k, 6k) of the poses with k indices, in their order: (rad, m), right perturbations."""

_ITERATIONS, _CONVERGED = 20, 1e-6


@dataclass(frozen=True, eq=False)
class PosedImages:
    """The adjusted images that check points are intersected from; images without a pose are not among them."""

    image_ids: tuple[str, ...]
    cameras: tuple[Camera, ...]
    world_from_cams: tuple[Rigid3, ...]
    joint_cov: JointPoseCov | None = None  # None: unknown, and so is then the uncertainty of what is intersected

    def __post_init__(self) -> None:
        if not len(self.image_ids) == len(self.cameras) == len(self.world_from_cams):
            raise ValueError("images, cameras and poses must be equally many")
        if len(set(self.image_ids)) != len(self.image_ids):
            raise ValueError("an image has two poses")

    @cached_property
    def index(self) -> Mapping[str, int]:
        """Position of an image id in `image_ids`."""
        return {name: i for i, name in enumerate(self.image_ids)}

    @cached_property
    def views(self) -> Views:
        return Views.of(self.world_from_cams, self.cameras)


@dataclass(frozen=True, eq=False)
class Intersection:
    """A point from m marks in k images, for the stated sigmas of the marks."""

    point: Array  # (3,) in world
    images: list[int]  # k indices of the images
    residual_px: Array  # (m, 2) projected minus measured, observed pixels
    whitened: Array  # (2m,) the residuals in units of their sigmas
    by_point: Array  # (2m, 3) whitened
    by_poses: Array  # (2m, 6k) whitened; right perturbations of world_from_cam, (rad, m)

    @cached_property
    def mark_cov(self) -> Array:
        """Covariance (3, 3) of the point from the noise of the marks alone, m^2."""
        return cast(Array, np.linalg.inv(self.by_point.T @ self.by_point))

    @cached_property
    def point_by_poses(self) -> Array:
        """Derivative (3, 6k) of the intersected point by the poses: -N^-1 A' W B (implicit function theorem)."""
        return -self.mark_cov @ self.by_point.T @ self.by_poses


def images_of(intersections: Sequence[Intersection]) -> list[int]:
    """Sorted indices of all images that take part in intersections."""
    return sorted({index for found in intersections for index in found.images})


def spread(by_poses: Array, images: Sequence[int], every: Sequence[int]) -> Array:
    """Derivatives (r, 6k) by the poses of k images as ones (r, 6M) by those of M `every` images, zero elsewhere."""
    out = np.zeros((len(by_poses), 6 * len(every)))
    for k, index in enumerate(images):
        column = 6 * every.index(index)
        out[:, column : column + 6] = by_poses[:, 6 * k : 6 * k + 6]
    return out


def points_cov_from_poses(intersections: Sequence[Intersection], joint_cov: JointPoseCov) -> Array:
    """Joint covariance (3P, 3P), m^2, of P intersected points from the errors of the poses alone."""
    if not intersections:
        return np.zeros((0, 0))
    every = images_of(intersections)
    by_poses = np.vstack([spread(found.point_by_poses, found.images, every) for found in intersections])
    return by_poses @ joint_cov(every) @ by_poses.T


def intersect(point: CheckPoint, images: PosedImages) -> Intersection | str:
    """The point from its marks in posed images, or the reason why they do not determine it."""
    marks = [mark for mark in point.marks if mark.image_id in images.index]
    view = np.array([images.index[mark.image_id] for mark in marks], dtype=np.int64)
    seen_in = sorted({int(i) for i in view})
    if len(seen_in) < 2:
        return f"{len(marks)} of {len(point.marks)} marks lie in images with a pose, in {len(seen_in)} image(s)"
    pixel = np.array([mark.pixel for mark in marks], dtype=np.float64)
    sigma_px = np.array([mark.sigma_px for mark in marks])
    start = triangulate(images.views, np.zeros(len(marks), np.int64), view, pixel, sigma_px, 1).points[0]
    solved = _solve(images.views, view, pixel, sigma_px, start) if np.isfinite(start).all() else None
    if solved is None:
        return "the rays of its marks do not intersect in front of all its images"
    position, residual, by_point, by_pose = solved
    by_poses = np.zeros((2 * len(marks), 6 * len(seen_in)))
    for row, index in enumerate(view):
        column = 6 * seen_in.index(int(index))
        by_poses[2 * row : 2 * row + 2, column : column + 6] = by_pose[row]
    residual_px = residual.reshape(-1, 2) * sigma_px[:, None]
    return Intersection(position, seen_in, residual_px, residual, by_point, by_poses)


def _solve(
    views: Views, view: NDArray[np.int64], pixel: Array, sigma_px: Array, start: Array
) -> tuple[Array, Array, Array, Array] | None:
    """Gauss-Newton: point (3,), whitened residuals (2m,), derivatives (2m, 3) and (m, 2, 6); None: not determined."""
    point, whitener = start, 1.0 / sigma_px[:, None]
    for _ in range(_ITERATIONS):
        lin = linearize(views, view, np.tile(point, (len(view), 1)))
        if not np.isfinite(lin.pixel).all():
            return None
        residual = (whitener * (lin.pixel - pixel)).ravel()
        by_point = (whitener[:, None] * lin.by_point).reshape(-1, 3)
        step, _, rank, _ = np.linalg.lstsq(by_point, -residual, rcond=1e-9)
        if rank < 3:
            return None
        # Measured in sigmas of the residuals, so that a far point is not asked for digits that its marks do not hold.
        if np.linalg.norm(by_point @ step) < _CONVERGED:
            return point, residual, by_point, whitener[:, None] * lin.by_pose
        point = point + step
    return None
