"""Camera models: pixels <-> rays.

`pinhole` has (fx, fy, cx, cy); `brown` adds (k1, k2, p1, p2[, k3]), the model of COLMAP's OPENCV and gtsam's Cal3DS2;
`rational` adds (k1, k2, p1, p2, k3, k4, k5, k6), FULL_OPENCV; `fisheye` is equidistant with (k1, k2, k3, k4),
OPENCV_FISHEYE and Cal3Fisheye, to beyond 90 degrees from the axis.
Pixels are of the full-resolution image, the centre of the top-left pixel is (0.5, 0.5). Estimation works on pixels as
they were observed: their noise is the same in all directions there, and only there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal, cast

import numpy as np
from numpy.typing import ArrayLike

from georef.geometry.lens_slopes import undistort
from georef.geometry.lenses import COEFFICIENTS, MODELS, LensModel
from georef.geometry.rigid import Array

CameraModel = Literal["pinhole", "brown", "fisheye", "rational"]
PLAIN = ("focal", "cx", "cy", "aspect")
ESTIMABLE = ("focal", "k1", "k2", "cx", "cy", "aspect", "p1", "p2", "k3", "k4", "k5", "k6")
"""What can be estimated of a camera together with a pose, all without unit: steps of focal are those of the logarithm
of a factor on fx and fy, of aspect on fy alone, steps of cx and cy are in units of fx. PLAIN ones all cameras have,
coefficients those whose model has them."""


@dataclass(frozen=True)
class Camera:
    """Interior orientation, all in pixels of the full-resolution image.

    distortion: the coefficients of the model, (k1, k2, p1, p2) or (k1, k2, p1, p2, k3) of brown, (k1, k2, k3, k4) of
    fisheye, (k1, k2, p1, p2, k3, k4, k5, k6) of rational; missing ones are zero. A model that is not named follows
    from what is given or estimated: brown with coefficients, pinhole without.
    estimate: which of ESTIMABLE are not known; their values here are where the estimation starts.
    """

    camera_id: str
    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()
    model: CameraModel = "pinhole"
    estimate: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        has_distortion = self.distortion or set(self.estimate) & set(MODELS["brown"].parameters)
        if self.model == "pinhole" and has_distortion:
            object.__setattr__(self, "model", "brown")
        if self.model not in MODELS or len(self.distortion) > len(MODELS[self.model].parameters):
            raise ValueError(f"camera {self.camera_id!r}: {self.model} has no {len(self.distortion)} coefficients")
        if set(self.estimate) - set(ESTIMABLE):
            raise ValueError(f"camera {self.camera_id!r}: only {', '.join(ESTIMABLE)} can be estimated")
        foreign = [name for name in self.estimate if name not in (*PLAIN, *self.lens.parameters)]
        if foreign:
            raise ValueError(f"camera {self.camera_id!r}: {self.model} has no {foreign[0]} to be estimated")

    @property
    def lens(self) -> LensModel:
        return MODELS[self.model]

    @property
    def coefficients(self) -> Array:
        """The coefficients (8,) of the model, zeros where there are fewer."""
        return np.array([*self.distortion, *[0.0] * (COEFFICIENTS - len(self.distortion))])

    @cached_property
    def limit(self) -> float:
        """Up to where the model has an inverse: the angle from the axis of a fisheye, of the others its tangent."""
        return self.lens.limit(self.coefficients)

    @cached_property
    def parameters(self) -> Array:
        """All of them in one row (13,): fx, fy, cx, cy, eight coefficients, limit."""
        return np.array([self.fx, self.fy, self.cx, self.cy, *self.coefficients, self.limit])

    @property
    def matrix(self) -> Array:
        """Calibration matrix K (3, 3)."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def half_view_angle_rad(self) -> float:
        """Largest angle between the optical axis and a ray through the image's border."""
        across, down = np.linspace(0, self.width, 33), np.linspace(0, self.height, 33)
        border = np.array(
            [(x, y) for x in across for y in (0, self.height)] + [(x, y) for y in down for x in (0, self.width)]
        )
        rays = rays_from_pixels(self, border)
        if not np.isfinite(rays).all():  # the picture's corners lie beyond what the lens shows
            return self.limit if self.model == "fisheye" else float(np.arctan(self.limit))
        return float(np.arctan2(np.linalg.norm(rays[:, :2], axis=1), rays[:, 2]).max())

    def value(self, name: str) -> float:
        """The value of one of ESTIMABLE; focal is fx in pixels, aspect fy / fx."""
        plain = {"focal": self.fx, "cx": self.cx, "cy": self.cy, "aspect": self.fy / self.fx}
        return plain[name] if name in plain else float(self.coefficients[self.lens.parameters.index(name)])

    def unit(self, name: str) -> float:
        """What a step of one of ESTIMABLE changes its value by."""
        return {"focal": self.fx, "cx": self.fx, "cy": self.fx, "aspect": self.fy / self.fx}.get(name, 1.0)

    def changed(self, names: Sequence[str], step: ArrayLike) -> Camera:
        """The camera with a step (q,) added to the named ones of ESTIMABLE."""
        steps = dict(zip(names, (float(v) for v in np.asarray(step, dtype=np.float64)), strict=True))
        factor, stretch = (float(np.exp(steps.pop(name, 0.0))) for name in ("focal", "aspect"))
        cx, cy = self.cx + self.fx * steps.pop("cx", 0.0), self.cy + self.fx * steps.pop("cy", 0.0)
        coefficients, count = self.coefficients, max(len(self.distortion), 4 if steps else 0)
        for name, change in steps.items():
            index = self.lens.parameters.index(name)
            coefficients[index] += change
            count = max(count, index + 1)
        distortion = tuple(float(v) for v in coefficients[:count])
        return replace(self, fx=self.fx * factor, fy=self.fy * factor * stretch, cx=cx, cy=cy, distortion=distortion)

    def steps_since(self, given: Camera, names: Sequence[str]) -> Array:
        """The steps (q,) of the named ones of ESTIMABLE that lead from a given camera to this one: the inverse of
        `given.changed`."""
        out = np.empty(len(names))
        for i, name in enumerate(names):
            if name in ("focal", "aspect"):
                out[i] = np.log(self.value(name) / given.value(name))
            else:
                out[i] = (self.value(name) - given.value(name)) / given.unit(name)
        return out


def project(camera: Camera, points_in_cam: ArrayLike) -> Array:
    """Observed pixels (N, 2) of points (N, 3) in the camera frame; NaN for points that the lens does not show.

    Those are points that are not in front (not of a fisheye), and directions beyond the one at which the distortion
    folds the image back on itself.
    """
    points = np.asarray(points_in_cam, dtype=np.float64)
    image = camera.lens.project(points, camera.coefficients, np.asarray(camera.limit))
    return cast(Array, image * [camera.fx, camera.fy] + [camera.cx, camera.cy])


def rays_from_pixels(camera: Camera, pixels: ArrayLike) -> Array:
    """Viewing directions (N, 3) in the camera frame of observed pixels (N, 2), to 1e-9 px; NaN where there is none.

    Scaled to unit length of fisheye cameras, to z = 1 of all others.
    """
    image = (np.asarray(pixels, dtype=np.float64) - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    return camera.lens.rays(image, camera.coefficients, np.asarray(camera.limit))


def ray_derivatives(camera: Camera, rays: Array) -> Array:
    """Derivatives (N, 3, 2) of `rays_from_pixels` by the pixel, at the rays (N, 3) that it gave."""
    _, by_point, _ = camera.lens.derivatives(rays, camera.coefficients, np.asarray(camera.limit))
    by_point = by_point * np.array([camera.fx, camera.fy])[:, None]
    if camera.model != "fisheye":  # z = 1: the inverse of the derivative by slopes
        by_pixel = np.zeros((len(rays), 3, 2))
        by_pixel[:, :2] = _inverse_2x2(by_point[:, :, :2])
        return by_pixel
    transposed = np.swapaxes(by_point, 1, 2)  # a unit ray moves across itself, which is the range of this
    return transposed @ _inverse_2x2(by_point @ transposed)


def intrinsic_derivatives(camera: Camera, points_in_cam: Array, names: Sequence[str]) -> Array:
    """Derivatives (N, 2, q) of the pixels of points (N, 3) by q named ones of ESTIMABLE."""
    image, _, by_coefficient = camera.lens.derivatives(points_in_cam, camera.coefficients, np.asarray(camera.limit))
    focal = np.array([camera.fx, camera.fy])
    plain = {
        "focal": image * focal,
        "aspect": image * [0.0, camera.fy],
        "cx": np.broadcast_to([camera.fx, 0.0], image.shape),
        "cy": np.broadcast_to([0.0, camera.fx], image.shape),
    }
    columns = [
        plain[name] if name in plain else by_coefficient[..., camera.lens.parameters.index(name)] * focal
        for name in names
    ]
    return np.stack(columns, axis=-1) if columns else np.zeros((len(points_in_cam), 2, 0))


def ideal_from_observed(camera: Camera, pixels: ArrayLike) -> Array:
    """Distortion-free pixels (N, 2) of the same calibration matrix, from observed pixels (N, 2), for undistorted
    pictures.

    Beyond the radius at which a strong negative k1 of brown folds the image back on itself the result is finite, and
    `project` does not return the pixel. NaN for pixels that a rational lens does not show, and for rays of a fisheye
    that are not in front of the camera.
    """
    observed = np.asarray(pixels, dtype=np.float64)
    if camera.model == "pinhole":
        return observed
    centre, focal = np.array([camera.cx, camera.cy]), np.array([camera.fx, camera.fy])
    if camera.model == "brown":
        return undistort((observed - centre) / focal, camera.coefficients) * focal + centre
    rays = rays_from_pixels(camera, observed)
    depth = np.where(rays[..., 2] > 0, rays[..., 2], np.nan)
    return cast(Array, rays[..., :2] / depth[..., None] * focal + centre)


def _inverse_2x2(matrices: Array) -> Array:
    """Inverses of matrices (N, 2, 2), NaN where one is singular or NaN."""
    a, b, c, d = matrices[:, 0, 0], matrices[:, 0, 1], matrices[:, 1, 0], matrices[:, 1, 1]
    determinant = a * d - b * c
    determinant = np.where(determinant != 0, determinant, np.nan)
    return np.stack([np.stack([d, -b], axis=1), np.stack([-c, a], axis=1)], axis=1) / determinant[:, None, None]
