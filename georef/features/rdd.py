"""RDD keypoints and descriptors (Chen et al. 2025).

The authors' page calls the code Apache-2.0, but no licence file lies beside code or weights: `georef weights fetch`
asks for consent.
"""

from __future__ import annotations

import numpy as np
import torch

from georef.features.base import Detections, Image
from georef.features.device import choose_device
from georef.features.peaks import find_peaks
from georef.features.rdd_network import MULTIPLE, RddNetwork, sample_cells
from georef.features.torch_extractor import detections_of, image_tensor, version_of
from georef.features.weights import load_state_dict


class Rdd:
    """RDD, second version of the weights; descriptors (N, 256) float16 of unit length.

    detection_threshold: score in (0, 1) that a keypoint must exceed. device: "cpu", "cuda", or "auto"; on the CPU it is
    by far the slowest. Raises WeightsError where the weights are not in the cache.
    """

    name = "rdd"
    weights = "rdd-v2"
    descriptor_size = 256
    descriptor_dtype = np.dtype(np.float16)
    largest_side_px = 1024
    tile_side_px = 1024

    def __init__(self, *, detection_threshold: float = 0.1, device: str = "cpu") -> None:
        self._threshold = detection_threshold
        self._device = choose_device(device)
        self._network = RddNetwork(load_state_dict(self.weights), self._device)

    def version(self) -> str:
        settings = f"threshold={self._threshold} device={self._device.type}"
        return version_of(self.name, self.weights, settings)

    def detect(self, image_rgb: Image, max_keypoints: int) -> Detections:
        """Keypoints of an image (H, W, 3); scores are the network's, in (0, 1); the scale is one pixel of the level."""
        filled = (_up(image_rgb.shape[1]), _up(image_rgb.shape[0]))
        with torch.inference_mode():
            cells, score_map = self._network.dense(image_tensor(image_rgb, self._device))
            keypoints, scores = find_peaks(score_map, self._threshold, max_keypoints)
            descriptors = sample_cells(cells, keypoints, filled)
        return detections_of(keypoints, scores, descriptors)


def _up(side: int) -> int:
    """The side filled up to the next multiple that the network takes."""
    return -(-side // MULTIPLE) * MULTIPLE
