"""The references that a query is compared with, in order: by global descriptors, by common local features, or both."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from georef.config import CandidatesConfig
from georef.estimation.candidates import Box, Whereabouts, everywhere, search_box, vote
from georef.estimation.reference_map import ReferenceMap
from georef.geometry.rigid import Array
from georef.types.features import Features

_NEIGHBOURS_OF_A_POSE = 200


class FindSimilar(Protocol):
    """The vector database, asked for one query: whose global descriptors are nearest to the query's."""

    def __call__(self, count: int, box: Box, config: CandidatesConfig) -> NDArray[np.int64]:
        """At most `count` indices into the reference map, inside box and heading window, most similar first."""
        ...


@dataclass(frozen=True, eq=False)
class Ranking:
    """References, the most promising first."""

    indices: NDArray[np.int64]
    note: str = ""  # where some were left out
    votes: NDArray[np.int64] | None = None  # of each, where they were counted

    def mean_votes(self, count: int) -> float:
        """Of the `count` references that have most; 0 where there is none."""
        return 0.0 if self.votes is None or not len(self.votes) else float(self.votes[:count].mean())


@dataclass(frozen=True, eq=False)
class Search:
    """What one query is searched with. Without `find_similar` the ranking must be "votes"."""

    reference: ReferenceMap
    features: Features
    where: Whereabouts
    config: CandidatesConfig
    find_similar: FindSimilar | None = None

    def box(self) -> Box:
        """Where the query is looked for first."""
        return search_box(self.reference.positions, self.reference.headings_rad, self.where, self.config)

    def everywhere(self) -> Box:
        """Where it is looked for then."""
        return everywhere(self.reference.positions, self.where)

    def ranked(self, box: Box) -> Ranking:
        """References that may show what the query shows, the most promising first."""
        config = self.config
        if config.ranking == "global":
            return Ranking(self._similar(config.count, box))
        return self.by_votes(box)

    def by_votes(self, box: Box) -> Ranking:
        """References by the number of features that they seem to have in common with the query."""
        shortlist, note = self._shortlist(box)
        votes = self._votes(shortlist)
        return Ranking(shortlist[np.argsort(-votes, kind="stable")], note, np.sort(votes)[::-1])

    def with_neighbours(self, ranked: NDArray[np.int64], position: Array) -> NDArray[np.int64]:
        """The ranked references, then those nearest to a position (3,), which similarity may have missed."""
        distance = np.linalg.norm(self.reference.positions - position, axis=1)
        near = np.argsort(distance, kind="stable")[:_NEIGHBOURS_OF_A_POSE]
        return np.concatenate([ranked, near[~np.isin(near, ranked)]])

    def _shortlist(self, box: Box) -> tuple[NDArray[np.int64], str]:
        """The references that votes are counted of, and a note where some were left."""
        config = self.config
        if config.ranking != "votes":
            return self._similar(config.shortlist, box), ""
        left = len(box.indices) - config.max_searched
        which = "first" if self.where.centre is None else "nearest"
        note = f"searched the {which} {config.max_searched} of {len(box.indices)} references" if left > 0 else ""
        return box.indices[: config.max_searched], note

    def _similar(self, count: int, box: Box) -> NDArray[np.int64]:
        if self.find_similar is None:
            raise ValueError(f"the ranking {self.config.ranking!r} needs a vector database")
        return self.find_similar(count, box, self.config)

    def _votes(self, indices: NDArray[np.int64]) -> NDArray[np.int64]:
        count = self.config.vote_keypoints
        return vote(self.features.head(count), [self.reference.head(int(i), count) for i in indices])
