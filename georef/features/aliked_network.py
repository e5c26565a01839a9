"""The pass through ALIKED's network, written for little time and memory on the CPU; same output as kornia's module.

The usual form builds a map of 128 normalised features for every pixel (1.4 GB at 2048 x 1365, twice). Here the score
map takes its share of the coarse levels after their projection to 8 channels, which commutes with the enlargement, and
features are formed only at the pixels that descriptors look at. Batch normalisation is folded into the convolutions.

Pixels are (x, y) with the top-left pixel's centre at (0, 0), as the network has them.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, conv2d, embedding_bag, interpolate, linear, normalize, pad, selu

from georef.features.corners import corners

PATCH = 3  # pixels of the window that a descriptor's sampling positions are computed from
_MULTIPLE = 32  # sides that the four levels divide
_STRIP = 65536  # pixels whose 32 channels of full resolution exist at once: 8 MB
_CHUNK = 1024  # keypoints described at once: 38 MB of features


@dataclass(frozen=True)
class FeatureLevels:
    """The image's features at four resolutions, from which those of any pixel are formed."""

    tables: list[Tensor]  # (rows x columns, C) of the full, half, eighth and thirty-second resolution
    grids: list[tuple[int, int]]  # rows, columns
    origin: tuple[int, int]  # of the image in the padded one, x and y
    image_size: tuple[int, int]  # width, height


class AlikedNetwork:
    """ALIKED of any size (n16, n16rot, n32) from its published weights."""

    def __init__(self, weights: dict[str, Tensor], device: torch.device) -> None:
        self._weights = {key: tensor.to(device) for key, tensor in _fold_normalisation(weights).items()}
        self.descriptor_size = weights["desc_head.sf_conv.weight"].shape[0]

    def dense(self, image: Tensor) -> tuple[FeatureLevels, Tensor]:
        """Feature levels, and the score map (H, W) in (0, 1), of an image (3, H, W) of RGB in [0, 1]."""
        height, width = image.shape[1:]
        padded, origin = _padded(image[None])
        fine = self._plain_block("block1", padded)
        half = self._residual_block("block2", avg_pool2d(fine, 2))
        eighth = self._deformable_block("block3", avg_pool2d(half, 4))
        coarse = self._deformable_block("block4", avg_pool2d(eighth, 4))
        levels = [fine] + [self._gated(f"conv{i}", x) for i, x in ((2, half), (3, eighth), (4, coarse))]
        score_map = self._score_map(levels)[origin[1] : origin[1] + height, origin[0] : origin[0] + width]
        grids = [(level.shape[2], level.shape[3]) for level in levels]
        return FeatureLevels([_rows(level) for level in levels], grids, origin, (width, height)), score_map

    def describe(self, levels: FeatureLevels, keypoints: Tensor) -> Tensor:
        """Descriptors (N, D) of unit length at keypoints (N, 2)."""
        if len(keypoints) == 0:
            return keypoints.new_zeros((0, self.descriptor_size))
        return torch.cat([self._describe(levels, part) for part in keypoints.split(_CHUNK)])

    def _conv(self, name: str, x: Tensor, padding: int = 1) -> Tensor:
        return conv2d(x, self._weights[f"{name}.weight"], self._weights.get(f"{name}.bias"), padding=padding)

    def _gated(self, name: str, x: Tensor) -> Tensor:
        return selu(self._conv(name, x, padding=0), inplace=True)

    def _plain_block(self, name: str, x: Tensor) -> Tensor:
        x = selu(self._conv(f"{name}.conv1", x), inplace=True)
        return selu(self._conv(f"{name}.conv2", x), inplace=True)

    def _residual_block(self, name: str, x: Tensor) -> Tensor:
        out = self._conv(f"{name}.conv2", selu(self._conv(f"{name}.conv1", x), inplace=True))
        return selu(out.add_(self._conv(f"{name}.downsample", x, padding=0)), inplace=True)

    def _deformable_block(self, name: str, x: Tensor) -> Tensor:
        out = self._deformable(f"{name}.conv2", selu(self._deformable(f"{name}.conv1", x), inplace=True))
        return selu(out.add_(self._conv(f"{name}.downsample", x, padding=0)), inplace=True)

    def _deformable(self, name: str, x: Tensor) -> Tensor:
        """A 3x3 convolution that takes each of its nine inputs at a computed displacement."""
        rows, columns = x.shape[2:]
        limit = max(rows, columns) / 4
        shifts = self._conv(f"{name}.offset_conv", x).clamp(-limit, limit)[0].unflatten(0, (9, 2))  # dy, dx
        y, x0 = torch.meshgrid(_range(rows, x), _range(columns, x), indexing="ij")
        tap = _range(9, x)[:, None, None]
        at = torch.stack([x0 + tap % 3 - 1 + shifts[:, 1], y + tap // 3 - 1 + shifts[:, 0]], -1)  # (9, H, W, 2)
        index, share = corners(at.permute(1, 2, 0, 3).reshape(-1, 2), (columns, rows))
        taken = embedding_bag(index, _rows(x), per_sample_weights=share, mode="sum").view(rows * columns, -1)
        weight = self._weights[f"{name}.regular_conv.weight"]  # (out, in, 3, 3)
        out = linear(taken, weight.flatten(2).transpose(1, 2).flatten(1), self._weights[f"{name}.regular_conv.bias"])
        return out.view(1, rows, columns, -1).permute(0, 3, 1, 2)

    def _score_map(self, levels: list[Tensor]) -> Tensor:
        first = self._weights["score_head.0.weight"]  # (8, 4 x C): one share a level
        shares = first.split(first.shape[1] // 4, dim=1)
        size = levels[0].shape[2:]
        total = first.new_zeros((1, first.shape[0], *size)).contiguous(memory_format=torch.channels_last)
        for level, share in zip(levels[1:], shares[1:], strict=True):
            total += interpolate(conv2d(level, share), size=size, mode="bilinear", align_corners=True)
        rows, sums = _rows(levels[0]), _rows(total)
        for strip, part in zip(rows.split(_STRIP), sums.split(_STRIP), strict=True):
            part += linear(self._fine_features(strip), shares[0].flatten(1))
        x = selu(total, inplace=True)
        for layer in ("score_head.2", "score_head.4"):
            x = selu(self._conv(layer, x), inplace=True)
        return torch.sigmoid(self._conv("score_head.6", x))[0, 0]

    def _describe(self, levels: FeatureLevels, keypoints: Tensor) -> Tensor:
        count, size = len(keypoints), torch.tensor(levels.image_size, device=keypoints.device)
        limit = max(levels.image_size) / 4
        corner = torch.minimum((keypoints.long() - 1).clamp(min=0), size - 1 - PATCH)
        step = torch.arange(PATCH * PATCH, device=keypoints.device)
        window = corner[:, None] + torch.stack([step % PATCH, step // PATCH], -1)
        patches = self._features_at(levels, window.reshape(-1, 2)).view(count, PATCH * PATCH, -1)
        shifts = self._sampling_shifts(patches).clamp(-limit, limit)
        index, share = corners((keypoints[:, None] + shifts).reshape(-1, 2), levels.image_size)
        pixels = torch.stack([index % size[0], index // size[0]], -1).reshape(-1, 2)
        around = self._features_at(levels, pixels).view(*index.shape, -1)
        taken = (share[:, None] @ around)[:, 0]
        taken = selu(linear(taken, self._weights["desc_head.sf_conv.weight"].flatten(1)), inplace=True)
        mixing = self._weights["desc_head.agg_weights"]  # (positions, D, D)
        return normalize(taken.view(count, -1) @ mixing.flatten(0, 1))

    def _sampling_shifts(self, patches: Tensor) -> Tensor:
        """Displacements (N, positions, 2) from the features of the windows (N, 9, C)."""
        weight = self._weights["desc_head.offset_conv.0.weight"]
        x = linear(
            patches.flatten(1),
            weight.flatten(2).transpose(1, 2).flatten(1),
            self._weights["desc_head.offset_conv.0.bias"],
        )
        name = "desc_head.offset_conv.2"
        x = linear(selu(x, inplace=True), self._weights[f"{name}.weight"].flatten(1), self._weights[f"{name}.bias"])
        return x.view(len(x), 2, -1).transpose(1, 2)

    def _fine_features(self, rows: Tensor) -> Tensor:
        return selu(linear(rows, self._weights["conv1.weight"].flatten(1)), inplace=True)

    def _features_at(self, levels: FeatureLevels, pixels: Tensor) -> Tensor:
        """Features (P, D) of unit length of whole pixels (P, 2)."""
        place = pixels + torch.tensor(levels.origin, device=pixels.device)
        rows, columns = levels.grids[0]
        fine = levels.tables[0][place[:, 1] * columns + place[:, 0]]
        parts = [self._fine_features(fine)]
        full = torch.tensor([columns - 1, rows - 1], device=pixels.device)
        for table, grid in zip(levels.tables[1:], levels.grids[1:], strict=True):
            last = torch.tensor([grid[1] - 1, grid[0] - 1], device=pixels.device)
            index, share = corners(place * (last / full), (grid[1], grid[0]))
            parts.append(embedding_bag(index, table, per_sample_weights=share, mode="sum"))
        return normalize(torch.cat(parts, 1))


def _fold_normalisation(weights: dict[str, Tensor]) -> dict[str, Tensor]:
    """The weights with each batch normalisation made part of the convolution before it."""
    folded = {key: tensor for key, tensor in weights.items() if ".bn" not in key}
    for key in (key for key in weights if key.endswith(".running_var")):
        block, bn, _ = key.split(".")
        name = f"{block}.conv{bn.removeprefix('bn')}"
        name = name if f"{name}.weight" in weights else f"{name}.regular_conv"
        factor = weights[f"{block}.{bn}.weight"] / (weights[key] + 1e-5).sqrt()
        folded[f"{name}.weight"] = weights[f"{name}.weight"] * factor[:, None, None, None]
        folded[f"{name}.bias"] = weights[f"{block}.{bn}.bias"] - weights[f"{block}.{bn}.running_mean"] * factor
    return folded


def _padded(image: Tensor) -> tuple[Tensor, tuple[int, int]]:
    """The image (1, 3, H, W) amid repeated border pixels, both sides multiples of 32, and its origin in that."""
    missing = [-side % _MULTIPLE for side in (image.shape[3], image.shape[2])]
    x, y = (side // 2 for side in missing)
    padded = pad(image, (x, missing[0] - x, y, missing[1] - y), mode="replicate")
    # that order halves the time of all that follows
    return padded.contiguous(memory_format=torch.channels_last), (x, y)


def _rows(x: Tensor) -> Tensor:
    """Features (H x W, C) of a map (1, C, H, W): the same memory where the map is kept channels last."""
    return x[0].permute(1, 2, 0).flatten(0, 1).contiguous()


def _range(count: int, like: Tensor) -> Tensor:
    return torch.arange(count, device=like.device, dtype=torch.float32)
