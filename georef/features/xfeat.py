"""XFeat keypoints and descriptors (Potje et al. 2024) with the published weights."""

from __future__ import annotations

import numpy as np
import torch
from torch.nn.functional import normalize

from georef.features.base import Detections, Image
from georef.features.device import choose_device
from georef.features.peaks import parabola_offsets, pixels_of, strict_maxima
from georef.features.torch_extractor import detections_of, image_tensor, version_of
from georef.features.weights import load_state_dict
from georef.features.xfeat_network import XFeatNetwork, sample_cells


class XFeat:
    """XFeat, the fastest of the learned ones; descriptors (N, 64) float16 of unit length.

    detection_threshold: score in (0, 1) that a keypoint must exceed before its reliability counts.
    subpixel: keypoints are moved within their pixel to the top of parabolas through the logarithms of scores; the
    network itself knows whole pixels only. device: "cpu", "cuda", or "auto".
    Raises WeightsError where the weights are not in the cache.
    """

    name = "xfeat"
    weights = "xfeat"
    descriptor_size = 64
    descriptor_dtype = np.dtype(np.float16)
    largest_side_px = None  # 0.3 GB at 4096 px
    tile_side_px = 1024

    def __init__(self, *, detection_threshold: float = 0.05, subpixel: bool = True, device: str = "cpu") -> None:
        self._threshold = detection_threshold
        self._subpixel = subpixel
        self._device = choose_device(device)
        self._network = XFeatNetwork(load_state_dict(self.weights), self._device)

    def version(self) -> str:
        settings = f"threshold={self._threshold} subpixel={self._subpixel} device={self._device.type}"
        return version_of(self.name, self.weights, settings)

    def detect(self, image_rgb: Image, max_keypoints: int) -> Detections:
        """Keypoints of an image (H, W, 3); scores are those of the place times its reliability, in (0, 1)."""
        with torch.inference_mode():
            cells, reliability, score_map = self._network.dense(image_tensor(image_rgb, self._device))
            index = strict_maxima(score_map, self._threshold, score_map.numel())
            whole = pixels_of(index, score_map.shape[1])
            scores = score_map.reshape(-1)[index] * sample_cells(reliability, whole, "bilinear")[:, 0]
            best = scores.topk(min(max_keypoints, len(scores))).indices
            index, whole, scores = index[best], whole[best], scores[best]
            descriptors = normalize(sample_cells(cells, whole, "bicubic"))
            keypoints = whole + parabola_offsets(score_map.log(), index) if self._subpixel else whole
        return detections_of(keypoints, scores, descriptors)
