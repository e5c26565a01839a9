"""ALIKED keypoints and descriptors (Zhao et al. 2023) with the published weights."""

from __future__ import annotations

import numpy as np
import torch

from georef.features.aliked_network import AlikedNetwork
from georef.features.base import Detections, Image
from georef.features.device import choose_device
from georef.features.peaks import find_peaks
from georef.features.torch_extractor import detections_of, image_tensor, version_of
from georef.features.weights import load_state_dict


class Aliked:
    """ALIKED; descriptors (N, 128) float16 of unit length, from 16 sampling positions each (aliked-n32: 32).

    detection_threshold: score in (0, 1) that a keypoint must exceed; images without structure stay below 0.02.
    device: "cpu", "cuda", or "auto". Raises WeightsError where the weights are not in the cache.

    The network was trained to find the same place again, not the middle of something: with aliked-n16 a small blob's
    keypoint lies 2 to 3 level pixels beside the blob, always on the same side, to 0.1 px. That cancels between images
    taken the same way up. Between images turned by a quarter or half, or for pixels that are compared with anything
    but its own, use SIFT.
    """

    name: str  # of the weights too
    descriptor_size = 128
    descriptor_dtype = np.dtype(np.float16)
    largest_side_px = 2048
    tile_side_px = 1024

    def __init__(self, *, detection_threshold: float = 0.05, device: str = "cpu") -> None:
        self._threshold = detection_threshold
        self._device = choose_device(device)
        self._network = AlikedNetwork(load_state_dict(self.name), self._device)

    def version(self) -> str:
        settings = f"threshold={self._threshold} device={self._device.type}"
        return version_of(self.name, self.name, settings)

    def detect(self, image_rgb: Image, max_keypoints: int) -> Detections:
        """Keypoints of an image (H, W, 3); scores are the network's in (0, 1), the scale is one pixel of the level."""
        with torch.inference_mode():
            levels, score_map = self._network.dense(image_tensor(image_rgb, self._device))
            keypoints, scores = find_peaks(score_map, self._threshold, max_keypoints)
            descriptors = self._network.describe(levels, keypoints)
        return detections_of(keypoints, scores, descriptors)


class AlikedN16(Aliked):
    """The usual one."""

    name = "aliked-n16"


class AlikedN16Rot(Aliked):
    """Trained on turned images too: of the three the one for cameras that are held either way."""

    name = "aliked-n16rot"


class AlikedN32(Aliked):
    """Twice the sampling positions: a little slower, a little better in the authors' tables."""

    name = "aliked-n32"
