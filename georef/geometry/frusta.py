"""How much of what two cameras may see is the same: the overlap of their viewing frusta, without knowing the scene.

A frustum is the part of space in front of an image between a tenth of a reach and the reach. What hides what is not
known here: a wall between two cameras does not lessen their overlap.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from georef.geometry.camera import Camera
from georef.geometry.projection import Views
from georef.geometry.rigid import Array, Rigid3

_ACROSS, _DOWN, _DEPTHS = 8, 6, 6
_NEAREST_SHARE = 0.1  # of the reach
_AT_MOST = 1.0 + 1e-9  # rounding
_LARGEST_ANGLE_DEG = 60.0  # between two rays to one point: beyond it the point does not look the same


@dataclass(frozen=True, eq=False)
class Frusta:
    """The viewing frusta of posed cameras, all of one reach in metres."""

    views: Views
    sizes: Array  # (V, 2) image width and height, px
    reach_m: float

    @staticmethod
    def of(world_from_cams: Sequence[Rigid3], cameras: Sequence[Camera], reach_m: float) -> Frusta:
        sizes = np.array([[c.width, c.height] for c in cameras], dtype=np.float64).reshape(-1, 2)
        return Frusta(Views.of(world_from_cams, cameras), sizes, reach_m)

    def __len__(self) -> int:
        return len(self.views)

    def shared(self, index: int, others: Frusta, indices: NDArray[np.integer]) -> Array:
        """Overlap (K,) of one frustum with some of another set: 0 nothing in common, 1 all.

        The lesser of two shares: of this frustum in the other one, and of the other one in this.
        """
        own = self._samples(index)
        out = np.zeros(len(indices))
        for k, other in enumerate(indices):
            there = others._share_seen(int(other), own, self.views.centres[index])
            if there > 0.0:
                back = self._share_seen(index, others._samples(int(other)), others.views.centres[int(other)])
                out[k] = min(there, back)
        return out

    def _samples(self, index: int) -> Array:
        """Points (S, 3) that fill the frustum: a grid of pixels, at distances that grow by a factor."""
        width, height = self.sizes[index]
        x = (np.arange(_ACROSS) + 0.5) / _ACROSS * width
        y = (np.arange(_DOWN) + 0.5) / _DOWN * height
        pixels = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
        rays = self.views.rays(np.full(len(pixels), index), pixels)
        distance_m = np.geomspace(_NEAREST_SHARE * self.reach_m, self.reach_m, _DEPTHS)
        return (self.views.centres[index] + rays[:, None] * distance_m[None, :, None]).reshape(-1, 3)

    def _share_seen(self, index: int, points: Array, centre: Array) -> float:
        """Share of points (S, 3), seen from another centre, that this frustum holds and sees from a similar side."""
        pixels = self.views.project(np.full(len(points), index), points)
        rays, others = points - self.views.centres[index], points - centre
        distance, other_distance = np.linalg.norm(rays, axis=1), np.linalg.norm(others, axis=1)
        cosine = np.einsum("ni,ni->n", rays, others) / np.maximum(distance * other_distance, 1e-12)
        seen = ((pixels >= 0) & (pixels <= self.sizes[index])).all(axis=1) & (distance <= _AT_MOST * self.reach_m)
        return float(np.mean(seen & (cosine >= np.cos(np.radians(_LARGEST_ANGLE_DEG)))))
