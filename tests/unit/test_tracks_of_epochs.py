"""Tracks of epochs that contradict each other: the one that is alone is left out by name; what agrees stays."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from georef.config import CandidatesConfig, LocalizeConfig
from georef.estimation.global_model import choose_pairs
from georef.estimation.guided import GuidedOptions, guided_matches
from georef.estimation.localization import localize_image
from georef.estimation.reference_map import ReferenceMap
from georef.estimation.reference_tracks import block_tracks
from georef.features.nearest import MutualNearest
from georef.geometry.frusta import Frusta
from georef.geometry.rigid import Rigid3
from georef.types.campaign import Campaign
from georef.types.results import Localized
from tests.worlds.points import CAMERA, NOISE, court, disturbed, new_image, photograph, pose_nees, reference_map

EPOCHS = ("old", "new", "new", "old", "new", "new", "old", "new")


def localized(seed: int, shift_m: float) -> tuple[Localized, float, float]:
    """A query against two epochs, the old one of which lies somewhere else; its error in metres, and NEES."""
    rng, world = np.random.default_rng([seed, 7]), court(seed, references=len(EPOCHS))
    seen = [photograph(world, pose, rng, clutter=40) for pose in world.references]
    off = shift_m * np.array([0.6, 0.64, 0.48])
    given = [disturbed(pose, NOISE, rng) for pose in world.references]
    given = [Rigid3(p.rotation, p.translation + off * (e == "old")) for p, e in zip(given, EPOCHS, strict=True)]
    plain = reference_map(seen, given, NOISE)
    posed = {index: plain.posed(index) for index in range(len(plain))}
    options = GuidedOptions(3.0, 0.6, 0.95)
    pairs = choose_pairs(Frusta.of(plain.poses, [CAMERA] * len(plain), 30.0), 6)
    matches = {(a, b): guided_matches(posed[a], posed[b], options) for a, b in pairs}
    found = block_tracks(sorted(posed), posed, matches, NOISE, {i: plain.pose_cov(i) for i in posed})
    images = tuple(replace(image, epoch=epoch) for image, epoch in zip(plain.images, EPOCHS, strict=True))
    reference = ReferenceMap(Campaign("reference", images), plain._read, NOISE, found.__getitem__)
    query = photograph(world, world.queries[1], rng, clutter=40, blunders=0.03)
    image, candidates = new_image("q", query.truth.translation), CandidatesConfig(ranking="votes", first_count=8)
    config = LocalizeConfig(method="tracks")
    outcome = localize_image(image, query.features, reference, MutualNearest(), candidates, config, 2048)
    assert isinstance(outcome, Localized), outcome
    error = float(np.linalg.norm(outcome.world_from_cam.translation - query.truth.translation))
    return outcome, error, pose_nees(query.truth, outcome.world_from_cam, outcome.world_from_cam_cov)


@pytest.mark.parametrize("seed", range(3))
def test_an_epoch_that_lies_somewhere_else_is_left_out_and_named(seed: int) -> None:
    outcome, error, nees = localized(seed, 0.05)
    assert any(note.startswith("epoch old (3 images) contradicts") for note in outcome.notes), outcome.notes
    assert {m.reference_id for m in outcome.matches} <= {"r1", "r2", "r4", "r5", "r7"}
    assert error < 0.014
    assert nees < 22.5  # chi-square 6, 0.999


def test_epochs_that_agree_both_stay() -> None:
    for seed in range(4):
        outcome, _, _ = localized(seed, 0.0)
        assert outcome.notes == ()
        assert len(outcome.matches) == len(EPOCHS)
