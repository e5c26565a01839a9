"""The second try for images that were taken on their side: learned features and matchers do not turn.

Which way up an image lies is told by votes: features of the picture at half its level, turned each way, compared with
references as candidates are. On its side it shares half as many or fewer with them as when it stands upright.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from georef.config import CandidatesConfig
from georef.estimation.candidates import Box, Whereabouts
from georef.estimation.reference_map import ReferenceMap
from georef.estimation.search import FindSimilar, Search
from georef.types.features import Features

_MORE_VOTES = 1.25  # than the other way up: four references have about 100 by chance, and 10 of them are noise


@dataclass(frozen=True, eq=False)
class Looked:
    """The features of a picture turned one way, in the frame of the image, and the search for what looks like it."""

    features: Features
    find_similar: FindSimilar | None = None


class TurnedPicture(Protocol):
    """The picture of an image, turned clockwise by quarter turns."""

    @property
    def stated_turns(self) -> int:
        """Quarter turns after which it is upright, as its file states: 0 where it states nothing."""
        ...

    def glance(self, quarter_turns: int) -> Looked:
        """Features at half the level, for votes."""
        ...

    def look(self, quarter_turns: int) -> Looked:
        """All its features, the ones that an outcome may name."""
        ...


def promising_turns(
    picture: TurnedPicture, reference: ReferenceMap, where: Whereabouts, config: CandidatesConfig, box: Box, tried: int
) -> list[int]:
    """Quarter turns that have clearly more votes than those which were tried, the best first."""
    votes = {}
    for turns in range(4):
        looked = picture.glance(turns)
        votes[turns] = Search(reference, looked.features, where, config, looked.find_similar).best_votes(box)
    better = [turns for turns in votes if turns != tried and votes[turns] > _MORE_VOTES * votes[tried]]
    return sorted(better, key=lambda turns: -votes[turns])
