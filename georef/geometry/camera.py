"""Camera models: pixels <-> rays.

`pinhole` has (fx, fy, cx, cy); `brown` adds (k1, k2, p1, p2), the model of COLMAP's OPENCV and gtsam's Cal3DS2.
Pixels are of the full-resolution image, the centre of the top-left pixel is (0.5, 0.5). Estimation works on ideal
pixels: distortion is taken out of an observation once, by `ideal_from_observed`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, cast

import numpy as np
from numpy.typing import ArrayLike

from georef.geometry.rigid import Array

CameraModel = Literal["pinhole", "brown"]
_UNDISTORT_ITERATIONS, _UNDISTORTED = 12, 1e-15
_SMALLEST_DETERMINANT, _LARGEST_STEP = 1e-3, 0.5  # of Newton's method


@dataclass(frozen=True)
class Camera:
    """Interior orientation, all in pixels of the full-resolution image; `distortion` is (k1, k2, p1, p2) or empty."""

    camera_id: str
    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()

    @property
    def model(self) -> CameraModel:
        return "brown" if self.distortion else "pinhole"

    @property
    def matrix(self) -> Array:
        """Calibration matrix K (3, 3)."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def half_view_angle_rad(self) -> float:
        """Largest angle between the optical axis and a ray through an image corner."""
        corners = np.array([[0, 0], [self.width, 0], [0, self.height], [self.width, self.height]], dtype=float)
        slopes = np.linalg.norm((corners - [self.cx, self.cy]) / [self.fx, self.fy], axis=1)
        return float(np.arctan(slopes.max()))


def project(camera: Camera, points_in_cam: ArrayLike) -> Array:
    """Observed pixels (N, 2) of points (N, 3) in the camera frame; NaN for points that are not in front of it."""
    points = np.asarray(points_in_cam, dtype=np.float64)
    depth = np.where(points[..., 2] > 0, points[..., 2], np.nan)
    slopes = points[..., :2] / depth[..., None]
    if camera.distortion:
        slopes = _distort(slopes, camera.distortion)
    return cast(Array, slopes * [camera.fx, camera.fy] + [camera.cx, camera.cy])


def ideal_from_observed(camera: Camera, pixels: ArrayLike) -> Array:
    """Distortion-free pixels (N, 2) of the same calibration matrix, from observed pixels (N, 2).

    Newton's method; to 1e-9 px wherever the distortion has an inverse. Beyond the radius at which a strong negative
    k1 folds the image back on itself it has none: the result there is finite, and `project` does not return the pixel.
    """
    observed = np.asarray(pixels, dtype=np.float64)
    if not camera.distortion:
        return observed
    centre, focal = np.array([camera.cx, camera.cy]), np.array([camera.fx, camera.fy])
    distorted = (observed - centre) / focal
    slopes = distorted.copy()
    for _ in range(_UNDISTORT_ITERATIONS):
        error = _distort(slopes, camera.distortion) - distorted
        if np.abs(error).max(initial=0.0) < _UNDISTORTED:
            break
        slopes = slopes - _newton_step(slopes, error, camera.distortion)
    return slopes * focal + centre


def rays_from_ideal(camera: Camera, ideal_px: ArrayLike) -> Array:
    """Unit viewing directions (N, 3) in the camera frame of distortion-free pixels (N, 2)."""
    pixels = np.asarray(ideal_px, dtype=np.float64)
    slopes = (pixels - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    rays = np.concatenate([slopes, np.ones((*slopes.shape[:-1], 1))], axis=-1)
    return rays / np.linalg.norm(rays, axis=-1, keepdims=True)


def _distort(slopes: Array, distortion: tuple[float, ...]) -> Array:
    k1, k2, p1, p2 = distortion
    x, y = slopes[..., 0], slopes[..., 1]
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + k2 * r2)
    return np.stack(
        [
            x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
            y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
        ],
        axis=-1,
    )


def _newton_step(slopes: Array, error: Array, distortion: tuple[float, ...]) -> Array:
    """Change of slopes (N, 2) that removes an error (N, 2) of the distorted slopes; bounded, so as to stay finite."""
    k1, k2, p1, p2 = distortion
    x, y = slopes[..., 0], slopes[..., 1]
    r2 = x * x + y * y
    radial, radial_rate = 1.0 + r2 * (k1 + k2 * r2), 2.0 * (k1 + 2.0 * k2 * r2)
    xx = radial + radial_rate * x * x + 2.0 * p1 * y + 6.0 * p2 * x
    xy = radial_rate * x * y + 2.0 * p1 * x + 2.0 * p2 * y  # the derivative is symmetric
    yy = radial + radial_rate * y * y + 6.0 * p1 * y + 2.0 * p2 * x
    determinant = np.maximum(xx * yy - xy * xy, _SMALLEST_DETERMINANT)
    step = np.stack([yy * error[..., 0] - xy * error[..., 1], xx * error[..., 1] - xy * error[..., 0]], axis=-1)
    return np.clip(step / determinant[..., None], -_LARGEST_STEP, _LARGEST_STEP)
