"""Two calibrations of one camera: where they see the same directions, and what of it poses can make up for."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from georef.geometry.camera import Camera, project, rays_from_pixels
from georef.geometry.rigid import Array

_GRID = 25


@dataclass(frozen=True)
class CalibrationDifference:
    """Root mean square and largest difference over the image, px: as it is, and after the best turn of the camera and
    change of scale, which poses and the focal length can make up for."""

    rms_px: float
    largest_px: float
    rms_shape_px: float
    largest_shape_px: float


def difference_map(camera: Camera, other: Camera, grid: int = _GRID) -> tuple[Array, Array]:
    """Pixels (n, 2) of a grid over the image that `other` sees, and what `camera` differs by there (n, 2), px.

    The best turn of the camera and change of scale are taken off.
    """
    pixels, rays, difference = _differences(camera, other, grid)
    return pixels, _without_turn_and_scale(difference, rays)


def compare_calibrations(camera: Camera, other: Camera) -> CalibrationDifference:
    """Pixels of `camera` less those of `other` for the directions that `other` gives to a grid of pixels."""
    _, rays, difference = _differences(camera, other, _GRID)
    rest = _without_turn_and_scale(difference, rays)
    return CalibrationDifference(*_sizes(difference), *_sizes(rest))


def _differences(camera: Camera, other: Camera, grid: int) -> tuple[Array, Array, Array]:
    """Pixels (n, 2) of a grid, their rays (n, 3) by `other`, and the pixels of `camera` there less them (n, 2)."""
    across, down = np.meshgrid(np.linspace(0, other.width, grid), np.linspace(0, other.height, grid))
    pixels = np.stack([across.ravel(), down.ravel()], axis=1)
    rays = rays_from_pixels(other, pixels)
    difference = project(camera, rays) - pixels
    seen = np.isfinite(difference).all(axis=1)
    return pixels[seen], rays[seen], difference[seen]


def _without_turn_and_scale(difference: Array, rays: Array) -> Array:
    """Residuals (n, 2) after small rotations about the three axes and a factor, by least squares."""
    x, y = (rays[:, :2] / rays[:, 2:]).T
    one = np.ones_like(x)
    by_x = np.stack([x * y, -(one + x * x), y, x], axis=1)  # rotations about x, y, z; scale
    by_y = np.stack([one + y * y, -x * y, -x, y], axis=1)
    design = np.concatenate([by_x, by_y])
    values = np.concatenate([difference[:, 0], difference[:, 1]])
    fitted = design @ np.linalg.lstsq(design, values, rcond=None)[0]
    return difference - fitted.reshape(2, -1).T


def _sizes(difference: Array) -> tuple[float, float]:
    """Root mean square and maximum of the lengths."""
    length = np.linalg.norm(difference, axis=1)
    return float(np.sqrt(np.mean(np.square(length)))), float(length.max(initial=0.0))
