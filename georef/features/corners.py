"""Bilinear interpolation at scattered places of a table of features."""

from __future__ import annotations

import torch
from torch import Tensor


def corners(at: Tensor, size: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """Row-major indices (P, 4) of the four pixels around places (P, 2), and their shares (P, 4) in bilinear
    interpolation; what lies outside the map of `size` (width, height) has no share."""
    width, height = size
    low = at.floor()
    high_share = at - low
    x, y = low.long().unbind(1)
    index, share = [], []
    for dy in (0, 1):
        for dx in (0, 1):
            column, row = x + dx, y + dy
            inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
            part_x = high_share[:, 0] if dx else 1 - high_share[:, 0]
            part_y = high_share[:, 1] if dy else 1 - high_share[:, 1]
            index.append((row * width + column).where(inside, 0))
            share.append((part_x * part_y).where(inside, 0))
    return torch.stack(index, 1), torch.stack(share, 1)
