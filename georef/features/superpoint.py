"""SuperPoint keypoints and descriptors (DeTone et al. 2018). The authors allow non-commercial use of the weights alone.

The weights are never fetched unasked and no preset names this extractor: `georef weights fetch superpoint` says how.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import conv2d, grid_sample, max_pool2d, normalize, pad, pixel_shuffle, relu

from georef.features.base import Detections, Image
from georef.features.device import choose_device
from georef.features.peaks import parabola_offsets, pixels_of, strict_maxima
from georef.features.torch_extractor import detections_of, image_tensor, version_of
from georef.features.weights import load_state_dict

_CELL = 8  # pixels; one descriptor and 64 scores each
_GREY = (0.299, 0.587, 0.114)


class SuperPointNetwork:
    """The layers of SuperPoint from weights in the authors' layout (`conv1a` to `conv4b`, `convPa` to `convDb`)."""

    descriptor_size = 256

    def __init__(self, weights: dict[str, Tensor], device: torch.device) -> None:
        self._weights = {key: tensor.to(device) for key, tensor in weights.items()}

    def dense(self, image: Tensor) -> tuple[Tensor, Tensor]:
        """Descriptors of cells (1, 256, h, w) and the score map (H, W) of an image (3, H, W) of RGB in [0, 1]."""
        height, width = image.shape[1:]
        grey = (image * image.new_tensor(_GREY)[:, None, None]).sum(0)[None, None]
        x = pad(grey, (0, -width % _CELL, 0, -height % _CELL), mode="replicate")
        for level in "1234":
            x = relu(self._conv(f"conv{level}b", relu(self._conv(f"conv{level}a", x))))
            x = max_pool2d(x, 2) if level != "4" else x
        logits = self._conv("convPb", relu(self._conv("convPa", x)))
        cells = normalize(self._conv("convDb", relu(self._conv("convDa", x))), dim=1)
        score_map = pixel_shuffle(logits.softmax(1)[:, :-1], _CELL)  # the last one: no keypoint
        return cells, score_map[0, 0, :height, :width]

    def _conv(self, name: str, x: Tensor) -> Tensor:
        weight = self._weights[f"{name}.weight"]
        return conv2d(x, weight, self._weights[f"{name}.bias"], padding=weight.shape[2] // 2)


def describe(cells: Tensor, pixels: Tensor) -> Tensor:
    """Descriptors (N, 256) of unit length at pixels (N, 2), looked up where the matchers were trained with them."""
    size = pixels.new_tensor([cells.shape[3], cells.shape[2]]) * _CELL - _CELL / 2 - 0.5
    grid = (pixels - _CELL / 2 + 0.5) / size * 2 - 1
    return normalize(grid_sample(cells, grid[None, None], mode="bilinear", align_corners=True)[0, :, 0].T)


class SuperPoint:
    """SuperPoint; descriptors (N, 256) float16 of unit length.

    detection_threshold: score in (0, 1) that a keypoint must exceed. subpixel: keypoints are moved within their pixel
    to the top of parabolas through the logarithms of scores; the network itself knows whole pixels only.
    device: "cpu", "cuda", or "auto". Raises WeightsError where the weights are not in the cache.
    """

    name = "superpoint"
    weights = "superpoint"
    descriptor_size = 256
    descriptor_dtype = np.dtype(np.float16)
    largest_side_px = 1600
    tile_side_px = 1600
    nms_radius_px = 4

    def __init__(self, *, detection_threshold: float = 0.0005, subpixel: bool = True, device: str = "cpu") -> None:
        self._threshold = detection_threshold
        self._subpixel = subpixel
        self._device = choose_device(device)
        self._network = SuperPointNetwork(load_state_dict(self.weights), self._device)

    def version(self) -> str:
        settings = f"threshold={self._threshold} subpixel={self._subpixel} device={self._device.type}"
        return version_of(self.name, self.weights, settings)

    def detect(self, image_rgb: Image, max_keypoints: int) -> Detections:
        """Keypoints of an image (H, W, 3), 4 px or more from its border; scores are the network's, in (0, 1)."""
        with torch.inference_mode():
            cells, score_map = self._network.dense(image_tensor(image_rgb, self._device))
            index = strict_maxima(score_map, self._threshold, max_keypoints, self.nms_radius_px)
            whole = pixels_of(index, score_map.shape[1])
            descriptors = describe(cells, whole)
            keypoints = whole + parabola_offsets(score_map.log(), index) if self._subpixel else whole
            scores = score_map.reshape(-1)[index]
        return detections_of(keypoints, scores, descriptors)
