"""References and epochs that contradict the others about a query."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from georef.config import CandidatesConfig, LocalizeConfig
from georef.estimation.localization import localize_image
from georef.estimation.reference_map import ReferenceMap
from georef.features.nearest import MutualNearest
from georef.geometry.rigid import Rigid3
from georef.types.campaign import Campaign
from georef.types.results import Localized
from tests.worlds.points import NOISE, court, disturbed, new_image, photograph, pose_nees, reference_map

Change = Callable[[int, Rigid3], Rigid3]


def _localized(
    seed: int, change: Change | None = None, epochs: Sequence[str] = (), references: int = 8
) -> tuple[Localized, Rigid3]:
    """A query against references with errors as declared, some of which are changed on top; and the true pose."""
    rng = np.random.default_rng([seed, 7])
    world = court(seed, references=references)
    seen = [photograph(world, pose, rng, clutter=40) for pose in world.references]
    given = [disturbed(pose, NOISE, rng) for pose in world.references]
    if change is not None:
        given = [change(index, pose) for index, pose in enumerate(given)]
    made = reference_map(seen, given, NOISE)
    if epochs:
        images = tuple(replace(image, epoch=epoch) for image, epoch in zip(made.images, epochs, strict=True))
        made = ReferenceMap(Campaign("reference", images), lambda name, _: seen[int(name[1:])].features, NOISE)
    query = photograph(world, world.queries[1], rng, clutter=40, blunders=0.03)
    image = new_image("q", query.truth.translation)
    candidates = CandidatesConfig(ranking="votes", first_count=references)
    outcome = localize_image(image, query.features, made, MutualNearest(), candidates, LocalizeConfig(), 2048)
    assert isinstance(outcome, Localized), outcome
    return outcome, query.truth


def _moved(pose: Rigid3, metres: float) -> Rigid3:
    return Rigid3(pose.rotation, pose.translation + metres * np.array([0.6, 0.64, 0.48]))


def test_references_as_good_as_they_say_stay() -> None:
    dropped = [note for seed in range(12) for note in _localized(seed)[0].notes if "contradicts" in note]
    assert dropped == []


def test_a_reference_that_is_somewhere_else_is_left_out_and_named() -> None:
    for seed in range(4):
        outcome, truth = _localized(seed, lambda index, pose: _moved(pose, 0.08) if index == 3 else pose)
        assert [note.split()[0] for note in outcome.notes] == ["r3"], outcome.notes
        assert "r3" not in {m.reference_id for m in outcome.matches}
        assert pose_nees(truth, outcome.world_from_cam, outcome.world_from_cam_cov) < 22.5  # chi-square 6, 0.999


def test_an_epoch_that_lies_somewhere_else_is_left_out_as_a_whole() -> None:
    epochs = ["old", "new", "new", "old", "new", "new", "old", "new"]
    for seed in range(3):
        outcome, truth = _localized(
            seed, lambda index, pose: _moved(pose, 0.05) if epochs[index] == "old" else pose, epochs
        )
        assert any(note.startswith("epoch old (3 images) contradicts") for note in outcome.notes), outcome.notes
        assert {m.reference_id for m in outcome.matches} <= {"r1", "r2", "r4", "r5", "r7"}
        assert pose_nees(truth, outcome.world_from_cam, outcome.world_from_cam_cov) < 22.5


def test_epochs_that_agree_both_stay() -> None:
    for seed in range(4):
        outcome, _ = _localized(seed, epochs=["old", "new"] * 4)
        assert outcome.notes == ()
        assert len(outcome.matches) == 8
