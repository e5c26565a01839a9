"""Keypoints from a score map: strict local maxima, placed within the pixel by a soft maximum or a parabola.

Pixels are (x, y) with the top-left pixel's centre at (0, 0), as networks have them.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import grid_sample

RADIUS = 2  # pixels; a maximum exceeds everything in its window of 5 x 5
_SHARPNESS = 10.0  # of the soft maximum: weights are exp(10 (score - peak))


def find_peaks(score_map: Tensor, threshold: float, max_keypoints: int) -> tuple[Tensor, Tensor]:
    """Keypoints (N, 2) at soft maxima, and scores (N,), of a map (H, W).

    The `max_keypoints` highest maxima, 2 px or more from the border, whose score at the refined place exceeds the
    threshold; the score is the map's there, by bilinear interpolation.
    """
    height, width = score_map.shape
    index = strict_maxima(score_map, threshold, max_keypoints)
    windows = _windows(score_map, index, RADIUS)
    peak = windows[:, windows.shape[1] // 2, None]
    shares = ((windows - peak) * _SHARPNESS).exp()
    refined = shares @ _offsets(score_map, RADIUS) / shares.sum(1, keepdim=True)
    keypoints = pixels_of(index, width) + refined
    grid = keypoints / keypoints.new_tensor([width - 1, height - 1]) * 2 - 1
    scores = grid_sample(score_map[None, None], grid[None, None], mode="bilinear", align_corners=True)[0, 0, 0]
    keep = scores > threshold
    return keypoints[keep], scores[keep]


def strict_maxima(score_map: Tensor, threshold: float, count: int, radius: int = RADIUS) -> Tensor:
    """Row-major indices of the at most `count` highest pixels of a map (H, W) that exceed the threshold and everything
    else in the window of `radius` pixels about them, which lies within the map."""
    index = _maxima(score_map, threshold, radius)
    windows = _windows(score_map, index, radius)
    peak = windows[:, windows.shape[1] // 2, None]
    strict = (windows >= peak).sum(1) == 1
    index, peak = index[strict], peak[strict]
    return index[peak[:, 0].topk(count).indices] if len(index) > count else index


def pixels_of(index: Tensor, width: int) -> Tensor:
    """Whole pixels (N, 2) of row-major indices (N,), float32."""
    return torch.stack([index % width, index // width], 1).float()


def parabola_offsets(score_map: Tensor, index: Tensor) -> Tensor:
    """Where (N, 2) within (-0.5, 0.5) px the parabolas through a maximum and its neighbours along x and y are highest.

    index: strict maxima, off the border; then both parabolas open downwards.
    """
    flat, width = score_map.reshape(-1), score_map.shape[1]
    parts = []
    for step in (1, width):
        before, here, after = flat[index - step], flat[index], flat[index + step]
        parts.append((after - before) / (2 * (2 * here - before - after)))
    return torch.stack(parts, 1)


def _maxima(score_map: Tensor, threshold: float, radius: int) -> Tensor:
    """Row-major indices of pixels that nothing in their window exceeds, off the border."""
    height, width = score_map.shape
    inner_height, inner_width = height - 2 * radius, width - 2 * radius
    if inner_height <= 0 or inner_width <= 0:
        return torch.zeros(0, dtype=torch.long, device=score_map.device)
    highest = score_map[:, :inner_width]
    for shift in range(1, 2 * radius + 1):
        highest = torch.maximum(highest, score_map[:, shift : shift + inner_width])
    wide, highest = highest, highest[:inner_height]
    for shift in range(1, 2 * radius + 1):
        highest = torch.maximum(highest, wide[shift : shift + inner_height])
    inner = score_map[radius:-radius, radius:-radius]
    row, column = torch.nonzero((inner == highest) & (inner > threshold), as_tuple=True)
    return (row + radius) * width + column + radius


def _windows(score_map: Tensor, index: Tensor, radius: int) -> Tensor:
    """Scores (N, window) of the windows around pixels, row by row."""
    offsets = _offsets(score_map, radius).long()
    around = index[:, None] + offsets[:, 1] * score_map.shape[1] + offsets[:, 0]
    return score_map.reshape(-1)[around]


def _offsets(like: Tensor, radius: int) -> Tensor:
    side = torch.arange(-radius, radius + 1, device=like.device, dtype=torch.float32)
    y, x = torch.meshgrid(side, side, indexing="ij")
    return torch.stack([x, y], -1).view(-1, 2)
