"""What an extractor and a matcher are, and what is done once for all of them: levels, colour, pixel origin."""

from __future__ import annotations

from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from georef.geometry.pixels import level_size, resize_keypoints
from georef.types.features import Features, Matches


class Extractor(Protocol):
    """Detects and describes keypoints of one image as it is given, at its own resolution."""

    name: str
    descriptor_size: int

    def version(self) -> str:
        """What decides the result beside the input: library versions, weights hash, fixed settings."""
        ...

    def detect(
        self, image_rgb: NDArray[np.uint8], max_keypoints: int
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32], NDArray[np.generic]]:
        """keypoints (N, 2) px with the top-left pixel's centre at (0.5, 0.5), scores (N,), scales (N,) px, descriptors (N, D)."""
        ...


class Matcher(Protocol):
    """Matches the features of two images; made for the descriptors of one kind of extractor."""

    name: str

    def version(self) -> str: ...

    def match(self, a: Features, b: Features) -> Matches: ...
