"""The network of RDD (Chen et al. 2025): keypoints from a small residual network, descriptors from a deformable
transformer over the levels of a ResNet-50 (Zhu et al. 2021, Deformable DETR, encoder alone).

Pixels are (x, y) with the top-left pixel's centre at (0, 0), as the network has them.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn.functional import (
    conv2d,
    embedding_bag,
    grid_sample,
    group_norm,
    interpolate,
    layer_norm,
    linear,
    max_pool2d,
    normalize,
    pad,
    relu,
)

from georef.features.corners import corners
from georef.features.folding import fold

MULTIPLE = 32  # sides that the levels divide
WIDTH = 256  # channels of the transformer
_HEADS, _LEVELS, _POINTS = 8, 5, 8  # points that a head looks at in each level
_BLOCKS = (3, 4, 6, 3)  # of ResNet-50
_QUERIES = 4096  # tokens handled at once: 5.2 million lookups, 0.2 GB


class RddNetwork:
    """RDD from weights in the authors' layout (`detector.*`, `descriptor.*`)."""

    descriptor_size = WIDTH

    def __init__(self, weights: dict[str, Tensor], device: torch.device) -> None:
        folded = dict(weights)
        for key in (key for key in weights if key.endswith(".running_mean") and "matchibility" not in key):
            norm = key.removesuffix(".running_mean")
            folded.update(fold(weights, _conv_before(norm), norm))
        self._weights = {key: tensor.to(device) for key, tensor in folded.items()}
        self._layers = sum(key.endswith("self_attn.value_proj.weight") for key in weights)  # four, as published

    def dense(self, image: Tensor) -> tuple[Tensor, Tensor]:
        """Descriptors of cells of 4 px (1, 256, h, w) and the score map (H, W) of an image (3, H, W), RGB in [0, 1]."""
        height, width = image.shape[1:]
        x = pad(image[None], (0, -width % MULTIPLE, 0, -height % MULTIPLE), mode="replicate")
        return normalize(self._descriptors(x), dim=1), self._score_map(x)[:height, :width]

    def _conv(self, name: str, x: Tensor, stride: int = 1) -> Tensor:
        weight = self._weights[f"{name}.weight"]
        return conv2d(x, weight, self._weights.get(f"{name}.bias"), stride, padding=weight.shape[2] // 2)

    def _linear(self, name: str, x: Tensor) -> Tensor:
        return linear(x, self._weights[f"{name}.weight"], self._weights[f"{name}.bias"])

    def _norm(self, name: str, x: Tensor) -> Tensor:
        return layer_norm(x, (WIDTH,), self._weights[f"{name}.weight"], self._weights[f"{name}.bias"])

    def _score_map(self, x: Tensor) -> Tensor:
        x = relu(self._conv("detector.block1.conv2", relu(self._conv("detector.block1.conv1", x))))
        size, parts = x.shape[2:], [relu(self._conv("detector.conv1", x))]
        for block, pool in ((2, 2), (3, 4), (4, 4)):
            x, name = max_pool2d(x, pool), f"detector.block{block}"
            out = self._conv(f"{name}.conv2", relu(self._conv(f"{name}.conv1", x)))
            x = relu(out + self._conv(f"{name}.downsample", x))
            part = relu(self._conv(f"detector.conv{block}", x))
            parts.append(interpolate(part, size, mode="bilinear", align_corners=True))
        return torch.sigmoid(self._conv("detector.convhead2.0", torch.cat(parts, 1)))[0, 0]

    def _descriptors(self, x: Tensor) -> Tensor:
        levels = self._levels(x)
        sizes = [(level.shape[3], level.shape[2]) for level in levels]
        embedding = self._weights["descriptor.transformer.level_embed"]
        places = torch.cat([_encoding(size, x.device) + row for size, row in zip(sizes, embedding, strict=True)])
        tokens = torch.cat([level[0].flatten(1).T for level in levels])
        centres = torch.cat([_centres(size, x.device) for size in sizes])
        for layer in range(self._layers):
            name = f"descriptor.transformer.encoder.layers.{layer}"
            tokens = self._norm(f"{name}.norm1", tokens + self._attend(name, tokens, places, centres, sizes))
            wide = self._linear(f"{name}.linear2", relu(self._linear(f"{name}.linear1", tokens)))
            tokens = self._norm(f"{name}.norm2", tokens + wide)
        maps = [
            part.T.reshape(1, WIDTH, height, width)
            for part, (width, height) in zip(tokens.split([w * h for w, h in sizes]), sizes, strict=True)
        ]
        finest = maps[0].shape[2:]
        coarser = (interpolate(part, finest, mode="bilinear", align_corners=True) for part in maps[1:])
        return maps[0] + sum(coarser)

    def _levels(self, x: Tensor) -> list[Tensor]:
        """The four levels of the ResNet and a coarser fifth, brought to the width of the transformer."""
        body = "descriptor.backbone.0.body"
        x = max_pool2d(relu(self._conv(f"{body}.conv1", x, 2)), 3, 2, padding=1)
        levels = []
        for stage, blocks in enumerate(_BLOCKS):
            for block in range(blocks):
                x = self._bottleneck(f"{body}.layer{stage + 1}.{block}", x, 2 if stage and not block else 1)
            levels.append(self._projected(stage, x, 1))
        return [*levels, self._projected(len(_BLOCKS), x, 2)]

    def _bottleneck(self, name: str, x: Tensor, stride: int) -> Tensor:
        out = relu(self._conv(f"{name}.conv1", x))
        out = self._conv(f"{name}.conv3", relu(self._conv(f"{name}.conv2", out, stride)))
        return relu(out + (self._conv(f"{name}.downsample.0", x, stride) if stride > 1 or _first(name) else x))

    def _projected(self, level: int, x: Tensor, stride: int) -> Tensor:
        name = f"descriptor.input_proj.{level}"
        weight, bias = self._weights[f"{name}.1.weight"], self._weights[f"{name}.1.bias"]
        return group_norm(self._conv(f"{name}.0", x, stride), 32, weight, bias)

    def _attend(
        self, name: str, tokens: Tensor, places: Tensor, centres: Tensor, sizes: list[tuple[int, int]]
    ) -> Tensor:
        """Each head of each token takes a weighted sum of values at computed places of all levels."""
        values = self._linear(f"{name}.self_attn.value_proj", tokens).view(len(tokens) * _HEADS, -1)
        parts = [
            self._taken(name, tokens[part] + places[part], values, centres[part], sizes)
            for part in torch.arange(len(tokens), device=tokens.device).split(_QUERIES)
        ]
        return self._linear(f"{name}.self_attn.output_proj", torch.cat(parts))

    def _taken(self, name: str, query: Tensor, values: Tensor, centres: Tensor, sizes: list[tuple[int, int]]) -> Tensor:
        count = len(query)
        shape = (count, _HEADS, _LEVELS, _POINTS)
        shifts = self._linear(f"{name}.self_attn.sampling_offsets", query).view(*shape, 2)
        shares = self._linear(f"{name}.self_attn.attention_weights", query).view(count, _HEADS, -1).softmax(-1)
        head = torch.arange(_HEADS, device=query.device)[None, :, None, None]
        index, share, start = [], [], 0
        for level, (width, height) in enumerate(sizes):
            middle = centres * centres.new_tensor([width, height]) - 0.5
            at = middle[:, None, None] + shifts[:, :, level]
            corner, part = corners(at.reshape(-1, 2), (width, height))
            index.append((corner.view(count, _HEADS, _POINTS, 4) + start) * _HEADS + head)
            share.append(part.view(count, _HEADS, _POINTS, 4) * shares.view(shape)[:, :, level, :, None])
            start += width * height
        bags, weights = (torch.stack(part, 2).view(count * _HEADS, -1) for part in (index, share))
        return embedding_bag(bags, values, per_sample_weights=weights, mode="sum").view(count, -1)


def sample_cells(cells: Tensor, pixels: Tensor, size: tuple[int, int]) -> Tensor:
    """Descriptors (N, 256) of unit length at pixels (N, 2) of a map of cells (1, 256, h, w).

    size: width and height of the image, filled up to multiples of 32, that the cells are of. A pixel x is looked up
    where the network was trained to look, at x w W / (W - 1)^2 - 0.5.
    """
    last = pixels.new_tensor(size) - 1
    grid = pixels * (last + 1) / (last * last) * 2 - 1
    return normalize(grid_sample(cells, grid[None, None], mode="bicubic", align_corners=False)[0, :, 0].T)


def _conv_before(norm: str) -> str:
    """Name of the convolution before a normalisation: `conv2` before `bn2`, `downsample.0` before `downsample.1`."""
    block, _, last = norm.rpartition(".")
    return f"{block}.{'conv' + last.removeprefix('bn') if last.startswith('bn') else '0'}"


def _first(name: str) -> bool:
    return name.endswith(".0")


def _centres(size: tuple[int, int], device: torch.device) -> Tensor:
    """Centres (w x h, 2) of the cells of a level in units of the image's sides."""
    width, height = size
    y, x = torch.meshgrid(_middles(height, device), _middles(width, device), indexing="ij")
    return torch.stack([x, y], -1).view(-1, 2)


def _middles(count: int, device: torch.device) -> Tensor:
    return (torch.arange(count, device=device) + 0.5) / count


def _encoding(size: tuple[int, int], device: torch.device) -> Tensor:
    """Sines and cosines (w x h, 256) that tell the transformer where in the image a cell lies, y before x."""
    half = WIDTH // 2
    steps = torch.arange(half, device=device)
    periods = 10000.0 ** (2 * (steps // 2) / half)
    turns = _centres(size, device).flip(1) * (2 * math.pi)
    angles = turns[:, :, None] / periods  # (cells, 2, half)
    return torch.stack([angles[..., 0::2].sin(), angles[..., 1::2].cos()], -1).flatten(1)
