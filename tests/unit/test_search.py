"""Search: what each ranking asks for, which references may take part, and what similarity missed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from georef.config import CandidatesConfig
from georef.estimation.candidates import Box, search_box
from georef.estimation.reference_map import ReferenceMap
from georef.estimation.search import Search
from georef.types.campaign import Campaign
from tests.worlds.points import Seen, court, photograph, reference_map


@pytest.fixture(scope="module")
def made() -> tuple[ReferenceMap, Seen]:
    world, rng = court(3, references=8), np.random.default_rng(3)
    seen = [photograph(world, pose, rng) for pose in world.references]
    plain = reference_map(seen, world.references)
    images = tuple(replace(im, epoch="old" if i < 5 else "new") for i, im in enumerate(plain.images))
    both = ReferenceMap(
        Campaign("reference", images), lambda name, count: plain.head(int(name[1:]), count or 10**6), plain.noise
    )
    return both, photograph(world, world.queries[1], rng)


class Database:
    """Gives the references in falling order, and remembers what it was asked."""

    def __init__(self, size: int) -> None:
        self.size, self.asked = size, []

    def __call__(self, count: int, box: Box, heading_rad: float | None, config: CandidatesConfig) -> NDArray[np.int64]:
        self.asked.append((count, box.half_side_m, heading_rad, config.epochs))
        return np.arange(self.size)[::-1][:count]


def search(made: tuple[ReferenceMap, Seen], database: Database | None = None, **options: object) -> Search:
    config = CandidatesConfig.model_validate(options)
    return Search(made[0], made[1].features, 0.5, config, database)


def everything(of: Search) -> Box:
    return search_box(of.positions, None, of.config)


def test_global_takes_the_order_of_the_database(made: tuple[ReferenceMap, Seen]) -> None:
    database = Database(8)
    of = search(made, database, ranking="global", count=3, epochs=["new"])
    np.testing.assert_array_equal(of.ranked(everything(of))[0], [7, 6, 5])
    assert database.asked == [(3, None, 0.5, ["new"])]


def test_votes_put_the_shortlist_in_order(made: tuple[ReferenceMap, Seen]) -> None:
    database = Database(8)
    of = search(made, database, ranking="global-votes", shortlist=6, heading_window_deg=180.0)
    ranked, _ = of.ranked(everything(of))
    assert sorted(ranked) == [2, 3, 4, 5, 6, 7]
    all_votes, _ = search(made, ranking="votes", heading_window_deg=180.0).ranked(everything(of))
    np.testing.assert_array_equal(ranked, [i for i in all_votes if i >= 2])


def test_without_a_database_only_votes_can_rank(made: tuple[ReferenceMap, Seen]) -> None:
    of = search(made, ranking="global")
    with pytest.raises(ValueError, match="needs a vector database"):
        of.ranked(everything(of))


def test_votes_among_the_nearest_say_how_many_were_left(made: tuple[ReferenceMap, Seen]) -> None:
    of = search(made, ranking="votes", max_searched=3, heading_window_deg=180.0)
    ranked, note = of.ranked(everything(of))
    assert len(ranked) == 3
    assert note == "searched the nearest 3 of 8 references"


def test_other_epochs_take_no_part(made: tuple[ReferenceMap, Seen]) -> None:
    of = search(made, ranking="votes", epochs=["new"], heading_window_deg=180.0)
    assert sorted(of.ranked(everything(of))[0]) == [5, 6, 7]
    assert sorted(of.with_neighbours(np.array([6]), made[0].positions[0])) == [5, 6, 7]


def test_what_similarity_missed_is_found_beside_the_pose(made: tuple[ReferenceMap, Seen]) -> None:
    of = search(made)
    found = of.with_neighbours(np.array([7, 2]), made[0].positions[4])
    assert list(found[:3]) == [7, 2, 4]
    assert sorted(found) == list(range(8))
