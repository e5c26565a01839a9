"""Localization on worlds of points: outcomes and their reasons, position priors, honest covariances."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pytest

from georef.config import CandidatesConfig, LocalizeConfig
from georef.estimation.localization import localize_image
from georef.estimation.reference_map import ReferenceMap
from georef.features.nearest import MutualNearest
from georef.geometry.rigid import Array, Rigid3
from georef.types.campaign import Image
from georef.types.features import Features
from georef.types.results import Localized, Outcome, ReferenceNoise, Rejected, RejectReason
from tests.worlds.points import (
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

_CANDIDATES = CandidatesConfig(ranking="votes")
_CONFIG = LocalizeConfig()
_EXACT = scaled_noise(NOISE, poses=1e-6)


@dataclass(frozen=True, eq=False)
class Survey:
    world: World
    reference: ReferenceMap
    query: Seen

    @property
    def truth(self) -> Rigid3:
        return self.query.truth


def survey(
    world: World, seed: int, noise: ReferenceNoise = NOISE, *, clutter: int = 80, blunders: float = 0.05
) -> Survey:
    """References with pose errors, and a photograph of the third query pose."""
    rng = np.random.default_rng([seed, 31])
    seen = [photograph(world, pose, rng, clutter=clutter) for pose in world.references]
    given = [disturbed(pose, noise, rng) for pose in world.references]
    query = photograph(world, world.queries[2], rng, clutter=clutter, blunders=blunders)
    return Survey(world, reference_map(seen, given, noise), query)


def beside(made: Survey, offset_m: Sequence[float]) -> Array:
    return made.truth.translation + np.array(offset_m)


def localize(
    made: Survey,
    image: Image | None = None,
    features: Features | None = None,
    config: LocalizeConfig = _CONFIG,
    candidates: CandidatesConfig = _CANDIDATES,
) -> Outcome:
    given = image or new_image("q", beside(made, [1.0, -1.5, 2.0]))
    seen = made.query.features if features is None else features
    return localize_image(given, seen, made.reference, MutualNearest(), candidates, config, 2048)


def localized(outcome: Outcome) -> Localized:
    assert isinstance(outcome, Localized), outcome
    return outcome


def rejected(outcome: Outcome) -> Rejected:
    assert isinstance(outcome, Rejected), outcome
    return outcome


def position_error(made: Survey, outcome: Localized) -> float:
    return float(np.linalg.norm(outcome.world_from_cam.translation - made.truth.translation))


@pytest.mark.parametrize("method", ["query-centred", "published"])
def test_localizes_and_says_what_it_rests_on(method: str) -> None:
    made = survey(court(1), 1)
    outcome = localized(localize(made, config=LocalizeConfig.model_validate({"method": method})))
    assert position_error(made, outcome) < 0.06
    assert (outcome.gnss_rejected, outcome.gnss_offset_m, outcome.notes) == (False, None, ())
    assert outcome.correspondence_count == len(outcome.points_in_world) == len(outcome.keypoints) > 40
    truth = made.query.point[outcome.keypoints]
    off = np.linalg.norm(outcome.points_in_world - made.world.points[truth], axis=1)
    assert np.quantile(off, 0.9) < 0.3
    assert made.query.blunder[outcome.keypoints].mean() < 0.02
    assert outcome.cpu_s.keys() >= {"candidates", "matching", "pose"}
    for pairs in outcome.matches:
        reference = made.reference.posed(int(pairs.reference_id[1:])).features
        assert pairs.indices[:, 0].max() < len(made.query.features)
        assert pairs.indices[:, 1].max() < len(reference)
        assert set(pairs.indices[:, 0]) <= set(outcome.keypoints)
    assert len({pairs.reference_id for pairs in outcome.matches}) == len(outcome.matches) >= 2


def test_both_ways_agree_within_their_noise() -> None:
    made = survey(court(2), 2, blunders=0.0)
    ours, published = (
        localized(localize(made, config=LocalizeConfig.model_validate({"method": m})))
        for m in ("query-centred", "published")
    )
    difference = ours.world_from_cam.local(published.world_from_cam)
    for cov in (ours.world_from_cam_cov, published.world_from_cam_cov):
        assert (np.abs(difference) < 3.0 * np.sqrt(np.diag(cov))).all()
    assert np.abs(difference).max() > 1e-6  # two computations, not one


def test_covariances_are_honest() -> None:
    """With shared reference errors; five worlds, each seen by several draws."""
    values, relative = [], []
    for seed in range(22):
        made = survey(court(seed % 5), seed)
        outcome = localized(localize(made))
        values.append(pose_nees(made.truth, outcome.world_from_cam, outcome.world_from_cam_cov) / 6.0)
        relative.append(pose_nees(made.truth, outcome.world_from_cam, outcome.relative_cov) / 6.0)
    assert 0.7 < np.mean(values) < 1.25, np.mean(values)
    assert np.mean(relative) > 2.0


def test_covariances_are_honest_without_reference_errors() -> None:
    values = []
    for seed in range(22):
        made = survey(court(seed % 5), seed, _EXACT)
        outcome = localized(localize(made))
        values.append(pose_nees(made.truth, outcome.world_from_cam, outcome.world_from_cam_cov) / 6.0)
    assert 0.75 < np.mean(values) < 1.3, np.mean(values)


def test_a_foreign_image_is_rejected_with_a_reason() -> None:
    made = survey(court(3), 3)
    rng = np.random.default_rng(3)
    elsewhere = photograph(court(333), made.truth, rng, clutter=80)
    outcome = rejected(localize(made, features=elsewhere.features))
    assert outcome.reason in {RejectReason.FEW_MATCHES, RejectReason.FEW_INLIERS}
    assert outcome.detail


def test_few_features() -> None:
    made = survey(court(4), 4)
    outcome = rejected(localize(made, features=made.query.features.head(19)))
    assert (outcome.reason, outcome.detail) == (RejectReason.FEW_FEATURES, "19 keypoints")
    assert rejected(localize(made, features=made.query.features.head(0))).reason == RejectReason.FEW_FEATURES
    assert rejected(localize(made, features=made.query.features.head(25))).reason == RejectReason.FEW_MATCHES


def test_gnss_200_m_off_is_overruled_by_strong_evidence() -> None:
    made = survey(court(5), 5)
    outcome = localized(localize(made, new_image("q", beside(made, [200.0, 0.0, 0.0]))))
    assert outcome.gnss_rejected
    assert outcome.gnss_offset_m == pytest.approx(200.0, abs=0.2)
    assert position_error(made, outcome) < 0.06
    assert any("widened" in note for note in outcome.notes)


def test_weak_evidence_does_not_overrule_gnss() -> None:
    made = survey(court(6), 6)
    strict = _CONFIG.model_copy(update={"min_inliers": 40})
    image = new_image("q", beside(made, [200.0, 0.0, 0.0]))
    count = localized(localize(made, image)).correspondence_count
    assert 40 <= count < 120
    outcome = rejected(localize(made, image, config=strict))
    assert outcome.reason == RejectReason.PRIOR_CONTRADICTS
    assert "200.0 m" in outcome.detail
    assert not localized(localize(made, config=strict)).gnss_rejected


def test_no_prior_searches_the_whole_reference() -> None:
    made = survey(court(7), 7)
    outcome = localized(localize(made, new_image("q")))
    assert any("whole reference" in note for note in outcome.notes)
    assert position_error(made, outcome) < 0.06


def test_a_wrong_heading_leaves_the_whole_reference_to_try() -> None:
    made = survey(court(8), 8)
    forward = made.truth.rotation[:, 2]
    heading = float(np.arctan2(forward[0], forward[1]))
    near = made.truth.translation + 1.0
    right = localize(made, new_image("q", near, heading_rad=heading + 0.3))
    assert position_error(made, localized(right)) < 0.06
    turned = new_image("q", near, heading_rad=heading + np.pi)
    boxed = CandidatesConfig(ranking="votes", fallback=False)
    assert rejected(localize(made, turned, candidates=boxed)).reason == RejectReason.NO_CANDIDATES
    found = localized(localize(made, turned))
    assert position_error(made, found) < 0.06
    assert any("tried the whole reference" in note for note in found.notes)


def on_one_plane(world: World, flat: Array) -> World:
    return replace(world, points=flat)


def test_points_on_one_plane_ahead_are_enough() -> None:
    world = court(9)
    rng = np.random.default_rng(9)
    wall = np.column_stack([rng.uniform(-9, 9, 300), np.full(300, 14.0), rng.uniform(0, 8, 300)])
    values = []
    for seed in range(8):
        made = survey(on_one_plane(world, wall), seed)
        outcome = localized(localize(made))
        values.append(pose_nees(made.truth, outcome.world_from_cam, outcome.world_from_cam_cov) / 6.0)
    assert 0.4 < np.mean(values) < 1.6, np.mean(values)


def distant_patch(distance_m: float) -> World:
    """All points on 3 x 3 m far ahead, seen by references 12 m apart."""
    world, rng = court(10), np.random.default_rng(10)
    x, z = rng.uniform(-1.5, 1.5, 120), rng.uniform(3.5, 6.5, 120)
    return on_one_plane(world, np.column_stack([x, np.full(120, distance_m), z]))


def largest_sigma(outcome: Localized) -> float:
    return float(np.sqrt(np.linalg.eigvalsh(outcome.world_from_cam_cov[3:, 3:])[-1]))


def test_points_in_one_corner_give_large_sigmas_that_are_honest() -> None:
    values, sigmas = [], []
    for seed in range(10):
        made = survey(distant_patch(25.0), seed, blunders=0.0)
        outcome = localized(localize(made))
        values.append(pose_nees(made.truth, outcome.world_from_cam, outcome.world_from_cam_cov) / 6.0)
        sigmas.append(largest_sigma(outcome))
    ordinary = localized(localize(survey(court(10), 10)))
    assert np.median(sigmas) > 5.0 * largest_sigma(ordinary)
    assert 0.5 < np.mean(values) < 1.6, np.mean(values)


def test_geometry_that_does_not_fix_the_pose_is_rejected() -> None:
    made = survey(distant_patch(50.0), 1, blunders=0.0)
    loose, strict = (_CONFIG.model_copy(update={"max_position_sigma_m": limit}) for limit in (1e3, 0.3))
    assert largest_sigma(localized(localize(made, config=loose))) > 0.3
    outcome = rejected(localize(made, config=strict))
    assert outcome.reason == RejectReason.DEGENERATE
    assert "over 0.3 m: position up and down known to " in outcome.detail
    assert "all on one plane, 50 m away" in outcome.detail


def test_the_same_image_gives_the_same_pose_and_a_limit_thins_the_points() -> None:
    made = survey(court(11), 11)
    first, again = localized(localize(made)), localized(localize(made))
    np.testing.assert_array_equal(first.world_from_cam.matrix(), again.world_from_cam.matrix())
    limited = localized(localize(made, config=_CONFIG.model_copy(update={"max_correspondences": 30})))
    assert limited.correspondence_count <= 30 < first.correspondence_count
    trace = [np.trace(o.relative_cov[3:, 3:]) for o in (limited, first)]
    assert trace[0] > 1.3 * trace[1]


def test_fewer_than_two_references_are_no_candidates() -> None:
    made = survey(court(12), 12)
    one = reference_map([made.query], [made.truth])
    assert rejected(localize(replace(made, reference=one))).reason == RejectReason.NO_CANDIDATES
