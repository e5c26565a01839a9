"""Textured images with known content, the same on every run."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]


def textured_image(width: int, height: int, seed: int = 0) -> Image:
    """An RGB image (height, width, 3) of turned rectangles with a little noise: edges, corners, plain areas."""
    rng = np.random.default_rng(seed)
    image = np.full((height, width, 3), 128, np.uint8)
    for _ in range(max(8, width * height // 300)):
        centre, size = rng.uniform((0, 0), (width, height)), rng.uniform(3, 60, 2) * rng.uniform(0.3, 1)
        box = cv2.boxPoints((tuple(map(float, centre)), tuple(map(float, size)), float(rng.uniform(0, 180))))
        cv2.fillPoly(image, [box.astype(np.int32)], tuple(map(int, rng.integers(20, 236, 3))), lineType=cv2.LINE_AA)
    smooth = cv2.GaussianBlur(image, (0, 0), 0.8)
    return np.clip(smooth + rng.normal(0, 2, smooth.shape), 0, 255).astype(np.uint8)


def blobs_image(width: int, height: int, sigma_px: float, seed: int = 0) -> tuple[Image, NDArray[np.float64]]:
    """An RGB image with bright Gaussian blobs, and their centres (N, 2) px; (0.5, 0.5) is the first centre."""
    rng = np.random.default_rng(seed)
    columns, rows = np.meshgrid(np.arange(40, width - 30, 40), np.arange(40, height - 30, 40))
    centres = np.stack([columns.ravel(), rows.ravel()], 1) + rng.uniform(0, 1, (columns.size, 2))
    x, y = np.arange(width) + 0.5, np.arange(height) + 0.5
    across = np.exp(-((x - centres[:, :1]) ** 2) / (2 * sigma_px**2))
    down = np.exp(-((y - centres[:, 1:]) ** 2) / (2 * sigma_px**2))
    grey = 80 + 120 * (down.T @ across) + rng.normal(0, 1, (height, width))
    return np.repeat(np.clip(grey + 0.5, 0, 255).astype(np.uint8)[:, :, None], 3, axis=2), centres


def nearest_offsets(from_px: NDArray, to_px: NDArray, within_px: float) -> NDArray[np.float64]:
    """Differences (M, 2) from each place to the nearest of the others, where that is nearer than within_px."""
    distance = np.linalg.norm(to_px[None] - from_px[:, None], axis=2)
    nearest = distance.argmin(axis=1)
    found = distance[np.arange(len(from_px)), nearest] < within_px
    return (to_px[nearest] - from_px)[found]
