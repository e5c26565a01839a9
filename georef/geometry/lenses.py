"""The mathematics of camera models: points in the camera frame <-> image coordinates at unit focal length.

All functions take N points or image coordinates with one row of coefficients each, (N, 8) or (1, 8), and the limit of
the model, (N,) or (1,), up to which it has an inverse. Outside of it results are NaN.

pinhole: m = (x/z, y/z). brown: the same times 1 + k1 r^2 + k2 r^4 + k3 r^6, and decentring p1, p2 (Brown 1966; COLMAP's
OPENCV, gtsam's Cal3DS2); coefficients k1, k2, p1, p2, k3. rational: the same factor over 1 + k4 r^2 + k5 r^4 + k6 r^6
(Claus and Fitzgibbon 2005; FULL_OPENCV); coefficients k1, k2, p1, p2, k3, k4, k5, k6. fisheye: equidistant, r = t +
k1 t^3 + k2 t^5 + k3 t^7 + k4 t^9 of the angle t from the optical axis, rays beyond 90 degrees included (Kannala and
Brandt 2006; OPENCV_FISHEYE, Cal3Fisheye); coefficients k1, k2, k3, k4. What a model does not have is zero.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from georef.geometry import lens_fisheye as fisheye
from georef.geometry import lens_slopes as slopes
from georef.geometry.rigid import Array

COEFFICIENTS = 8


@dataclass(frozen=True)
class LensModel:
    """One camera model. `parameters` names its q coefficients in the order of `Camera.distortion`."""

    parameters: tuple[str, ...]
    project: Callable[[Array, Array, Array], Array]  # points (N, 3), coefficients, limit -> m (N, 2)
    derivatives: Callable[[Array, Array, Array], tuple[Array, Array, Array]]  # -> m, by point (N, 2, 3), by k (N, 2, q)
    rays: Callable[[Array, Array, Array], Array]  # m (N, 2), coefficients, limit -> directions (N, 3), z = 1 or unit
    limit: Callable[[Array], float]  # coefficients (8,) -> the largest slope or angle


MODELS: dict[str, LensModel] = {
    "pinhole": LensModel((), slopes.pinhole_project, slopes.pinhole_derivatives, slopes.pinhole_rays, lambda _: np.inf),
    "brown": LensModel(
        ("k1", "k2", "p1", "p2", "k3"),
        slopes.brown_project,
        slopes.brown_derivatives,
        slopes.brown_rays,
        slopes.brown_limit,
    ),
    "fisheye": LensModel(
        ("k1", "k2", "k3", "k4"),
        fisheye.fisheye_project,
        fisheye.fisheye_derivatives,
        fisheye.fisheye_rays,
        fisheye.fisheye_limit,
    ),
    "rational": LensModel(
        ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
        slopes.rational_project,
        slopes.rational_derivatives,
        slopes.rational_rays,
        slopes.rational_limit,
    ),
}
