"""Image observations of points, and scenes of posed images with the points they see."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from georef.geometry.rigid import Array


@dataclass(frozen=True, eq=False)
class Observations:
    """Image observations of points, in any order: row i is one point seen in one view.

    Pixels are observed full-resolution pixels.
    """

    point: NDArray[np.int64]  # (n,) index of the point
    view: NDArray[np.int64]  # (n,) index of the view (image)
    pixel: Array  # (n, 2)
    sigma_px: Array  # (n,) 1-sigma of each coordinate
    keypoint: NDArray[np.int64]  # (n,) index of the keypoint in its image, -1 for a mark

    def __len__(self) -> int:
        return len(self.point)

    @staticmethod
    def joined(parts: Iterable[Observations]) -> Observations:
        """All observations of any number of parts, in their order."""
        none = np.zeros(0, np.int64)
        every = [Observations(none, none, np.zeros((0, 2)), np.zeros(0), none), *parts]
        fields = ("point", "view", "pixel", "sigma_px", "keypoint")
        return Observations(*(np.concatenate([getattr(part, name) for part in every]) for name in fields))

    def take(self, selection: NDArray[np.bool_] | NDArray[np.integer]) -> Observations:
        return Observations(
            self.point[selection],
            self.view[selection],
            self.pixel[selection],
            self.sigma_px[selection],
            self.keypoint[selection],
        )

    def with_points(self, point: NDArray[np.int64]) -> Observations:
        """The same observations of renumbered points."""
        return Observations(point, self.view, self.pixel, self.sigma_px, self.keypoint)

    def scaled(self, factor: float) -> Observations:
        """The same observations with all sigmas multiplied by a factor."""
        return Observations(self.point, self.view, self.pixel, self.sigma_px * factor, self.keypoint)


@dataclass(frozen=True, eq=False)
class ImageStructure:
    """The map points that keypoints of one reference image belong to, each with all observations of its track."""

    keypoint: NDArray[np.int64]  # (P,) of this image, rising
    identity: NDArray[np.int64]  # (P, 2) first observation of the track: image, keypoint; the same from every image
    points: Array  # (P, 3) in world
    cov: Array  # (P, 3, 3) of the image noise
    observations: Observations  # view is the place of an image among all references

    @staticmethod
    def empty() -> ImageStructure:
        """Of a reference image that has no points."""
        none = np.zeros(0, np.int64)
        observations = Observations(none, none, np.zeros((0, 2)), np.zeros(0), none)
        return ImageStructure(none, np.zeros((0, 2), np.int64), np.zeros((0, 3)), np.zeros((0, 3, 3)), observations)

    def __len__(self) -> int:
        return len(self.keypoint)
