"""The pass through DISK's network, written for little time and memory on the CPU; same output as kornia's module.

A U-Net of one 5x5 convolution a block, each after instance normalisation and PReLU. Its last block works at full
resolution and makes 128 descriptor channels and one score for every pixel, four fifths of all operations. Here that
block makes the score alone, as a product with 25 taps whose shifted sums are the convolution; descriptors are formed
where keypoints are. The block's input, 80 channels of full resolution, exists one strip at a time.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, conv2d, embedding_bag, interpolate, linear, normalize, pad

from georef.features.corners import corners

MULTIPLE = 16  # sides that the five levels divide
_SIZE = 5  # of the windows of all convolutions
_MARGIN = _SIZE // 2
_STRIP = 64  # rows of full resolution handled at once
_CHUNK = 512  # keypoints described at once
_EPSILON = 1e-5  # of instance normalisation


@dataclass(frozen=True)
class DenseFeatures:
    """What the last block is fed with: maps (1, C, H/2, W/2) and (1, c, H, W), and how channels are normalised."""

    half: Tensor
    fine: Tensor
    mean: Tensor  # (C + c,)
    factor: Tensor  # (C + c,)


class DiskNetwork:
    """DISK from its published weights (the part `extractor` of the file)."""

    def __init__(self, weights: dict[str, Tensor], device: torch.device) -> None:
        self._weights = {key.removeprefix("unet."): tensor.to(device) for key, tensor in weights.items()}
        last = self._weights["path_up.3.conv.3.weight"]  # (descriptor and score, C + c, 5, 5)
        self.descriptor_size = last.shape[0] - 1
        self._score_taps = last[-1].flatten(1).T.contiguous()  # (25, C + c)
        self._descriptor_weight = last[:-1].flatten(2).transpose(1, 2).flatten(1).contiguous()  # (D, 25 x (C + c))

    def dense(self, image: Tensor) -> tuple[DenseFeatures, Tensor]:
        """The last block's input, and the score map (H, W), of an image (3, H, W) of RGB in [0, 1]."""
        height, width = image.shape[1:]
        padded = pad(image[None], (0, -width % MULTIPLE, 0, -height % MULTIPLE))
        maps = [self._conv("path_down.0.1.3", padded.contiguous(memory_format=torch.channels_last))]
        for level in range(1, 5):
            maps.append(self._block(f"path_down.{level}.1", avg_pool2d(maps[-1], 2)))
        up = maps.pop()
        for level in range(3):
            up = self._block(f"path_up.{level}.conv", torch.cat([_doubled(up), maps.pop()], 1))
        features = DenseFeatures(up, maps.pop(), *self._statistics(up, padded.shape[2]))
        features = self._with_fine_statistics(features)
        return features, self._score_map(features)[:height, :width]

    def describe(self, features: DenseFeatures, index_px: Tensor) -> Tensor:
        """Descriptors (N, D) of unit length at whole pixels (N, 2), (x, y) from the top-left one."""
        if len(index_px) == 0:
            return index_px.new_zeros((0, self.descriptor_size), dtype=torch.float32)
        return torch.cat([self._describe(features, part.long()) for part in index_px.split(_CHUNK)])

    def _conv(self, name: str, x: Tensor) -> Tensor:
        return conv2d(x, self._weights[f"{name}.weight"], self._weights[f"{name}.bias"], padding=_MARGIN)

    def _block(self, name: str, x: Tensor) -> Tensor:
        mean, factor = _moments(x)
        return self._conv(f"{name}.3", self._gated(name, x, mean, factor))

    def _gated(self, name: str, x: Tensor, mean: Tensor, factor: Tensor) -> Tensor:
        """Normalised and through PReLU, in place: x (..., C, H, W)."""
        x = x.sub_(mean[:, None, None]).mul_(factor[:, None, None])
        return torch.prelu(x, self._weights[f"{name}.1.weight"])

    def _statistics(self, half: Tensor, rows: int) -> tuple[Tensor, Tensor]:
        """Mean and factor (C,) of the half-resolution map after its enlargement, strip by strip."""
        total = half.new_zeros(half.shape[1], dtype=torch.float64)
        squares = total.clone()
        count = 0
        for begin in range(0, rows, _STRIP):
            strip = _doubled_rows(half, begin, min(begin + _STRIP, rows))[0].flatten(1)
            total += strip.sum(1)
            squares += (strip * strip).sum(1)
            count += strip.shape[1]
        mean = total / count
        return mean.float(), (squares / count - mean * mean + _EPSILON).rsqrt().float()

    def _with_fine_statistics(self, features: DenseFeatures) -> DenseFeatures:
        mean, factor = _moments(features.fine)
        both = torch.cat([features.mean, mean]), torch.cat([features.factor, factor])
        return DenseFeatures(features.half, features.fine, *both)

    def _score_map(self, features: DenseFeatures) -> Tensor:
        height, width = features.fine.shape[2:]
        bias = self._weights["path_up.3.conv.3.bias"][-1]
        parts = []
        for begin in range(0, height, _STRIP):
            end = min(begin + _STRIP, height)
            low, high = max(0, begin - _MARGIN), min(height, end + _MARGIN)
            block = torch.cat([_doubled_rows(features.half, low, high), features.fine[:, :, low:high]], 1)
            block = self._gated("path_up.3.conv", block, features.mean, features.factor)
            taps = linear(block[0].permute(1, 2, 0), self._score_taps).permute(2, 0, 1)  # (25, rows, W)
            above, below = low - begin + _MARGIN, end + _MARGIN - high
            taps = pad(taps, (_MARGIN, _MARGIN, above, below))
            strip = taps.new_zeros((end - begin, width))
            for tap in range(_SIZE * _SIZE):
                y, x = divmod(tap, _SIZE)
                strip += taps[tap, y : y + end - begin, x : x + width]
            parts.append(strip)
        return torch.cat(parts) + bias

    def _describe(self, features: DenseFeatures, pixels: Tensor) -> Tensor:
        count, (height, width) = len(pixels), features.fine.shape[2:]
        step = torch.arange(_SIZE * _SIZE, device=pixels.device)
        around = (pixels[:, None] + torch.stack([step % _SIZE, step // _SIZE], 1) - _MARGIN).flatten(0, 1)
        limit = torch.tensor([width - 1, height - 1], device=pixels.device)
        inside = ((around >= 0) & (around <= limit)).all(1)
        around = around.clamp(min=torch.zeros_like(limit), max=limit)
        fine = _rows(features.fine)[around[:, 1] * width + around[:, 0]]
        at = ((around + 0.5) / 2 - 0.5).clamp(min=0)  # of the pixel in the half-resolution map
        at = torch.minimum(at, (limit - 1) / 2)
        index, share = corners(at, (width // 2, height // 2))
        half = embedding_bag(index, _rows(features.half), per_sample_weights=share, mode="sum")
        x = (torch.cat([half, fine], 1) - features.mean) * features.factor
        x = torch.prelu(x, self._weights["path_up.3.conv.1.weight"]) * inside[:, None]
        bias = self._weights["path_up.3.conv.3.bias"][:-1]
        return normalize(linear(x.view(count, -1), self._descriptor_weight, bias))


def _moments(x: Tensor) -> tuple[Tensor, Tensor]:
    """Mean and factor (C,) of instance normalisation of a map (1, C, H, W)."""
    variance, mean = torch.var_mean(x[0], (1, 2), correction=0)
    return mean, (variance + _EPSILON).rsqrt()


def _doubled(x: Tensor) -> Tensor:
    return interpolate(x, scale_factor=2, mode="bilinear", align_corners=False)


def _doubled_rows(half: Tensor, begin: int, end: int) -> Tensor:
    """Rows begin to end of the doubled map, as if all of it had been doubled."""
    low, high = max(0, begin // 2 - 1), min(half.shape[2], (end + 1) // 2 + 1)
    return _doubled(half[:, :, low:high])[:, :, begin - 2 * low : end - 2 * low]


def _rows(x: Tensor) -> Tensor:
    """Features (H x W, C) of a map (1, C, H, W): the same memory where the map is kept channels last."""
    return x[0].permute(1, 2, 0).flatten(0, 1).contiguous()
