"""Candidates: search box with its note, heading window, votes, and who sees the same points."""

from __future__ import annotations

import numpy as np
import pytest

from georef.config import CandidatesConfig
from georef.estimation.candidates import Box, Whereabouts, everywhere, in_heading_window, overlap, vote
from georef.estimation.candidates import search_box as box_about
from georef.geometry.projection import Views
from georef.geometry.rigid import Array, exp_so3
from georef.types.campaign import PositionPrior
from tests.worlds.points import CAMERA, court, photograph


def prior(sigma_east: float, sigma_north: float | None = None) -> PositionPrior:
    return PositionPrior(
        np.array([100.0, 50.0, 3.0]), np.diag(np.square([sigma_east, sigma_north or sigma_east, 1000.0]))
    )


def search_box(
    positions: Array, given: PositionPrior | None, config: CandidatesConfig, near: Array | None = None
) -> Box:
    """About positions alone: every reference looks north, and the query too."""
    return box_about(positions, np.zeros(len(positions)), Whereabouts(given, near, 0.0), config)


def line_of_positions(spacing: float, count: int = 41) -> Array:
    """Reference positions east and west of the prior; heights that must not matter."""
    east = 100.0 + spacing * (np.arange(count) - count // 2)
    return np.column_stack([east, np.full(count, 50.0), np.linspace(-500, 500, count)])


@pytest.mark.parametrize(
    ("options", "sigma", "half_side"),
    [
        ({"box": "published"}, 6.0, 6.0),
        ({"box": "published"}, 2.5, 2.5),
        ({"box": "reach"}, 6.0, 48.0),  # 3 sigma + 30
        ({"box": "reach", "viewing_reach_m": 1.0}, 2.0, 15.0),  # at least min_half_side_m
        ({"box": "reach", "viewing_reach_m": 1.0, "min_half_side_m": 4.0}, 2.0, 7.0),
        ({"box": "fixed", "half_side_m": 9.0}, 2.0, 9.0),
    ],
)
def test_half_side(options: dict[str, str], sigma: float, half_side: float) -> None:
    config = CandidatesConfig.model_validate({"count": 2, **options})
    spacing = half_side / 10.0
    box = search_box(line_of_positions(spacing * 1.0001), prior(sigma), config)
    assert len(box.indices) == 19  # ten steps on each side lie just outside
    box = search_box(line_of_positions(spacing * 0.9999), prior(sigma), config)
    assert len(box.indices) == 21
    assert (box.whole_reference, box.note) == (False, "")


def test_the_larger_horizontal_sigma_decides() -> None:
    config = CandidatesConfig(box="published", count=2)
    assert len(search_box(line_of_positions(0.99), prior(2.0, 7.0), config).indices) == 15
    assert len(search_box(line_of_positions(0.99), prior(7.0, 2.0), config).indices) == 15


def test_the_box_is_a_square_and_the_nearest_come_first() -> None:
    config = CandidatesConfig(box="published", count=2)
    around = np.array([[9.0, 9.0], [0.5, 0.0], [-9.9, 0.0], [0.0, 10.1], [3.0, -4.0]])
    positions = np.column_stack([around + np.array([100.0, 50.0]), np.zeros(5)])
    np.testing.assert_array_equal(search_box(positions, prior(10.0), config).indices, [1, 4, 0, 2])


def test_widened_until_there_are_enough_and_says_so() -> None:
    config = CandidatesConfig(box="published", count=6)
    box = search_box(line_of_positions(10.0), prior(6.0), config)
    assert len(box.indices) == 9  # doubled thrice: 48 m
    assert box.note == "search box widened from 6.0 to 48.0 m half side: 1 of 6 references"
    assert not box.whole_reference


def test_a_prior_far_from_everything_ends_at_the_whole_reference() -> None:
    positions = line_of_positions(1.0, 5) + np.array([1e5, 0.0, 0.0])
    box = search_box(positions, prior(1.0), CandidatesConfig(count=10))
    assert sorted(box.indices) == [0, 1, 2, 3, 4]
    assert box.whole_reference
    assert "of 5 references" in box.note


def test_whole_reference_without_a_prior() -> None:
    box = search_box(line_of_positions(50.0), None, CandidatesConfig())
    np.testing.assert_array_equal(box.indices, np.arange(41))
    assert box.whole_reference
    assert "no position prior" in box.note


def test_no_box_on_request_even_with_a_prior() -> None:
    box = search_box(line_of_positions(50.0), prior(1.0), CandidatesConfig(box="none"))
    assert (len(box.indices), box.whole_reference, box.half_side_m) == (41, True, None)


def test_references_that_look_elsewhere_are_not_counted() -> None:
    positions = line_of_positions(10.0)
    headings = np.where(np.arange(len(positions)) % 2 == 0, np.pi, 0.0)
    where = Whereabouts(prior(1.0), None, 0.1)
    box = box_about(positions, headings, where, CandidatesConfig(box="fixed", half_side_m=51.0, count=4))
    assert set(box.indices) == {15, 17, 19, 21, 23, 25}
    box = box_about(positions, headings, where, CandidatesConfig(box="fixed", half_side_m=30.0, count=10))
    assert (len(box.indices), box.half_side_m) == (12, 120.0)  # ten of those that look the same way
    box = box_about(positions, headings, where, CandidatesConfig(box="fixed", half_side_m=1000.0))
    assert (len(box.indices), box.whole_reference) == (20, False)
    any_way = CandidatesConfig(box="fixed", half_side_m=1000.0, heading_window_deg=180.0)
    box = box_about(positions, headings, where, any_way)
    assert (len(box.indices), box.whole_reference, box.heading_rad) == (41, True, None)


def test_everywhere_begins_with_the_nearest_and_asks_for_no_heading() -> None:
    box = everywhere(line_of_positions(10.0), Whereabouts(prior(1.0), None, 0.1))
    assert (list(box.indices[:3]), len(box.indices), box.heading_rad) == ([20, 19, 21], 41, None)
    assert list(everywhere(line_of_positions(10.0), Whereabouts()).indices[:3]) == [0, 1, 2]


def test_no_references_at_all() -> None:
    assert len(search_box(np.zeros((0, 3)), prior(1.0), CandidatesConfig()).indices) == 0


def test_a_position_that_is_not_a_number_does_not_hang() -> None:
    nowhere = PositionPrior(np.array([np.nan, 0.0, 0.0]), np.eye(3))
    assert len(search_box(line_of_positions(1.0), nowhere, CandidatesConfig()).indices) == 0


def test_heading_window_across_the_half_turn() -> None:
    headings = np.radians([170.0, 179.0, -179.0, -165.0, -150.0, 0.0, 160.1, 159.9, 181.0])
    inside = in_heading_window(headings, np.radians(-175.0), 25.0)
    np.testing.assert_array_equal(inside, [True, True, True, True, True, False, True, False, True])
    np.testing.assert_array_equal(in_heading_window(headings, np.radians(185.0), 25.0), inside)
    assert in_heading_window(headings, None, 1.0).all()
    assert in_heading_window(headings, 0.3, 180.0).all()
    assert in_heading_window(np.array([np.nan]), 0.3, 10.0).all()  # it looks up: it may show the place


def test_votes_rank_common_content() -> None:
    world, rng = court(1), np.random.default_rng(1)
    query = photograph(world, world.queries[0], rng)
    references = [photograph(world, pose, rng) for pose in world.references]
    foreign = photograph(court(99), world.references[0], rng)
    votes = vote(query.features, [s.features for s in [*references, foreign]])
    shared = [len(np.intersect1d(query.point, s.point)) for s in references]
    assert np.corrcoef(votes[:-1], shared)[0, 1] > 0.9
    assert votes[-1] < 0.5 * votes[:-1].min()
    np.testing.assert_array_equal(vote(query.features, [references[0].features.head(0)]), [0])


def test_overlap_counts_points_inside_the_image_from_a_similar_side() -> None:
    world = court(2)
    pose = world.references[0]
    turned = type(pose)(pose.rotation @ exp_so3([0.0, np.pi, 0.0]), pose.translation)
    behind_the_wall = type(pose)(turned.rotation, pose.translation + np.array([0.0, 40.0, 0.0]))
    views = Views.of([pose, turned, behind_the_wall], [CAMERA] * 3)
    rays = world.points - world.queries[0].translation
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    counts = overlap(world.points, rays, views, np.tile([CAMERA.width, CAMERA.height], (3, 1)).astype(float))
    pixel = views.project(np.zeros(len(world.points), int), world.points)
    inside = ((pixel >= 0) & (pixel <= [CAMERA.width, CAMERA.height])).all(axis=1)
    assert 0.9 * inside.sum() <= counts[0] <= inside.sum()
    assert counts[1] == 0  # they are behind it
    pixel = views.project(np.full(len(rays), 2), world.points)
    inside = ((pixel >= 0) & (pixel <= [CAMERA.width, CAMERA.height])).all(axis=1)
    assert counts[2] < 0.1 * inside.sum()  # it sees them from the other side


def test_a_position_without_sigma_is_searched_about() -> None:
    near = np.array([100.0, 50.0, 0.0])
    for options in ({}, {"box": "published"}):
        config = CandidatesConfig.model_validate({"count": 2, **options})
        box = search_box(line_of_positions(90.0), None, config, near)
        assert (len(box.indices), box.half_side_m, box.whole_reference) == (11, 500.0, False)
    box = search_box(line_of_positions(90.0), prior(1.0), CandidatesConfig(box="published", count=2), near + 90.0)
    np.testing.assert_array_equal(box.centre, [100.0, 50.0, 3.0])  # a prior goes before it
