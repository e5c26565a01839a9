"""Search: what each ranking asks for, and what similarity missed."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from georef.config import CandidatesConfig
from georef.estimation.candidates import Box, Whereabouts
from georef.estimation.reference_map import ReferenceMap
from georef.estimation.search import Search
from georef.types.campaign import PositionPrior
from tests.worlds.points import Seen, court, photograph, reference_map


@pytest.fixture(scope="module")
def made() -> tuple[ReferenceMap, Seen]:
    world, rng = court(3, references=8), np.random.default_rng(3)
    seen = [photograph(world, pose, rng) for pose in world.references]
    return reference_map(seen, world.references), photograph(world, world.queries[1], rng)


class Database:
    """Gives the references in falling order, and remembers what it was asked."""

    def __init__(self, size: int) -> None:
        self.size, self.asked = size, []

    def __call__(self, count: int, box: Box, config: CandidatesConfig) -> NDArray[np.int64]:
        self.asked.append((count, box.half_side_m, box.heading_rad))
        return np.arange(self.size)[::-1][:count]


def search(
    made: tuple[ReferenceMap, Seen],
    database: Database | None = None,
    where: Whereabouts | None = None,
    **options: object,
) -> Search:
    config = CandidatesConfig.model_validate(options)
    return Search(made[0], made[1].features, where or Whereabouts(heading_rad=0.5), config, database)


def test_global_takes_the_order_of_the_database(made: tuple[ReferenceMap, Seen]) -> None:
    database = Database(8)
    where = Whereabouts(PositionPrior(made[0].positions[0], np.eye(3)), None, 0.5)
    of = search(made, database, where, ranking="global", count=3, box="fixed", half_side_m=70.0)
    np.testing.assert_array_equal(of.ranked(of.box()).indices, [7, 6, 5])
    assert database.asked == [(3, 70.0, 0.5)]


def test_votes_put_the_shortlist_in_order(made: tuple[ReferenceMap, Seen]) -> None:
    database = Database(8)
    of = search(made, database, ranking="global-votes", shortlist=6, heading_window_deg=180.0)
    ranked = of.ranked(of.box()).indices
    assert database.asked == [(6, None, None)]
    assert sorted(ranked) == [2, 3, 4, 5, 6, 7]
    all_votes = search(made, ranking="votes").ranked(of.everywhere()).indices
    np.testing.assert_array_equal(ranked, [i for i in all_votes if i >= 2])


def test_without_a_database_only_votes_can_rank(made: tuple[ReferenceMap, Seen]) -> None:
    of = search(made, ranking="global")
    with pytest.raises(ValueError, match="needs a vector database"):
        of.ranked(of.box())


def test_votes_among_some_say_which(made: tuple[ReferenceMap, Seen]) -> None:
    of = search(made, ranking="votes", max_searched=3)
    ranked = of.ranked(of.everywhere())
    assert (sorted(ranked.indices), ranked.note) == ([0, 1, 2], "searched the first 3 of 8 references")
    of = search(made, None, Whereabouts(near=made[0].positions[6]), ranking="votes", max_searched=3)
    ranked = of.ranked(of.everywhere())
    assert 6 in ranked.indices
    assert ranked.note == "searched the nearest 3 of 8 references"
    assert ranked.votes is not None
    assert ranked.mean_votes(2) == np.mean(np.sort(ranked.votes)[1:])


def test_what_similarity_missed_is_found_beside_the_pose(made: tuple[ReferenceMap, Seen]) -> None:
    found = search(made).with_neighbours(np.array([7, 2]), made[0].positions[4])
    assert list(found[:3]) == [7, 2, 4]
    assert sorted(found) == list(range(8))
