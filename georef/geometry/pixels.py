"""Pixel coordinates under resizing and turning. The centre of the top-left pixel is (0.5, 0.5) at every size."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

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


def turn_keypoints(keypoints_px: ArrayLike, *, size: tuple[int, int], quarter_turns: int) -> Array:
    """Keypoints (N, 2) of a picture of `size` (width, height) in the same picture turned clockwise by quarter turns."""
    x, y = np.asarray(keypoints_px, dtype=np.float64).T
    width, height = size
    turned = ((x, y), (height - y, x), (width - x, height - y), (y, width - x))
    return np.column_stack(turned[quarter_turns % 4])


def turn_angles(angles_rad: NDArray[np.float32], quarter_turns: int) -> NDArray[np.float32]:
    """Directions (N,) from x towards y of a picture, in (-pi, pi], in the same picture turned clockwise."""
    return (np.pi - (np.pi - angles_rad - 0.5 * np.pi * quarter_turns) % (2.0 * np.pi)).astype(np.float32)


def turned_size(size: tuple[int, int], quarter_turns: int) -> tuple[int, int]:
    """Width and height of a picture of `size` after quarter turns."""
    return (size[1], size[0]) if quarter_turns % 2 else size
