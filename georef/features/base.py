"""What an extractor and a matcher are, and what is done once for all of them: levels, order, pixel origin, colour."""

from __future__ import annotations

from typing import Protocol

import cv2
import numpy as np

from georef.features.detections import Descriptors, Detections, Image
from georef.features.tiling import detect_in_tiles
from georef.geometry.pixels import level_size, resize_keypoints
from georef.types.features import Features, Matches

__all__ = ["EXTRACTION_VERSION", "Descriptors", "Detections", "Extractor", "Image", "Matcher", "extract_features"]

EXTRACTION_VERSION = 1  # rises when the same detections of a level give other features: tiles, structure, resampling
SMALLEST_SIDE_PX = 16  # below this a level holds nothing that a detector could localise
STRUCTURE_RADIUS_PX = 4  # of the window in a level about a keypoint that must show something
_BUDGETS = ((1024, 4096), (2048, 6144))  # keypoints of levels whose longest side is at most so many pixels
_BUDGET_PER_MEGAPIXEL = 1024  # of larger levels


class Extractor(Protocol):
    """Detects and describes keypoints of one image as it is given, at its own resolution."""

    @property
    def name(self) -> str: ...

    @property
    def descriptor_size(self) -> int: ...

    @property
    def descriptor_dtype(self) -> np.dtype: ...

    @property
    def largest_side_px(self) -> int | None:
        """Longest side of a level that is looked at as a whole; larger ones in tiles. None: any."""
        ...

    @property
    def tile_side_px(self) -> int:
        """Side of those tiles."""
        ...

    def version(self) -> str:
        """What decides the result beside the input: library versions, weights hash, fixed settings."""
        ...

    def detect(self, image_rgb: Image, max_keypoints: int) -> Detections:
        """The at most `max_keypoints` best keypoints of an image (H, W, 3) with sides of `SMALLEST_SIDE_PX` or more."""
        ...


class Matcher(Protocol):
    """Matches the features of two images; made for the descriptors of one kind of extractor."""

    @property
    def name(self) -> str: ...

    def version(self) -> str:
        """What decides the result beside the input: library versions, weights hash, fixed settings."""
        ...

    def match(self, a: Features, b: Features) -> Matches:
        """Pairs of indices into `a` and `b`, each index at most once."""
        ...


def extract_features(
    extractor: Extractor, image_rgb: Image, longest_side: int | None, max_keypoints: int | None
) -> Features:
    """Features of an image (H, W, 3) uint8 RGB, found in a level whose longest side is at most `longest_side` pixels.

    longest_side: None for the full resolution. max_keypoints: None for the budget of the level.
    Keypoints and scales come back in pixels of the full-resolution image, sorted by falling score. An image without
    structure, or with a level smaller than `SMALLEST_SIDE_PX`, gives empty features of the right shapes.
    """
    _check_image(image_rgb)
    image_size = (image_rgb.shape[1], image_rgb.shape[0])
    size = level_size(image_size, max(image_size) if longest_side is None else longest_side)
    budget = level_budget(size) if max_keypoints is None else max_keypoints
    if min(size) < SMALLEST_SIDE_PX or budget <= 0:
        return empty_features(extractor, image_size)
    level = resize_image(image_rgb, size)
    found = _with_structure(_detect(extractor, level, budget), level)
    return _to_full_resolution(found, level, image_size).head(budget)


def level_budget(size: tuple[int, int]) -> int:
    """Keypoints that a level (width, height) is worth: 4,096 up to 1024 px, 6,144 up to 2048 px, then 1,024 a megapixel
    and no fewer than 6,144."""
    for side, budget in _BUDGETS:
        if max(size) <= side:
            return budget
    return max(_BUDGETS[-1][1], round(size[0] * size[1] * 1e-6 * _BUDGET_PER_MEGAPIXEL))


def _detect(extractor: Extractor, level: Image, max_keypoints: int) -> Detections:
    if extractor.largest_side_px is None or max(level.shape[:2]) <= extractor.largest_side_px:
        return extractor.detect(level, max_keypoints)
    return detect_in_tiles(extractor.detect, level, extractor.tile_side_px, max_keypoints)


def empty_features(extractor: Extractor, image_size: tuple[int, int]) -> Features:
    """No features, with the shapes and types of this extractor; image_size is (width, height)."""
    descriptors = np.zeros((0, extractor.descriptor_size), extractor.descriptor_dtype)
    none = np.zeros(0, np.float32)
    return Features(image_size, np.zeros((0, 2), np.float32), none, none, descriptors, np.zeros((0, 3), np.uint8))


def resize_image(image_rgb: Image, size: tuple[int, int]) -> Image:
    """The image brought down to `size` (width, height) by averaging areas, which moves no edge; never enlarged."""
    if size == (image_rgb.shape[1], image_rgb.shape[0]):
        return np.ascontiguousarray(image_rgb)
    return np.asarray(cv2.resize(image_rgb, size, interpolation=cv2.INTER_AREA), np.uint8)


def _with_structure(found: Detections, level: Image) -> Detections:
    """Detections about which the level is not all of one colour; networks find some in saturated sky and blank frames,
    near borders above all."""
    size = np.array([level.shape[1], level.shape[0]])
    side = np.arange(-STRUCTURE_RADIUS_PX, STRUCTURE_RADIUS_PX + 1)
    window = np.stack(np.meshgrid(side, side), -1).reshape(-1, 2)
    around = np.clip(found.keypoints_px.astype(np.int64)[:, None] + window, 0, size - 1)
    colours = level[around[..., 1], around[..., 0]]  # (N, window, 3)
    return found.take(np.flatnonzero((colours != colours[:, :1]).any((1, 2))))


def _to_full_resolution(found: Detections, level: Image, image_size: tuple[int, int]) -> Features:
    x, y = found.keypoints_px.T
    order = np.lexsort((x, y, -found.scores))  # the place decides between equal scores: the same on every machine
    keypoints = found.keypoints_px[order]
    level_size_px = (level.shape[1], level.shape[0])
    column, row = np.clip(keypoints.astype(np.int64), 0, np.array(level_size_px) - 1).T
    full = resize_keypoints(keypoints, from_size=level_size_px, to_size=image_size)
    enlargement = max(image_size) / max(level_size_px)
    orientations = found.orientations_rad
    return Features(
        image_size=image_size,
        keypoints_px=full.astype(np.float32),
        scores=found.scores[order],
        scales_px=found.scales_px[order] * np.float32(enlargement),
        descriptors=found.descriptors[order],
        colors_rgb=level[row, column],
        orientations_rad=None if orientations is None else orientations[order],
    )


def _check_image(image_rgb: Image) -> None:
    if image_rgb.ndim != 3 or image_rgb.shape[2] != 3 or image_rgb.dtype != np.uint8 or image_rgb.size == 0:
        raise ValueError(f"expected an RGB image (H, W, 3) of uint8, got {image_rgb.shape} of {image_rgb.dtype}")
