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
from georef.features.weights import load_state_dict, version_tag


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
        return f"{self.name}-1 torch={torch.__version__} weights={version_tag(self.weights)} {settings}"

    def detect(self, image_rgb: Image, max_keypoints: int) -> Detections:
        """Keypoints of an image (H, W, 3); scores are the network's, in (0, 1); the scale is one pixel of the level."""
        filled = (_up(image_rgb.shape[1]), _up(image_rgb.shape[0]))
        with torch.inference_mode():
            pixels = torch.from_numpy(np.ascontiguousarray(image_rgb)).to(self._device)
            cells, score_map = self._network.dense(pixels.permute(2, 0, 1).float() / 255)
            keypoints, scores = find_peaks(score_map, self._threshold, max_keypoints)
            descriptors = sample_cells(cells, keypoints, filled)
        return Detections(
            keypoints_px=keypoints.cpu().numpy() + np.float32(0.5),  # the network: top-left pixel's centre at (0, 0)
            scores=scores.cpu().numpy(),
            scales_px=np.ones(len(scores), np.float32),
            descriptors=descriptors.half().cpu().numpy(),
        )


def _up(side: int) -> int:
    """The side filled up to the next multiple that the network takes."""
    return -(-side // MULTIPLE) * MULTIPLE
