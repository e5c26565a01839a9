"""Cameras as COLMAP knows them."""

from __future__ import annotations

import pycolmap

from georef.geometry.camera import Camera


def colmap_camera(camera: Camera, camera_id: int = 1) -> pycolmap.Camera:
    """The same camera: PINHOLE, OPENCV, FULL_OPENCV (rational, or with k3) or OPENCV_FISHEYE."""
    model, distortion = _model(camera)
    params = [camera.fx, camera.fy, camera.cx, camera.cy, *distortion]
    return pycolmap.Camera(model=model, width=camera.width, height=camera.height, params=params, camera_id=camera_id)


def _model(camera: Camera) -> tuple[str, list[float]]:
    coefficients = [float(value) for value in camera.coefficients]
    if camera.model == "pinhole":
        return "PINHOLE", []
    if camera.model == "fisheye":
        return "OPENCV_FISHEYE", coefficients[:4]
    if camera.model == "brown" and coefficients[4] == 0.0:
        return "OPENCV", coefficients[:4]
    return "FULL_OPENCV", coefficients
