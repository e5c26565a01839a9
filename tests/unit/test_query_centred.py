"""How many references a pose rests on."""

from __future__ import annotations

import numpy as np
import pytest

from georef.config import CandidatesConfig, LocalizeConfig
from georef.estimation.expected import largest_position_sigma
from georef.estimation.localization import localize_image
from georef.features.nearest import MutualNearest
from georef.types.results import Localized
from tests.worlds.points import court, disturbed, new_image, photograph, reference_map, scaled_noise

_NOISE = scaled_noise(reference_map([], []).noise, poses=0.3)


def _localized(target_sigma_m: float, count: int = 9) -> Localized:
    rng = np.random.default_rng(11)
    world = court(11, references=9)
    seen = [photograph(world, pose, rng, clutter=40) for pose in world.references]
    made = reference_map(seen, [disturbed(pose, _NOISE, rng) for pose in world.references], _NOISE)
    query = photograph(world, world.queries[2], rng, clutter=40)
    candidates = CandidatesConfig(ranking="votes", first_count=3, count=count, target_sigma_m=target_sigma_m)
    image = new_image("q", query.truth.translation)
    outcome = localize_image(image, query.features, made, MutualNearest(), candidates, LocalizeConfig(), 2048)
    assert isinstance(outcome, Localized), outcome
    return outcome


def _sigma_m(outcome: Localized) -> float:
    return largest_position_sigma(outcome.world_from_cam_cov)


@pytest.fixture(scope="module")
def of_all() -> Localized:
    return _localized(0.0)


@pytest.fixture(scope="module")
def of_few() -> Localized:
    return _localized(10.0)


def test_without_a_target_all_that_help_take_part(of_all: Localized, of_few: Localized) -> None:
    assert len(of_few.matches) == 3
    assert 5 <= len(of_all.matches) <= 9
    assert _sigma_m(of_all) < 0.95 * _sigma_m(of_few)


def test_as_many_take_part_as_the_target_asks_for(of_all: Localized, of_few: Localized) -> None:
    target = 0.5 * (_sigma_m(of_all) + _sigma_m(of_few))
    outcome = _localized(target)
    assert 3 < len(outcome.matches) < len(of_all.matches)
    assert _sigma_m(outcome) <= target


def test_a_target_out_of_reach_is_no_reason_to_reject(of_all: Localized) -> None:
    outcome = _localized(1e-5)
    assert len(outcome.matches) == len(of_all.matches)
    assert len(_localized(1e-5, count=4).matches) <= 4
