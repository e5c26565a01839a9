"""Pixel coordinates under resizing. The centre of the top-left pixel is (0.5, 0.5) at every size."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from georef.geometry.rigid import Array


def resize_keypoints(keypoints_px: ArrayLike, *, from_size: tuple[int, int], to_size: tuple[int, int]) -> Array:
    """Keypoints (N, 2) of an image of `from_size` (width, height) in the same image resized to `to_size`."""
    scale = np.asarray(to_size, dtype=np.float64) / np.asarray(from_size, dtype=np.float64)
    return np.asarray(keypoints_px, dtype=np.float64) * scale


def level_size(image_size: tuple[int, int], longest_side: int) -> tuple[int, int]:
    """Size (width, height) of an image brought down to a longest side; an image is never enlarged."""
    factor = min(1.0, longest_side / max(image_size))
    width, height = (max(1, round(side * factor)) for side in image_size)
    return width, height
