"""Small undistorted pictures for a recording, with the pinhole that they were taken by."""

from __future__ import annotations

import io
import logging
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image as PillowImage

from georef.errors import InputError
from georef.features.images import read_image
from georef.geometry.camera import Camera, project
from georef.geometry.rigid import Array
from georef.pictures import open_picture

_JPEG_QUALITY = 80
logger = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class SmallPinhole:
    """A distortion-free camera of a picture that is scaled to `width` x `height`."""

    width: int
    height: int
    focal: Array  # (2,) px
    centre: Array  # (2,) px, the picture's upper left corner is (0, 0)
    scale: Array  # (2,) pixels of the picture a pixel of the full image


def small_pinhole(camera: Camera, longest_side_px: int) -> SmallPinhole:
    """The camera scaled so that its longer side has at most that many pixels."""
    shrink = min(1.0, longest_side_px / max(camera.width, camera.height))
    width, height = max(1, round(camera.width * shrink)), max(1, round(camera.height * shrink))
    scale = np.array([width / camera.width, height / camera.height])
    return SmallPinhole(width, height, scale * [camera.fx, camera.fy], scale * [camera.cx, camera.cy], scale)


def picture_jpeg(path: Path, camera: Camera, small: SmallPinhole) -> bytes | None:
    """The image as a small JPEG without distortion; None, and a warning, where it cannot be read."""
    try:
        pixels = _read_small(path, small)
    except (OSError, ValueError, InputError) as error:
        logger.warning("no picture of %s in the recording: %s", path.name, error)
        return None
    if camera.model != "pinhole":
        pixels = _undistorted(pixels, camera, small)
    buffer = io.BytesIO()
    PillowImage.fromarray(pixels).save(buffer, "JPEG", quality=_JPEG_QUALITY)
    return buffer.getvalue()


def _read_small(path: Path, small: SmallPinhole) -> NDArray[np.uint8]:
    """The image (H, W, 3) at its small size, in the sensor's own rows and columns."""
    size = (small.width, small.height)
    with open_picture(path) as image:
        if image.format == "JPEG":
            image.draft("RGB", size)  # lets the decoder leave out what would be averaged away
            return np.asarray(image.convert("RGB").resize(size, PillowImage.Resampling.BICUBIC, reducing_gap=3.0))
    return np.asarray(PillowImage.fromarray(read_image(path)).resize(size, PillowImage.Resampling.BICUBIC))


def _undistorted(pixels: NDArray[np.uint8], camera: Camera, small: SmallPinhole) -> NDArray[np.uint8]:
    import cv2

    u, v = np.meshgrid(np.arange(small.width) + 0.5, np.arange(small.height) + 0.5)
    slopes = (np.stack([u, v], axis=-1) - small.centre) / small.focal
    rays = np.concatenate([slopes, np.ones((*slopes.shape[:2], 1))], axis=-1)
    source = (project(camera, rays) * small.scale - 0.5).astype(np.float32)  # OpenCV's pixel centres are whole numbers
    return cv2.remap(pixels, source[..., 0], source[..., 1], cv2.INTER_LINEAR).astype(np.uint8)
