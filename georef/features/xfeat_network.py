"""The network of XFeat (Potje et al. 2024), with batch normalisation folded into the convolutions.

Pixels are (x, y) with the top-left pixel's centre at (0, 0), as the network has them.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, conv2d, grid_sample, interpolate, normalize, pad, pixel_shuffle, relu

from georef.features.folding import EPSILON, fold

MULTIPLE = 32  # sides that the levels divide
CELL = 8  # pixels; one descriptor and 64 scores each
_BLOCKS = {  # strides of the layers of each block
    "block1": (1, 2, 1, 2),
    "block2": (1, 1),
    "block3": (2, 1, 1),
    "block4": (2, 1, 1),
    "block5": (2, 1, 1, 1),
    "block_fusion": (1, 1),
    "heatmap_head": (1, 1),
    "keypoint_head": (1, 1, 1),
}


class XFeatNetwork:
    """XFeat from its published weights."""

    descriptor_size = 64

    def __init__(self, weights: dict[str, Tensor], device: torch.device) -> None:
        self._weights = {key: tensor.to(device) for key, tensor in _folded(weights).items()}

    def dense(self, image: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Descriptors (1, 64, h, w) and reliability (1, 1, h, w) of cells, and the score map (H, W), of an image.

        image (3, H, W): RGB in [0, 1]. Sides that are no multiple of 32 are filled up with repeated border pixels; the
        maps of cells cover those too.
        """
        height, width = image.shape[1:]
        grey = image.mean(0, keepdim=True)[None]
        variance, mean = torch.var_mean(grey, correction=0)
        grey = (grey - mean) * (variance + EPSILON).rsqrt()
        x = pad(grey, (0, -width % MULTIPLE, 0, -height % MULTIPLE), mode="replicate")
        cells = self._features(x)
        reliability = torch.sigmoid(self._conv("heatmap_head.2", self._block("heatmap_head", cells)))
        logits = self._conv("keypoint_head.3", self._block("keypoint_head", torch.pixel_unshuffle(x, CELL)))
        score_map = pixel_shuffle(logits.softmax(1)[:, :-1], CELL)[0, 0, :height, :width]  # the last one: no keypoint
        return normalize(cells, dim=1), reliability, score_map

    def _features(self, x: Tensor) -> Tensor:
        skip = self._conv("skip1.1", avg_pool2d(x, 4))
        third = self._block("block3", self._block("block2", self._block("block1", x) + skip))
        fourth = self._block("block4", third)
        fifth = self._block("block5", fourth)
        size = third.shape[2:]
        total = third + sum(interpolate(part, size, mode="bilinear", align_corners=False) for part in (fourth, fifth))
        return self._conv("block_fusion.2", self._block("block_fusion", total))

    def _block(self, name: str, x: Tensor) -> Tensor:
        for layer, stride in enumerate(_BLOCKS[name]):
            x = relu(self._conv(f"{name}.{layer}.layer.0", x, stride))
        return x

    def _conv(self, name: str, x: Tensor, stride: int = 1) -> Tensor:
        weight = self._weights[f"{name}.weight"]
        return conv2d(x, weight, self._weights[f"{name}.bias"], stride, padding=weight.shape[2] // 2)


def sample_cells(cells: Tensor, pixels: Tensor, mode: str) -> Tensor:
    """Values (N, C) of a map of cells (1, C, h, w) at pixels (N, 2), looked up where the network was trained to look.

    That is x w / (W - 1) - 0.5 with W = 8 w, up to half a pixel of the image beside a pixel's own place.
    """
    size = pixels.new_tensor([cells.shape[3] * CELL - 1, cells.shape[2] * CELL - 1])
    grid = pixels / size * 2 - 1
    return grid_sample(cells, grid[None, None], mode=mode, align_corners=False)[0, :, 0].T


def _folded(weights: dict[str, Tensor]) -> dict[str, Tensor]:
    """The weights with each batch normalisation made part of its convolution; without the semi-dense matcher's."""
    folded = {key: tensor for key, tensor in weights.items() if ".layer." not in key and "fine_matcher" not in key}
    for key in (key for key in weights if key.endswith(".layer.1.running_var")):
        layer = key.removesuffix(".1.running_var")
        folded.update(fold(weights, f"{layer}.0", f"{layer}.1"))
    return folded
