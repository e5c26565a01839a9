"""Lenses: pixels <-> viewing directions, for pinhole, Brown and equidistant fisheye cameras.

Pixels follow the project's convention: the centre of the top-left pixel is (0.5, 0.5).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from georef.geometry import camera as pinhole
from georef.geometry.camera import Camera
from georef.geometry.rigid import Array

_NEWTON_STEPS = 12
_BEYOND_BORDER = 1.02  # of the largest ideal radius in the picture: what lies beyond may have been folded back by Brown


@dataclass(frozen=True)
class Fisheye:
    """Equidistant projection r = focal_px * theta * (1 + k1 theta^2 + ... + k4 theta^8), square pixels."""

    focal_px: float
    cx: float
    cy: float
    coefficients: tuple[float, ...] = ()
    half_view_rad: float = np.pi / 2

    def radius(self, theta: Array) -> Array:
        """Image radius in units of the focal length."""
        factor = np.ones_like(theta)
        for power, k in enumerate(self.coefficients, start=1):
            factor = factor + k * theta ** (2 * power)
        return theta * factor

    def theta(self, radius: Array) -> Array:
        """Angle from the optical axis, radians, of a radius in units of the focal length."""
        theta = radius.copy()
        for _ in range(_NEWTON_STEPS if self.coefficients else 0):
            rate = np.ones_like(theta)
            for power, k in enumerate(self.coefficients, start=1):
                rate = rate + (2 * power + 1) * k * theta ** (2 * power)
            theta = theta - (self.radius(theta) - radius) / np.maximum(rate, 0.05)
        return theta


@dataclass(frozen=True)
class Lens:
    """One camera's projection: exactly one of `camera` (pinhole, Brown) and `fisheye` is given."""

    name: str
    width: int
    height: int
    camera: Camera | None = None
    fisheye: Fisheye | None = None

    def __post_init__(self) -> None:
        assert (self.camera is None) != (self.fisheye is None), "a lens is a camera or a fisheye"

    @property
    def pixel_angle_rad(self) -> float:
        """Angle that one pixel spans at the optical axis."""
        return 1.0 / (self.camera.fx if self.camera else cast(Fisheye, self.fisheye).focal_px)

    def rays(self, pixels: ArrayLike) -> Array:
        """Unit viewing directions (N, 3) in the camera frame of observed pixels (N, 2)."""
        observed = np.asarray(pixels, dtype=np.float64)
        if self.camera is not None:
            rays = pinhole.rays_from_pixels(self.camera, observed)
            return rays / np.linalg.norm(rays, axis=-1, keepdims=True)
        fisheye = cast(Fisheye, self.fisheye)
        offset = (observed - [fisheye.cx, fisheye.cy]) / fisheye.focal_px
        radius = np.linalg.norm(offset, axis=-1)
        theta = fisheye.theta(radius)
        scale = np.where(radius > 0, np.sin(theta) / np.maximum(radius, 1e-300), 1.0)
        return np.concatenate([offset * scale[..., None], np.cos(theta)[..., None]], axis=-1)

    def project(self, points_in_cam: ArrayLike) -> Array:
        """Pixels (N, 2) of points (N, 3) in the camera frame; NaN where a point is not in the picture."""
        points = np.asarray(points_in_cam, dtype=np.float64)
        pixels = self._project_brown(points) if self.camera is not None else self._project_fisheye(points)
        with np.errstate(invalid="ignore"):
            inside = np.all((pixels >= 0) & (pixels <= [self.width, self.height]), axis=-1)
        return np.where(inside[..., None], pixels, np.nan)

    def _project_brown(self, points: Array) -> Array:
        camera = cast(Camera, self.camera)
        pixels = pinhole.project(camera, points)
        if not camera.distortion:
            return pixels
        with np.errstate(invalid="ignore", divide="ignore"):
            radius = np.linalg.norm(points[..., :2], axis=-1) / points[..., 2]
            return np.where((radius <= _largest_slope(self) * _BEYOND_BORDER)[..., None], pixels, np.nan)

    def _project_fisheye(self, points: Array) -> Array:
        fisheye = cast(Fisheye, self.fisheye)
        lateral = np.linalg.norm(points[..., :2], axis=-1)
        theta = np.arctan2(lateral, points[..., 2])
        scale = np.where(lateral > 0, fisheye.radius(theta) / np.maximum(lateral, 1e-300), 0.0)
        pixels = fisheye.focal_px * points[..., :2] * scale[..., None] + [fisheye.cx, fisheye.cy]
        return np.where((theta <= fisheye.half_view_rad)[..., None], pixels, np.nan)


@lru_cache(maxsize=8)
def ray_grid(lens: Lens) -> NDArray[np.float32]:
    """Viewing directions (H, W, 3) of all pixel centres in the camera frame, cached for each lens."""
    x, y = np.meshgrid(np.arange(lens.width) + 0.5, np.arange(lens.height) + 0.5)
    pixels = np.stack([x.ravel(), y.ravel()], axis=1)
    return lens.rays(pixels).astype(np.float32).reshape(lens.height, lens.width, 3)


@lru_cache(maxsize=64)
def _largest_slope(lens: Lens) -> float:
    """Largest distance of an ideal ray of the picture's border from the optical axis, at unit depth."""
    across, down = np.linspace(0, lens.width, 65), np.linspace(0, lens.height, 65)
    border = [(x, y) for x in across for y in (0, lens.height)] + [(x, y) for y in down for x in (0, lens.width)]
    rays = lens.rays(np.array(border, dtype=np.float64))
    return float((np.linalg.norm(rays[:, :2], axis=1) / rays[:, 2]).max())
