"""A first pose of one image without approximate values: COLMAP's LO-RANSAC, also where the camera is not known.

An unknown focal length is estimated by COLMAP together with the pose (P4PF), for several guesses of the radial
distortion that are taken out beforehand (division model, Fitzgibbon 2001: x_u = x_d / (1 + lambda r_d^2), so that
k1 = lambda f^2 to first order). Of a fisheye several focal lengths are tried instead. The guess that points agree with
best starts the adjustment.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import pycolmap
from numpy.typing import NDArray

from georef.estimation.colmap import colmap_camera
from georef.estimation.local_model import LocalModel
from georef.geometry.camera import Camera, ideal_from_observed, project, rays_from_pixels
from georef.geometry.rigid import Array, Rigid3

_LEAST_DEPTH = 0.25  # of a unit ray: COLMAP's fisheye ends at 90 degrees, a spherical camera does not
_DIVISIONS = (0.0, -0.06, -0.15, -0.3, 0.06)  # lambda for radii in half diagonals
_FOCAL_FACTORS = np.exp(np.linspace(-0.42, 0.42, 9))
_WIDEST_FOCAL, _LONGEST_FOCAL = 0.2, 20.0  # of the longer side


@dataclass(frozen=True, eq=False)
class QueryImage:
    """What of the query image enters the pose: its camera and its observed keypoints with their noise."""

    camera: Camera
    pixels: Array  # (N, 2)
    sigma_px: Array  # (N,)

    def with_camera(self, camera: Camera) -> QueryImage:
        return replace(self, camera=camera)


@dataclass(frozen=True, eq=False)
class FirstPose:
    """A pose with the points (P,) of the local model that agree with it, and the camera that it was found with."""

    world_from_cam: Rigid3
    inliers: NDArray[np.bool_]
    camera: Camera


def ransac_pose(query: QueryImage, model: LocalModel, gate_px: float, seed: int) -> FirstPose | None:
    """Pose by COLMAP's LO-RANSAC (P3P, EPnP; P4PF) and its refinement; None without consensus."""
    pixels = query.pixels[model.keypoint]
    if not query.camera.estimate:
        return _with_known_focal(query.camera, pixels, model, gate_px, seed)
    unknown_focal = "focal" in query.camera.estimate
    if unknown_focal and query.camera.model != "fisheye":
        found = list(_guesses_of_focal(query.camera, pixels, model, gate_px, seed))
    else:
        guesses = _fisheyes(query.camera) if unknown_focal else _distortions(query.camera)
        tried = [_with_known_focal(camera, pixels, model, gate_px, seed) for camera in guesses]
        found = [first for first in tried if first is not None]
    # Within a wide gate wrong guesses find as many points as the right one: their residuals tell.
    return max(found, key=lambda first: _score(first, pixels, model, gate_px), default=None)


def _with_known_focal(camera: Camera, pixels: Array, model: LocalModel, gate_px: float, seed: int) -> FirstPose | None:
    """COLMAP with the camera's own model, or a spherical one where rays are far from the axis."""
    rays = rays_from_pixels(camera, pixels)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    shown = np.isfinite(rays).all(axis=1)
    if shown.sum() < 4:
        return None
    lens = colmap_camera(camera)
    if camera.model == "fisheye" and (rays[shown, 2] < _LEAST_DEPTH).any():
        lens = _spherical(camera)
        pixels = np.asarray(lens.img_from_cam(np.where(shown[:, None], rays, [0.0, 0.0, 1.0])), dtype=np.float64)
    options = pycolmap.AbsolutePoseEstimationOptions()
    options.ransac.max_error = gate_px
    options.ransac.random_seed = seed
    # A local origin keeps COLMAP's arithmetic well conditioned far from the world's origin.
    origin = model.points.mean(axis=0)
    found = pycolmap.estimate_and_refine_absolute_pose(pixels[shown], model.points[shown] - origin, lens, options)
    if found is None:
        return None
    inliers = np.zeros(len(model), bool)
    inliers[shown] = np.asarray(found["inlier_mask"], bool)
    return FirstPose(_world_from_cam(found, origin), inliers, camera)


def _spherical(camera: Camera) -> pycolmap.Camera:
    """All directions, with as many pixels a radian as the camera has at its axis."""
    height = max(2, round(np.pi * 0.5 * (camera.fx + camera.fy)))
    return pycolmap.Camera(model="EQUIRECTANGULAR", width=2 * height, height=height, params=[2 * height, height])


def _guesses_of_focal(
    camera: Camera, pixels: Array, model: LocalModel, gate_px: float, seed: int
) -> Iterator[FirstPose]:
    """Poses with an estimated focal length, one for each guess of the distortion."""
    centre = np.array([camera.cx, camera.cy])
    for division in _DIVISIONS if "k1" in camera.estimate else (None,):
        ideal = ideal_from_observed(camera, pixels)
        if division is not None:
            offset = pixels - centre
            square = np.square(offset).sum(axis=1, keepdims=True) / _half_diagonal(camera) ** 2
            ideal = centre + offset / (1.0 + division * square)
        pinhole = Camera(camera.camera_id, camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
        found = _with_focal(pinhole, ideal, model, gate_px, seed)
        if found is None:
            continue
        factor = found.camera.fx / camera.fx
        start = camera.changed(("focal",), [np.log(factor)])
        if division is not None:
            start = _with_division(start, division)
        yield replace(found, camera=start)


def _with_focal(pinhole: Camera, pixels: Array, model: LocalModel, gate_px: float, seed: int) -> FirstPose | None:
    options = pycolmap.AbsolutePoseEstimationOptions()
    options.ransac.max_error = gate_px
    options.ransac.random_seed = seed
    options.estimate_focal_length = True
    refinement = pycolmap.AbsolutePoseRefinementOptions()
    refinement.refine_focal_length = True
    lens, origin = colmap_camera(pinhole), model.points.mean(axis=0) if len(model) else np.zeros(3)
    if len(model) < 4:
        return None
    found = pycolmap.estimate_and_refine_absolute_pose(pixels, model.points - origin, lens, options, refinement)
    if found is None:
        return None
    focal, side = float(lens.mean_focal_length()), max(pinhole.width, pinhole.height)
    if not _WIDEST_FOCAL * side < focal < _LONGEST_FOCAL * side:
        return None
    inliers = np.asarray(found["inlier_mask"], bool)
    factor = focal / (0.5 * (pinhole.fx + pinhole.fy))
    return FirstPose(_world_from_cam(found, origin), inliers, pinhole.changed(("focal",), [np.log(factor)]))


def _fisheyes(camera: Camera) -> list[Camera]:
    """The camera with several focal lengths."""
    return [camera.changed(("focal",), [np.log(factor)]) for factor in _FOCAL_FACTORS]


def _distortions(camera: Camera) -> list[Camera]:
    """The camera with several k1; a fisheye as it is, whose k1 is small."""
    if camera.model == "fisheye":
        return [camera]
    return [_with_division(camera, division) for division in _DIVISIONS]


def _with_division(camera: Camera, division: float) -> Camera:
    """The camera with the k1 that a distortion of the division model amounts to at its focal length."""
    k1 = division * (camera.fx / _half_diagonal(camera)) ** 2
    return camera.changed(("k1",), [k1 - camera.value("k1")])


def _half_diagonal(camera: Camera) -> float:
    return 0.5 * float(np.hypot(camera.width, camera.height))


def _score(first: FirstPose, pixels: Array, model: LocalModel, gate_px: float) -> float:
    """Truncated squares of the residuals within the gate, more is better (MSAC, Torr and Zisserman 2000)."""
    residual = project(first.camera, first.world_from_cam.inverse().apply(model.points)) - pixels
    square = np.nan_to_num(np.square(residual).sum(axis=1), nan=np.inf) / gate_px**2
    return float(np.maximum(1.0 - square, 0.0).sum())


def _world_from_cam(found: dict, origin: Array) -> Rigid3:
    local_from_cam = Rigid3.from_matrix(found["cam_from_world"].matrix()).inverse()
    return Rigid3(local_from_cam.rotation, local_from_cam.translation + origin)
