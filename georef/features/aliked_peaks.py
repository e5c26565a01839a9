"""Keypoints from a score map: strict local maxima, placed within the pixel by a soft maximum."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import grid_sample

RADIUS = 2  # pixels; a maximum exceeds everything in its window of 5 x 5
_SHARPNESS = 10.0  # of the soft maximum: weights are exp(10 (score - peak))


def find_peaks(score_map: Tensor, threshold: float, max_keypoints: int) -> tuple[Tensor, Tensor]:
    """Keypoints (N, 2), the top-left pixel's centre at (0, 0), and scores (N,), of a map (H, W).

    The `max_keypoints` highest maxima, 2 px or more from the border, whose score at the refined place exceeds the
    threshold; the score is the map's there, by bilinear interpolation.
    """
    height, width = score_map.shape
    index = _maxima(score_map, threshold)
    windows = _windows(score_map, index)
    peak = windows[:, windows.shape[1] // 2, None]
    strict = (windows >= peak).sum(1) == 1
    index, windows, peak = index[strict], windows[strict], peak[strict]
    if len(index) > max_keypoints:
        best = peak[:, 0].topk(max_keypoints).indices
        index, windows, peak = index[best], windows[best], peak[best]
    shares = ((windows - peak) * _SHARPNESS).exp()
    keypoints = torch.stack([index % width, index // width], 1) + shares @ _offsets(score_map) / shares.sum(
        1, keepdim=True
    )
    grid = keypoints / keypoints.new_tensor([width - 1, height - 1]) * 2 - 1
    scores = grid_sample(score_map[None, None], grid[None, None], mode="bilinear", align_corners=True)[0, 0, 0]
    keep = scores > threshold
    return keypoints[keep], scores[keep]


def _maxima(score_map: Tensor, threshold: float) -> Tensor:
    """Row-major indices of pixels that nothing in their window exceeds, off the border."""
    height, width = score_map.shape
    inner_height, inner_width = height - 2 * RADIUS, width - 2 * RADIUS
    if inner_height <= 0 or inner_width <= 0:
        return torch.zeros(0, dtype=torch.long, device=score_map.device)
    highest = score_map[:, :inner_width]
    for shift in range(1, 2 * RADIUS + 1):
        highest = torch.maximum(highest, score_map[:, shift : shift + inner_width])
    wide, highest = highest, highest[:inner_height]
    for shift in range(1, 2 * RADIUS + 1):
        highest = torch.maximum(highest, wide[shift : shift + inner_height])
    inner = score_map[RADIUS:-RADIUS, RADIUS:-RADIUS]
    row, column = torch.nonzero((inner == highest) & (inner > threshold), as_tuple=True)
    return (row + RADIUS) * width + column + RADIUS


def _windows(score_map: Tensor, index: Tensor) -> Tensor:
    """Scores (N, 25) of the windows around pixels."""
    offsets = _offsets(score_map).long()
    around = index[:, None] + offsets[:, 1] * score_map.shape[1] + offsets[:, 0]
    return score_map.reshape(-1)[around]


def _offsets(like: Tensor) -> Tensor:
    side = torch.arange(-RADIUS, RADIUS + 1, device=like.device, dtype=torch.float32)
    y, x = torch.meshgrid(side, side, indexing="ij")
    return torch.stack([x, y], -1).view(-1, 2)
