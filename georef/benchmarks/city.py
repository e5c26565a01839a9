"""Places and global descriptors of a city that was never photographed, as many as asked for.

Descriptors have the structure that makes a search easy or hard: images of one place are alike, those that look the
same way more so, places of one street share something, and a later epoch adds its own differences.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

PLACE_IMAGES = 50  # images of one place
PLACE_M = 10.0  # length of street that is one place
BLOCK_M = 100.0  # distance of parallel streets
VIEWS = 10  # directions that the cameras of a place look to
_CHUNK = 10_000  # images made at once
_PLACE, _STREET, _VIEW = 0.8, 0.4, 0.45  # shares of what images have in common, as lengths of vectors
_SPREAD_MAP, _SPREAD_QUERY = 0.8, 1.2  # lengths of what is an image's own


@dataclass(frozen=True, eq=False)
class Images:
    """Some images: positions (N, 3) in metres, headings (N,) in radians, unit descriptors (N, D), their places (N,)."""

    positions: NDArray[np.float64]
    headings: NDArray[np.float64]
    descriptors: NDArray[np.float32]
    places: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.positions)


@dataclass(frozen=True)
class City:
    """Streets on a grid with images along them in the order of a survey; the same for the same seed."""

    images: int
    size: int  # of a descriptor
    seed: int = 0

    @property
    def places(self) -> int:
        return -(-self.images // PLACE_IMAGES)

    def chunks(self) -> Iterator[Images]:
        """All images, 10,000 at once."""
        for number, start in enumerate(range(0, self.images, _CHUNK)):
            index = np.arange(start, min(start + _CHUNK, self.images))
            rng = np.random.default_rng([self.seed, 1, number])
            yield self._photographed(index // PLACE_IMAGES, index % PLACE_IMAGES, _SPREAD_MAP, rng)

    def queries(self, count: int) -> Images:
        """Images of a later epoch, at places drawn at random."""
        rng = np.random.default_rng([self.seed, 2])
        places = rng.integers(0, self.places, count)
        return self._photographed(places, rng.integers(0, PLACE_IMAGES, count), _SPREAD_QUERY, rng)

    def _photographed(self, place, number, spread: float, rng: np.random.Generator) -> Images:
        view = number % VIEWS
        descriptors = spread * self._directions(len(place), rng)
        descriptors += _PLACE * self._own[place]
        descriptors += _STREET * self._streets[self._street(place)]
        descriptors += _VIEW * self._views[view]
        descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
        along = (place % self._street_places + number / PLACE_IMAGES) * PLACE_M
        across = BLOCK_M * (self._street(place) // 2) + rng.normal(0, 1, len(place))
        turned = self._street(place) % 2 == 1
        positions = np.stack([np.where(turned, across, along), np.where(turned, along, across), 2 + 0 * along], axis=1)
        headings = (2 * np.pi / VIEWS * view + np.where(turned, np.pi / 2, 0)) % (2 * np.pi)
        return Images(positions, headings, descriptors, place)

    def _street(self, place: NDArray[np.int64]) -> NDArray[np.int64]:
        return place // self._street_places

    @cached_property
    def _street_places(self) -> int:
        """Places of one street, such that the grid is about square."""
        return max(1, round(np.sqrt(self.places * BLOCK_M / (2 * PLACE_M))))

    @cached_property
    def _own(self) -> NDArray[np.float32]:
        return self._directions(self.places, np.random.default_rng([self.seed, 3]))

    @cached_property
    def _streets(self) -> NDArray[np.float32]:
        count = int(self._street(np.array(self.places - 1))) + 1
        return self._directions(count, np.random.default_rng([self.seed, 4]))

    @cached_property
    def _views(self) -> NDArray[np.float32]:
        return self._directions(VIEWS, np.random.default_rng([self.seed, 5]))

    def _directions(self, count: int, rng: np.random.Generator) -> NDArray[np.float32]:
        rows = rng.standard_normal((count, self.size), dtype=np.float32)
        return rows / np.linalg.norm(rows, axis=1, keepdims=True)
