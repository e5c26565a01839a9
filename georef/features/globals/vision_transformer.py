"""DINOv2's vision transformer (Oquab et al. 2023), with the parameter names of its authors' files."""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import torch
from torch import Tensor, nn
from torch.nn.functional import interpolate, scaled_dot_product_attention, silu

PATCH_PX = 14
_TRAINED_GRID = 37  # patches a side of the position embedding: 518 px
_GRID_OFFSET = (
    0.1  # of a patch, that the authors add before they take the ratio of grids; it moves the samples a little
)


@dataclass(frozen=True)
class VitSize:
    """Width, depth and heads; gated: the feed-forward part is SwiGLU (ViT-g) instead of a two-layer perceptron."""

    width: int
    depth: int
    heads: int
    gated: bool = False


VIT_B14 = VitSize(768, 12, 12)  # 86.6 M parameters
VIT_G14 = VitSize(1536, 40, 24, gated=True)  # 1,136 M


class VisionTransformer(nn.Module):
    """Tokens of an image (N, 3, h, w), both sides multiples of `PATCH_PX`, without register tokens."""

    def __init__(self, size: VitSize) -> None:
        super().__init__()
        self.cls_token = nn.Parameter(torch.zeros(1, 1, size.width))
        self.pos_embed = nn.Parameter(torch.zeros(1, 1 + _TRAINED_GRID**2, size.width))
        self.mask_token = nn.Parameter(torch.zeros(1, size.width))  # of the training; in the files
        self.patch_embed = _PatchEmbedding(size.width)
        self.blocks = nn.ModuleList(_Block(size) for _ in range(size.depth))
        self.norm = nn.LayerNorm(size.width, eps=1e-6)

    def forward(self, image: Tensor) -> tuple[Tensor, Tensor]:
        """The patches' features (N, width, h / 14, w / 14) and the image's token (N, width), normalised."""
        x = self.embed(image)
        for block in self.blocks:
            x = block(x)
        x = self.norm(x)
        rows, columns = (side // PATCH_PX for side in image.shape[2:])
        return x[:, 1:].transpose(1, 2).unflatten(2, (rows, columns)), x[:, 0]

    def values(self, image: Tensor, layer: int) -> Tensor:
        """What attention of block `layer` (from 0) hands on for each patch: its values (N, patches, width)."""
        x = self.embed(image)
        for block in self.blocks[:layer]:
            x = block(x)
        last = cast(_Block, self.blocks[layer])
        return last.attn.qkv(last.norm1(x)).chunk(3, -1)[2][:, 1:]

    def embed(self, image: Tensor) -> Tensor:
        """Tokens (N, 1 + patches, width) before the first block, the image's own first."""
        patches = self.patch_embed.proj(image)
        grid = self._positions(patches.shape[2], patches.shape[3])
        patches = (patches + grid).flatten(2).transpose(1, 2)
        first = (self.cls_token + self.pos_embed[:, :1]).expand(len(image), -1, -1)
        return torch.cat([first, patches], 1)

    def _positions(self, rows: int, columns: int) -> Tensor:
        grid = self.pos_embed[:, 1:].transpose(1, 2).unflatten(2, (_TRAINED_GRID, _TRAINED_GRID))
        if (rows, columns) == (_TRAINED_GRID, _TRAINED_GRID):
            return grid
        scale = [(side + _GRID_OFFSET) / _TRAINED_GRID for side in (rows, columns)]
        return interpolate(grid, scale_factor=scale, mode="bicubic")


class _PatchEmbedding(nn.Module):
    def __init__(self, width: int) -> None:
        super().__init__()
        self.proj = nn.Conv2d(3, width, PATCH_PX, PATCH_PX)


class _Block(nn.Module):
    def __init__(self, size: VitSize) -> None:
        super().__init__()
        self.norm1 = nn.LayerNorm(size.width, eps=1e-6)
        self.attn = _Attention(size.width, size.heads)
        self.ls1 = _Scale(size.width)
        self.norm2 = nn.LayerNorm(size.width, eps=1e-6)
        self.mlp = _GatedPerceptron(size.width) if size.gated else _Perceptron(size.width)
        self.ls2 = _Scale(size.width)

    def forward(self, x: Tensor) -> Tensor:
        x = x + self.ls1(self.attn(self.norm1(x)))
        return x + self.ls2(self.mlp(self.norm2(x)))


class _Attention(nn.Module):
    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self._heads = heads
        self.qkv = nn.Linear(width, 3 * width)
        self.proj = nn.Linear(width, width)

    def forward(self, x: Tensor) -> Tensor:
        query, key, value = (part.unflatten(-1, (self._heads, -1)).transpose(1, 2) for part in self.qkv(x).chunk(3, -1))
        return self.proj(scaled_dot_product_attention(query, key, value).transpose(1, 2).flatten(2))


class _Scale(nn.Module):
    def __init__(self, width: int) -> None:
        super().__init__()
        self.gamma = nn.Parameter(torch.ones(width))

    def forward(self, x: Tensor) -> Tensor:
        return x * self.gamma


class _Perceptron(nn.Module):
    def __init__(self, width: int) -> None:
        super().__init__()
        self.fc1 = nn.Linear(width, 4 * width)
        self.fc2 = nn.Linear(4 * width, width)

    def forward(self, x: Tensor) -> Tensor:
        return self.fc2(nn.functional.gelu(self.fc1(x)))


class _GatedPerceptron(nn.Module):
    def __init__(self, width: int) -> None:
        super().__init__()
        hidden = (4 * width * 2 // 3 + 7) // 8 * 8
        self.w12 = nn.Linear(width, 2 * hidden)
        self.w3 = nn.Linear(hidden, width)

    def forward(self, x: Tensor) -> Tensor:
        gate, value = self.w12(x).chunk(2, -1)
        return self.w3(silu(gate) * value)
