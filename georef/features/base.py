"""What an extractor and a matcher are, and what is done once for all of them: levels, order, pixel origin, colour."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from georef.geometry.pixels import level_size, resize_keypoints
from georef.types.features import Features, Matches

Image = NDArray[np.uint8]  # (H, W, 3), RGB
Descriptors = NDArray[np.float32] | NDArray[np.float16] | NDArray[np.uint8]  # (N, D)

SMALLEST_SIDE_PX = 16  # below this a level holds nothing that a detector could localise


@dataclass(frozen=True, eq=False)
class Detections:
    """What an extractor found in one level, in any order, in pixels of that level; (0.5, 0.5) is the first centre."""

    keypoints_px: NDArray[np.float32]  # (N, 2)
    scores: NDArray[np.float32]  # (N,)
    scales_px: NDArray[np.float32]  # (N,) size of what was localised: its noise scales with it
    descriptors: Descriptors  # (N, D)


class Extractor(Protocol):
    """Detects and describes keypoints of one image as it is given, at its own resolution."""

    @property
    def name(self) -> str: ...

    @property
    def descriptor_size(self) -> int: ...

    @property
    def descriptor_dtype(self) -> np.dtype: ...

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


def extract_features(extractor: Extractor, image_rgb: Image, longest_side: int, max_keypoints: int) -> Features:
    """Features of an image (H, W, 3) uint8 RGB, found in a level whose longest side is at most `longest_side` pixels.

    Keypoints and scales come back in pixels of the full-resolution image, sorted by falling score. An image without
    structure, or with a level smaller than `SMALLEST_SIDE_PX`, gives empty features of the right shapes.
    """
    _check_image(image_rgb)
    image_size = (image_rgb.shape[1], image_rgb.shape[0])
    level = resize_image(image_rgb, level_size(image_size, longest_side))
    if min(level.shape[:2]) < SMALLEST_SIDE_PX or max_keypoints <= 0:
        return empty_features(extractor, image_size)
    found = extractor.detect(level, max_keypoints)
    return _to_full_resolution(found, level, image_size).head(max_keypoints)


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


def _to_full_resolution(found: Detections, level: Image, image_size: tuple[int, int]) -> Features:
    x, y = found.keypoints_px.T
    order = np.lexsort((x, y, -found.scores))  # the place decides between equal scores: the same on every machine
    keypoints = found.keypoints_px[order]
    level_size_px = (level.shape[1], level.shape[0])
    column, row = np.clip(keypoints.astype(np.int64), 0, np.array(level_size_px) - 1).T
    full = resize_keypoints(keypoints, from_size=level_size_px, to_size=image_size)
    enlargement = max(image_size) / max(level_size_px)
    return Features(
        image_size=image_size,
        keypoints_px=full.astype(np.float32),
        scores=found.scores[order],
        scales_px=found.scales_px[order] * np.float32(enlargement),
        descriptors=found.descriptors[order],
        colors_rgb=level[row, column],
    )


def _check_image(image_rgb: Image) -> None:
    if image_rgb.ndim != 3 or image_rgb.shape[2] != 3 or image_rgb.dtype != np.uint8 or image_rgb.size == 0:
        raise ValueError(f"expected an RGB image (H, W, 3) of uint8, got {image_rgb.shape} of {image_rgb.dtype}")
