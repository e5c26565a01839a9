"""Local features of an image, and matches between two images."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from georef.geometry.pixels import turn_angles, turn_keypoints, turned_size


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
    quarter_turns: int = 0  # clockwise, of the picture that they were found in; all else is of the image itself

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
            self.quarter_turns,
        )

    @property
    def as_found(self) -> tuple[NDArray[np.float32], tuple[int, int]]:
        """Keypoints (N, 2), and width and height, in the picture as it was turned when they were found."""
        places = turn_keypoints(self.keypoints_px, size=self.image_size, quarter_turns=self.quarter_turns)
        return places.astype(np.float32), turned_size(self.image_size, self.quarter_turns)

    @property
    def orientations_as_found(self) -> NDArray[np.float32] | None:
        """Orientations (N,) in the picture as it was turned when they were found."""
        return None if self.orientations_rad is None else turn_angles(self.orientations_rad, self.quarter_turns)

    def turned_back(self, quarter_turns: int) -> Features:
        """Features of a picture that was turned clockwise, as features of the image itself."""
        places = turn_keypoints(self.keypoints_px, size=self.image_size, quarter_turns=-quarter_turns)
        size, turns = turned_size(self.image_size, quarter_turns), (self.quarter_turns + quarter_turns) % 4
        angles = None if self.orientations_rad is None else turn_angles(self.orientations_rad, -quarter_turns)
        return replace(
            self,
            image_size=size,
            keypoints_px=places.astype(np.float32),
            orientations_rad=angles,
            quarter_turns=turns,
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
