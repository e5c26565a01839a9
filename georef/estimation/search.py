"""The references that a query is compared with, in order: by global descriptors, by common local features, or both."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from georef.config import CandidatesConfig
from georef.estimation.candidates import Box, in_heading_window, vote
from georef.estimation.reference_map import ReferenceMap
from georef.geometry.rigid import Array
from georef.types.features import Features

_NEIGHBOURS_OF_A_POSE = 200


class FindSimilar(Protocol):
    """The vector database, asked for one query: whose global descriptors are nearest to the query's."""

    def __call__(self, count: int, box: Box, heading_rad: float | None, config: CandidatesConfig) -> NDArray[np.int64]:
        """At most `count` indices into the reference map, inside box, heading window and epochs, most similar first."""
        ...


@dataclass(frozen=True, eq=False)
class Search:
    """What one query is searched with. Without `find_similar` the ranking must be "votes"."""

    reference: ReferenceMap
    features: Features
    heading_rad: float | None
    config: CandidatesConfig
    find_similar: FindSimilar | None = None

    def ranked(self, box: Box) -> tuple[NDArray[np.int64], str]:
        """References that may show what the query shows, the most promising first, and a note where some were left."""
        config = self.config
        if config.ranking == "votes":
            inside = self._inside(box)
            left = len(inside) - config.max_searched
            note = f"searched the nearest {config.max_searched} of {len(inside)} references" if left > 0 else ""
            return self._by_votes(inside[: config.max_searched]), note
        if self.find_similar is None:
            raise ValueError(f"the ranking {config.ranking!r} needs a vector database")
        count = config.count if config.ranking == "global" else config.shortlist
        similar = self.find_similar(count, box, self.heading_rad, config)
        return similar if config.ranking == "global" else self._by_votes(similar), ""

    @property
    def positions(self) -> Array:
        """Positions (N, 3) of the references; NaN for those of epochs that do not take part."""
        if not self.config.epochs:
            return self.reference.positions
        return np.where(np.isin(self.reference.epochs, self.config.epochs)[:, None], self.reference.positions, np.nan)

    def with_neighbours(self, ranked: NDArray[np.int64], position: Array) -> NDArray[np.int64]:
        """The ranked references, then those nearest to a position (3,), which similarity may have missed."""
        distance = np.linalg.norm(self.positions - position, axis=1)
        near = np.argsort(distance, kind="stable")[:_NEIGHBOURS_OF_A_POSE]  # NaN comes last
        near = near[np.isfinite(distance[near])]
        return np.concatenate([ranked, near[~np.isin(near, ranked)]])

    def _inside(self, box: Box) -> NDArray[np.int64]:
        """References of the box that are in the heading window, in the order of the box."""
        headings = self.reference.headings_rad[box.indices]
        return box.indices[in_heading_window(headings, self.heading_rad, self.config.heading_window_deg)]

    def _by_votes(self, indices: NDArray[np.int64]) -> NDArray[np.int64]:
        count = self.config.vote_keypoints
        votes = vote(self.features.head(count), [self.reference.head(int(i), count) for i in indices])
        return indices[np.argsort(-votes, kind="stable")]
