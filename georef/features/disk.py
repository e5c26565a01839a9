"""DISK keypoints and descriptors (Tyszkiewicz et al. 2020) with the published weights."""

from __future__ import annotations

import numpy as np
import torch

from georef.features.base import Detections, Image
from georef.features.device import choose_device
from georef.features.disk_network import DiskNetwork
from georef.features.peaks import parabola_offsets, pixels_of, strict_maxima
from georef.features.torch_extractor import detections_of, image_tensor, version_of
from georef.features.weights import load_state_dict


class Disk:
    """DISK, trained with depth maps; descriptors (N, 128) float16 of unit length.

    subpixel: keypoints are moved within their pixel to the top of parabolas through the scores; the network itself
    knows whole pixels only. device: "cpu", "cuda", or "auto".
    Raises WeightsError where the weights are not in the cache.
    """

    name = "disk"
    weights = "disk-depth-save"
    descriptor_size = 128
    descriptor_dtype = np.dtype(np.float16)
    largest_side_px = 2048
    tile_side_px = 1024

    def __init__(self, *, subpixel: bool = True, device: str = "cpu") -> None:
        self._subpixel = subpixel
        self._device = choose_device(device)
        self._network = DiskNetwork(load_state_dict(self.weights)["extractor"], self._device)

    def version(self) -> str:
        settings = f"subpixel={self._subpixel} device={self._device.type}"
        return version_of(self.name, self.weights, settings)

    def detect(self, image_rgb: Image, max_keypoints: int) -> Detections:
        """Keypoints of an image (H, W, 3); scores are the network's, above 0; the scale is one pixel of the level."""
        with torch.inference_mode():
            features, score_map = self._network.dense(image_tensor(image_rgb, self._device))
            index = strict_maxima(score_map, 0.0, max_keypoints)
            whole = pixels_of(index, score_map.shape[1])
            descriptors = self._network.describe(features, whole)
            keypoints = whole + parabola_offsets(score_map, index) if self._subpixel else whole
            scores = score_map.reshape(-1)[index]
        return detections_of(keypoints, scores, descriptors)
