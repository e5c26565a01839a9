"""SIFT keypoints with RootSIFT descriptors, by OpenCV (a quarter of COLMAP's CPU time at the same first octave)."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from georef.features.base import Detections, Image


class Sift:
    """SIFT with RootSIFT descriptors (N, 128) uint8, a unit vector of 512.

    contrast_threshold is OpenCV's (its default of 0.04 leaves too few keypoints on plaster and asphalt).
    A place with several dominant orientations gives several keypoints; all count against the budget.
    """

    name = "sift"
    descriptor_size = 128
    descriptor_dtype = np.dtype(np.uint8)
    largest_side_px = None
    tile_side_px = 4096

    def __init__(self, *, contrast_threshold: float = 0.0133, edge_threshold: float = 10.0) -> None:
        self._contrast_threshold = contrast_threshold
        self._edge_threshold = edge_threshold

    def version(self) -> str:
        return (
            f"sift-rootsift-2 opencv={cv2.__version__} contrast={self._contrast_threshold} edge={self._edge_threshold}"
        )

    def detect(self, image_rgb: Image, max_keypoints: int) -> Detections:
        """Keypoints of an image (H, W, 3); scores are the contrast of the extremum, scales its sigma in pixels,
        orientations the directions of the strongest gradients."""
        grey = cv2.cvtColor(image_rgb, cv2.COLOR_RGB2GRAY)
        found, descriptors = self._detector(max_keypoints).detectAndCompute(grey, None)
        if descriptors is None or not found:
            return Detections(
                np.zeros((0, 2), np.float32),
                np.zeros(0, np.float32),
                np.zeros(0, np.float32),
                root_sift(np.zeros((0, 128))),
                np.zeros(0, np.float32),
            )
        values = np.array([(*p.pt, p.response, p.size, p.angle) for p in found], np.float32)
        best = np.argsort(-values[:, 2], kind="stable")[:max_keypoints]  # OpenCV keeps ties beyond the budget
        values = values[best]
        return Detections(
            keypoints_px=values[:, :2] + np.float32(0.5),  # OpenCV: the top-left pixel's centre is (0, 0)
            scores=values[:, 2].copy(),
            scales_px=values[:, 3] * np.float32(0.5),  # OpenCV's size is a diameter
            descriptors=root_sift(np.asarray(descriptors, np.float32)[best]),
            orientations_rad=np.deg2rad(180 - (180 - values[:, 4]) % 360),  # OpenCV: degrees in [0, 360)
        )

    def _detector(self, max_keypoints: int) -> cv2.SIFT:
        return cv2.SIFT.create(
            nfeatures=max_keypoints,
            contrastThreshold=self._contrast_threshold,
            edgeThreshold=self._edge_threshold,
            enable_precise_upscale=True,  # without it every keypoint is a quarter of a pixel off
        )


def root_sift(descriptors: NDArray[np.floating]) -> NDArray[np.uint8]:
    """RootSIFT of SIFT descriptors (N, 128): the square root of the L1-normalised one, times 512, clipped at 255."""
    norms = np.maximum(np.abs(descriptors).sum(axis=1, keepdims=True), 1e-12)
    return np.minimum(np.sqrt(descriptors / norms) * 512 + 0.5, 255).astype(np.uint8)
