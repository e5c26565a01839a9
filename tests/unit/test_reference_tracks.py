"""Verified reference tracks: joining, points against the truth, and localization by looking them up."""

from __future__ import annotations

import numpy as np
import pytest

from georef.config import CandidatesConfig, LocalizeConfig
from georef.estimation.global_model import choose_pairs
from georef.estimation.guided import GuidedOptions, guided_matches
from georef.estimation.localization import localize_image
from georef.estimation.reference_map import ReferenceMap
from georef.estimation.reference_tracks import block_tracks, joined
from georef.estimation.seen_tracks import SeenTracks
from georef.features.nearest import MutualNearest
from georef.geometry.frusta import Frusta
from georef.geometry.rigid import Rigid3
from georef.types.campaign import Campaign
from georef.types.results import Localized, Outcome, ReferenceNoise, Rejected
from georef.types.scene import ImageStructure
from tests.worlds.points import (
    CAMERA,
    NOISE,
    Seen,
    World,
    court,
    disturbed,
    new_image,
    photograph,
    pose_nees,
    reference_map,
    scaled_noise,
)

OPTIONS = GuidedOptions(3.0, 0.6, 0.95)
CONFIG = LocalizeConfig(method="tracks")


def mapped(
    world: World, seed: int, noise: ReferenceNoise = NOISE, *, blunders: float = 0.0
) -> tuple[ReferenceMap, list[Seen], dict[int, ImageStructure]]:
    """References with pose errors, and their tracks."""
    rng = np.random.default_rng([seed, 41])
    seen = [photograph(world, pose, rng, clutter=80, blunders=blunders) for pose in world.references]
    plain = reference_map(seen, [disturbed(pose, noise, rng) for pose in world.references], noise)
    posed = {index: plain.posed(index) for index in range(len(plain))}
    pairs = choose_pairs(Frusta.of(plain.poses, [CAMERA] * len(plain), 30.0), 4)
    matches = {(a, b): guided_matches(posed[a], posed[b], OPTIONS) for a, b in pairs}
    covs = {index: plain.pose_cov(index) for index in posed}
    found = block_tracks(sorted(posed), posed, matches, noise, covs)
    reader = plain._read
    return ReferenceMap(Campaign("reference", plain.images), reader, noise, found.__getitem__), seen, found


def localized(reference: ReferenceMap, query: Seen) -> Outcome:
    image = new_image("q", query.truth.translation + np.array([1.0, -1.5, 2.0]))
    candidates = CandidatesConfig(ranking="votes")
    return localize_image(image, query.features, reference, MutualNearest(), candidates, CONFIG, 2048)


def test_links_that_contradict_are_left_out_the_weakest_first() -> None:
    view = np.array([0, 0, 1, 1, 2, 2])
    ends = np.array([[0, 2], [2, 4], [4, 1], [1, 3]])  # with the third, two keypoints of image 0 would meet
    label = joined(ends, view)
    assert label[0] == label[2] == label[4] != label[1]
    assert label[1] == label[3]
    assert label[5] == -1


def test_tracks_are_of_one_point_and_lie_where_it_is() -> None:
    world = court(1)
    _, seen, found = mapped(world, 1, scaled_noise(NOISE, poses=1e-6), blunders=0.1)
    for index, structure in found.items():
        obs = structure.observations
        assert len(structure) > 60
        assert np.all(np.diff(structure.keypoint) > 0)
        assert len(np.unique(np.column_stack([obs.point, obs.view]), axis=0)) == len(obs)
        own = obs.view == index
        assert np.array_equal(obs.keypoint[own], structure.keypoint[obs.point[own]])
        wrong = sum(int(seen[v].blunder[k]) for v, k in zip(obs.view, obs.keypoint, strict=True))
        assert wrong < 0.02 * len(obs)
        true = world.points[seen[index].point[structure.keypoint]]
        off = structure.points - true
        good = np.linalg.norm(off, axis=1) < 1.0
        assert good.mean() > 0.97
        squares = np.einsum("ni,nij,nj->n", off[good], np.linalg.inv(structure.cov[good]), off[good]) / 3.0
        assert 0.6 < np.median(squares) / 0.789 < 1.5  # of a chi-square with 3 degrees of freedom over 3


def test_the_same_track_has_the_same_name_from_every_image() -> None:
    _, seen, found = mapped(court(2), 2)
    by_name: dict[tuple[int, ...], set[int]] = {}
    for index, structure in found.items():
        for name, keypoint in zip(structure.identity.tolist(), structure.keypoint, strict=True):
            by_name.setdefault(tuple(name), set()).add(int(seen[index].point[keypoint]))
    assert np.mean([len(points) == 1 for points in by_name.values()]) > 0.98
    assert len(by_name) < 0.6 * sum(map(len, found.values()))


def test_tracks_seen_from_the_other_side_are_not_expected() -> None:
    world = court(3)
    reference, _, found = mapped(world, 3)
    posed = {index: reference.posed(index) for index in found}
    seen = SeenTracks.of(found, posed, world.queries[0], CAMERA)
    assert len(seen) > 60
    assert np.bincount(seen.track).max() <= 3
    behind = world.queries[0] @ Rigid3(np.diag([-1.0, 1.0, -1.0]), np.zeros(3))
    assert len(SeenTracks.of(found, posed, behind, CAMERA)) == 0
    over = Rigid3(behind.rotation, behind.translation + np.array([0.0, 40.0, 0.0]))  # looks back through the wall
    assert len(SeenTracks.of(found, posed, over, CAMERA)) == 0


@pytest.mark.parametrize("blunders", [0.0, 0.3])
def test_most_of_what_is_tracked_is_found_and_no_blunder(blunders: float) -> None:
    world = court(4)
    reference, seen, found = mapped(world, 4)
    query = photograph(world, world.queries[2], np.random.default_rng(4), clutter=80, blunders=blunders)
    outcome = localized(reference, query)
    assert isinstance(outcome, Localized), outcome
    tracked = {int(seen[i].point[k]) for i, s in found.items() for k in s.keypoint}
    findable = [p in tracked and not b for p, b in zip(query.point, query.blunder, strict=True)]
    assert outcome.correspondence_count > 0.8 * sum(findable)
    assert query.blunder[outcome.keypoints].sum() <= 1
    assert len(np.unique(outcome.keypoints)) == len(outcome.keypoints)


def test_poses_and_covariances_are_honest() -> None:
    values, errors = [], []
    for seed in range(20):
        world = court(seed % 5)
        reference, _, _ = mapped(world, seed)
        query = photograph(world, world.queries[2], np.random.default_rng([seed, 7]), clutter=80, blunders=0.05)
        outcome = localized(reference, query)
        assert isinstance(outcome, Localized), outcome
        values.append(pose_nees(query.truth, outcome.world_from_cam, outcome.world_from_cam_cov) / 6.0)
        errors.append(float(np.linalg.norm(outcome.world_from_cam.translation - query.truth.translation)))
    assert 0.001 < np.median(errors) < 0.03, np.median(errors)
    assert 0.6 < np.mean(values) < 1.7, np.mean(values)


def test_another_place_is_rejected() -> None:
    reference, _, _ = mapped(court(5), 5)
    elsewhere = court(6)
    query = photograph(elsewhere, elsewhere.queries[0], np.random.default_rng(5))
    assert isinstance(localized(reference, query), Rejected)
