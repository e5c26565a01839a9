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
from georef.estimation.search import FindSimilar, Ranking, Search
from georef.types.features import Features

_MORE_VOTES = 1.25  # than the other way up: four references have about 100 by chance, and 10 of them are noise
_BY_CHANCE = 0.12  # of the features compared; 0.08 is the most of 50 references that show other things


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
        ranking = Search(reference, looked.features, where, config, looked.find_similar).by_votes(box)
        votes[turns] = ranking.mean_votes(config.first_count)
    better = [turns for turns in votes if turns != tried and votes[turns] > _MORE_VOTES * votes[tried]]
    return sorted(better, key=lambda turns: -votes[turns])


def has_few_votes(ranking: Ranking, compared: int, config: CandidatesConfig) -> bool:
    """Whether the references that have most votes, of so many features, hardly have more than any pictures have."""
    return ranking.votes is not None and ranking.mean_votes(config.first_count) < _BY_CHANCE * compared
