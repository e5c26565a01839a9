"""Image observations as factors of GTSAM, each with the camera that it was taken by.

Pinhole, brown and fisheye cameras are GTSAM's Cal3_S2, Cal3DS2 and Cal3Fisheye. What these do not have, rays of a
fisheye that are far from its axis, brown with k3 and rational, is observed by a pinhole of its own that looks along
the ray: the residual is then that of the slopes about the ray, weighted by the noise of the pixel carried over. The
two agree to first order in the residual, a few pixels against a focal length.
"""

from __future__ import annotations

from collections.abc import Callable

import gtsam
import numpy as np
from numpy.typing import NDArray

from georef.geometry.camera import Camera, ray_derivatives, rays_from_pixels
from georef.geometry.rigid import Array
from georef.types.scene import Observations

Robust = Callable[[gtsam.noiseModel.Base], gtsam.noiseModel.Base]
_LEAST_DEPTH = 0.25  # of a unit ray: GTSAM's fisheye is exact in front of the camera only, and points may move
_PER_POINT = {
    "brown": (gtsam.Cal3DS2, gtsam.GenericProjectionFactorCal3DS2),
    "fisheye": (gtsam.Cal3Fisheye, gtsam.GenericProjectionFactorCal3Fisheye),
}


def add_observations(
    graph: gtsam.NonlinearFactorGraph,
    cameras: tuple[Camera, ...],
    obs: Observations,
    first_key: int,
    robust: Robust,
) -> None:
    """Adds all observations by image and noise level; keys: the view's index, first_key + the point's index."""
    order = np.lexsort((obs.sigma_px, obs.view))
    view, sigma = obs.view[order], obs.sigma_px[order]
    starts = np.flatnonzero(np.concatenate([[True], (np.diff(view) != 0) | (np.diff(sigma) != 0)])) if len(view) else []
    for chunk in np.split(order, starts[1:]) if len(view) else []:
        camera, part = cameras[obs.view[chunk[0]]], obs.take(chunk)
        if camera.model == "pinhole":
            _add_pinhole(graph, camera, part, first_key, robust)
            continue
        rays = rays_from_pixels(camera, part.pixel)
        native = _has_native(camera, rays)
        _add_native(graph, camera, part.take(native), first_key, robust)
        _add_along_rays(graph, camera, part.take(~native), rays[~native], first_key, robust)


def _has_native(camera: Camera, rays: Array) -> NDArray[np.bool_]:
    if camera.model not in _PER_POINT or camera.coefficients[4] != 0.0:
        return np.zeros(len(rays), bool)
    with np.errstate(invalid="ignore"):
        return rays[:, 2] / np.linalg.norm(rays, axis=1) > _LEAST_DEPTH


def _add_pinhole(
    graph: gtsam.NonlinearFactorGraph, camera: Camera, obs: Observations, first_key: int, robust: Robust
) -> None:
    calibration = gtsam.Cal3_S2(camera.fx, camera.fy, 0.0, camera.cx, camera.cy)
    keys = (first_key + obs.point).astype(np.float64)
    pixels = np.asfortranarray(obs.pixel.T)
    gtsam.utilities.insertProjectionFactors(graph, int(obs.view[0]), keys, pixels, _noise(obs, robust), calibration)


def _add_native(
    graph: gtsam.NonlinearFactorGraph, camera: Camera, obs: Observations, first_key: int, robust: Robust
) -> None:
    if not len(obs):
        return
    calibration_type, factor_type = _PER_POINT[camera.model]
    coefficients = (float(value) for value in camera.coefficients[:4])
    calibration = calibration_type(camera.fx, camera.fy, 0.0, camera.cx, camera.cy, *coefficients)
    noise = _noise(obs, robust)
    for point, view, pixel in zip(obs.point, obs.view, obs.pixel, strict=True):
        graph.add(factor_type(pixel, noise, int(view), first_key + int(point), calibration))


def _add_along_rays(
    graph: gtsam.NonlinearFactorGraph,
    camera: Camera,
    obs: Observations,
    rays: Array,
    first_key: int,
    robust: Robust,
) -> None:
    """Pinholes of unit focal length that look along the rays; a pixel outside of what the lens shows is left out."""
    calibration = gtsam.Cal3_S2(1.0, 1.0, 0.0, 0.0, 0.0)
    by_pixel = ray_derivatives(camera, rays)
    for index in np.flatnonzero(np.isfinite(by_pixel).all(axis=(1, 2))):
        length = float(np.linalg.norm(rays[index]))
        turn = _looking_along(rays[index] / length)
        slope_by_pixel = (turn.T @ by_pixel[index])[:2] / length
        cov = obs.sigma_px[index] ** 2 * slope_by_pixel @ slope_by_pixel.T
        noise = robust(gtsam.noiseModel.Gaussian.Covariance(cov))
        sensor = gtsam.Pose3(gtsam.Rot3(turn), np.zeros(3))
        keys = int(obs.view[index]), first_key + int(obs.point[index])
        graph.add(gtsam.GenericProjectionFactorCal3_S2(np.zeros(2), noise, *keys, calibration, sensor))


def _looking_along(ray: Array) -> Array:
    """A rotation (3, 3), camera from a frame whose z axis is the unit ray."""
    aside = np.eye(3)[int(np.argmin(np.abs(ray)))]
    x = np.cross(aside, ray)
    x /= np.linalg.norm(x)
    return np.column_stack([x, np.cross(ray, x), ray])


def _noise(obs: Observations, robust: Robust) -> gtsam.noiseModel.Base:
    """The noise of observations that share one sigma."""
    return robust(gtsam.noiseModel.Isotropic.Sigma(2, float(obs.sigma_px[0])))
