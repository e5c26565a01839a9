"""Levels larger than a network takes well: detection in overlapping tiles, put together again.

A keypoint belongs to the tile in whose part of the image it lies; parts meet in the middle of the overlaps. So none
comes from the margin of a tile, where the network sees a border that the image does not have.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from georef.features.detections import Detections, Image

OVERLAP_PX = 50  # of neighbouring tiles, at least
ALIGNMENT_PX = 32  # tiles begin at multiples of it, so that coarse grids of the networks lie as in the whole image
NMS_PX = 1.0  # of two keypoints of neighbouring tiles nearer to each other, the one of higher score stays


@dataclass(frozen=True)
class Span:
    """One tile along one axis, in pixels of the level: what is looked at, and the part whose keypoints are kept."""

    begin: int
    end: int
    keep_from: float
    keep_to: float


def spans(length: int, side: int) -> list[Span]:
    """Tiles of at most `side` pixels along an axis of `length` pixels."""
    if length <= side:
        return [Span(0, length, -np.inf, np.inf)]
    step = (side - OVERLAP_PX) // ALIGNMENT_PX * ALIGNMENT_PX
    last = -(-(length - side) // ALIGNMENT_PX) * ALIGNMENT_PX
    begins = [*range(0, last, step), last]
    ends = [*(begin + side for begin in begins[:-1]), length]
    seams = [(begin + end) / 2 for begin, end in zip(begins[1:], ends[:-1], strict=True)]
    borders = [-np.inf, *seams, np.inf]
    return [Span(*tile) for tile in zip(begins, ends, borders[:-1], borders[1:], strict=True)]


def detect_in_tiles(
    detect: Callable[[Image, int], Detections], level: Image, side: int, max_keypoints: int
) -> Detections:
    """The at most `max_keypoints` best detections of a level (H, W, 3), looked at in tiles of `side` pixels.

    Every tile may fill the whole budget: which places of an image are worth a keypoint is decided over all of it.
    """
    parts = []
    for rows in spans(level.shape[0], side):
        for columns in spans(level.shape[1], side):
            tile = np.ascontiguousarray(level[rows.begin : rows.end, columns.begin : columns.end])
            parts.append(_own_part(detect(tile, max_keypoints), columns, rows))
    tile_of = np.repeat(np.arange(len(parts)), [len(part.scores) for part in parts])
    whole = Detections.joined(parts)
    order = np.lexsort((*whole.keypoints_px.T, -whole.scores))
    whole, tile_of = whole.take(order), tile_of[order]
    return whole.take(np.flatnonzero(_seen_once(whole.keypoints_px, tile_of))[:max_keypoints])


def _own_part(found: Detections, columns: Span, rows: Span) -> Detections:
    """Detections of a tile in pixels of the level, those of its own part alone."""
    x, y = found.keypoints_px.astype(np.float64).T + np.array([[columns.begin], [rows.begin]])
    own = (x >= columns.keep_from) & (x < columns.keep_to) & (y >= rows.keep_from) & (y < rows.keep_to)
    return replace(found.take(np.flatnonzero(own)), keypoints_px=np.stack([x[own], y[own]], 1).astype(np.float32))


def _seen_once(keypoints_px: NDArray[np.float32], tile_of: NDArray[np.integer]) -> NDArray[np.bool_]:
    """Which keypoints (N, 2), the best first, stay: no better one of another tile lies within `NMS_PX`."""
    stay = np.ones(len(keypoints_px), np.bool_)
    pairs = (
        KDTree(keypoints_px).query_pairs(NMS_PX, output_type="ndarray") if len(keypoints_px) else np.zeros((0, 2), int)
    )
    pairs = pairs[tile_of[pairs[:, 0]] != tile_of[pairs[:, 1]]]
    for better, worse in sorted(map(tuple, np.sort(pairs, axis=1).tolist())):
        if stay[better]:
            stay[worse] = False
    return stay
