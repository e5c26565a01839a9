"""A fair sample of bounded size from a stream of unknown length."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


class Reservoir:
    """Keeps `capacity` rows such that each row of the stream is kept with the same probability.

    Vitter (1985), algorithm R. The same stream and seed give the same sample.
    """

    def __init__(self, capacity: int, seed: int) -> None:
        self._capacity = capacity
        self._random = np.random.default_rng(seed)
        self._rows: NDArray[np.float32] | None = None
        self._seen = 0

    @property
    def rows(self) -> NDArray[np.float32]:
        """The sample (n, D), n at most the capacity; (0, 0) before the first row."""
        if self._rows is None:
            return np.zeros((0, 0), np.float32)
        return self._rows[: min(self._seen, self._capacity)]

    def places(self, count: int) -> NDArray[np.int64]:
        """Where the next `count` rows go, -1 for those not kept: known before they are computed."""
        order = self._seen + np.arange(count)
        drawn = self._random.integers(0, order + 1) if count else order
        self._seen += count
        return np.where(order < self._capacity, order, np.where(drawn < self._capacity, drawn, -1))

    def put(self, places: NDArray[np.int64], rows: NDArray[np.floating]) -> None:
        """Put rows (n, D) where `places` (n,) said; -1 leaves out. A later row replaces an earlier one."""
        kept = places >= 0
        if not kept.any():
            return
        held = self._rows
        if held is None:
            held = np.zeros((min(self._capacity, 1024), rows.shape[1]), np.float32)
        while places.max() >= len(held):  # grows as the stream does: a small map takes little memory
            more = min(len(held), self._capacity - len(held))
            held = np.concatenate([held, np.zeros((more, held.shape[1]), np.float32)])
        held[places[kept]] = rows[kept]
        self._rows = held

    def add(self, rows: NDArray[np.floating]) -> None:
        """Offer rows (n, D)."""
        self.put(self.places(len(rows)), rows)
