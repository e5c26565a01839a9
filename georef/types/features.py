"""Local features of an image, and matches between two images."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class Features:
    """Local features in pixels of the full-resolution image; the centre of the top-left pixel is (0.5, 0.5).

    Keypoints are sorted by falling score, so that the first n are the n best.
    """

    image_size: tuple[int, int]  # width, height
    keypoints_px: NDArray[np.float32]  # (N, 2)
    scores: NDArray[np.float32]  # (N,)
    scales_px: NDArray[
        np.float32
    ]  # (N,) size in full-resolution pixels of what the detector localised: its noise scales with it
    descriptors: NDArray[np.float32] | NDArray[np.float16] | NDArray[np.uint8]  # (N, D)
    colors_rgb: NDArray[np.uint8]  # (N, 3)
    orientations_rad: NDArray[np.float32] | None = None  # (N,) from x towards y, in (-pi, pi]; None: not detected

    def __len__(self) -> int:
        return len(self.keypoints_px)

    def head(self, count: int) -> Features:
        """The `count` features of highest score."""
        return self.take(np.arange(min(count, len(self))))

    def take(self, indices: NDArray[np.integer]) -> Features:
        return Features(
            self.image_size,
            self.keypoints_px[indices],
            self.scores[indices],
            self.scales_px[indices],
            self.descriptors[indices],
            self.colors_rgb[indices],
            None if self.orientations_rad is None else self.orientations_rad[indices],
        )


@dataclass(frozen=True, eq=False)
class Matches:
    """Pairs of keypoint indices of two images, each index at most once, with scores in [0, 1]."""

    indices: NDArray[np.int32]  # (M, 2)
    scores: NDArray[np.float32]  # (M,)

    def __len__(self) -> int:
        return len(self.indices)

    @staticmethod
    def empty() -> Matches:
        return Matches(np.zeros((0, 2), np.int32), np.zeros(0, np.float32))
