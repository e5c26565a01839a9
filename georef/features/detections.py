"""What an extractor finds in one level."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]  # (H, W, 3), RGB
Descriptors = NDArray[np.float32] | NDArray[np.float16] | NDArray[np.uint8]  # (N, D)


@dataclass(frozen=True, eq=False)
class Detections:
    """What an extractor found in one level, in any order, in pixels of that level; (0.5, 0.5) is the first centre."""

    keypoints_px: NDArray[np.float32]  # (N, 2)
    scores: NDArray[np.float32]  # (N,)
    scales_px: NDArray[np.float32]  # (N,) size of what was localised: its noise scales with it
    descriptors: Descriptors  # (N, D)
    orientations_rad: NDArray[np.float32] | None = None  # (N,) from x towards y, in (-pi, pi]; None: not detected

    def take(self, indices: NDArray[np.integer]) -> Detections:
        return Detections(
            self.keypoints_px[indices],
            self.scores[indices],
            self.scales_px[indices],
            self.descriptors[indices],
            None if self.orientations_rad is None else self.orientations_rad[indices],
        )

    @staticmethod
    def joined(parts: Sequence[Detections]) -> Detections:
        """All detections of one or more parts of one extractor, in their order."""
        orientations = [part.orientations_rad for part in parts if part.orientations_rad is not None]
        return Detections(
            np.concatenate([part.keypoints_px for part in parts]),
            np.concatenate([part.scores for part in parts]),
            np.concatenate([part.scales_px for part in parts]),
            cast(Descriptors, np.concatenate([part.descriptors for part in parts])),
            np.concatenate(orientations) if orientations else None,
        )
