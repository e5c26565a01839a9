"""The precomputed map: pairs, blocks, points against the truth, and localization against it."""

from __future__ import annotations

import numpy as np
import pytest

from georef.config import CandidatesConfig, LocalizeConfig
from georef.estimation.global_model import block_structure, blocks_of, choose_pairs, global_model, match_pair
from georef.estimation.localization import localize_image
from georef.estimation.reference_map import ReferenceMap
from georef.features.nearest import MutualNearest
from georef.geometry.frusta import Frusta
from georef.geometry.rigid import Rigid3
from georef.types.campaign import Campaign
from georef.types.features import Matches
from georef.types.results import Localized, ReferenceNoise
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

CONFIG = LocalizeConfig(method="global-model")


def structures_of(reference: ReferenceMap, noise: ReferenceNoise, block_size: int) -> dict[int, ImageStructure]:
    posed = {index: reference.posed(index) for index in range(len(reference))}
    pairs = choose_pairs(Frusta.of(reference.poses, [CAMERA] * len(reference), 30.0), 4)
    matches = {(a, b): match_pair(posed[a], posed[b], MutualNearest(), 2048, 3.0).indices for a, b in pairs}
    out = {}
    for block in blocks_of(reference.positions, block_size):
        members = {int(i) for i in block} | {i for pair in pairs if set(pair) & set(block.tolist()) for i in pair}
        inside = {pair: m for pair, m in matches.items() if members.issuperset(pair)}
        out |= block_structure(block.tolist(), {i: posed[i] for i in sorted(members)}, inside, noise)
    return out


def mapped(
    world: World, seed: int, noise: ReferenceNoise = NOISE, *, block_size: int = 100, blunders: float = 0.05
) -> tuple[ReferenceMap, Seen, list[Seen], dict[int, ImageStructure]]:
    """References with pose errors and their map; a photograph of the third query pose."""
    rng = np.random.default_rng([seed, 31])
    seen = [photograph(world, pose, rng, clutter=80) for pose in world.references]
    plain = reference_map(seen, [disturbed(pose, noise, rng) for pose in world.references], noise)
    found = structures_of(plain, noise, block_size)

    def read(image_id: str, count: int | None):
        features = seen[int(image_id[1:])].features
        return features if count is None else features.head(count)

    reference = ReferenceMap(Campaign("reference", plain.images), read, noise, found.__getitem__)
    return reference, photograph(world, world.queries[2], rng, clutter=80, blunders=blunders), seen, found


def localized(reference: ReferenceMap, query: Seen) -> Localized:
    image = new_image("q", query.truth.translation + np.array([1.0, -1.5, 2.0]))
    outcome = localize_image(
        image, query.features, reference, MutualNearest(), CandidatesConfig(ranking="votes"), CONFIG, 2048
    )
    assert isinstance(outcome, Localized), outcome
    return outcome


def test_map_points_are_where_the_world_has_them() -> None:
    world = court(1)
    _, _, seen, found = mapped(world, 1, scaled_noise(NOISE, poses=1e-6))
    for index, structure in found.items():
        assert len(structure) > 60
        true = world.points[seen[index].point[structure.keypoint]]
        off = structure.points - true
        good = np.linalg.norm(off, axis=1) < 1.0
        assert good.mean() > 0.97
        squares = np.einsum("ni,nij,nj->n", off[good], np.linalg.inv(structure.cov[good]), off[good]) / 3.0
        assert 0.6 < np.median(squares) / 0.789 < 1.5  # of a chi-square with 3 degrees of freedom over 3
        obs = structure.observations
        assert np.array_equal(structure.identity[obs.point], _firsts(structure)[obs.point])
        own = obs.view == index
        assert np.array_equal(np.sort(obs.keypoint[own]), structure.keypoint)


def _firsts(structure: ImageStructure) -> np.ndarray:
    obs = structure.observations
    rows = np.searchsorted(obs.point, np.arange(len(structure)))
    return np.column_stack([obs.view[rows], obs.keypoint[rows]])


def test_blocks_hold_every_image_once_and_are_small() -> None:
    positions = np.random.default_rng(0).uniform(0, 100, (57, 3))
    blocks = blocks_of(positions, 10)
    assert max(len(block) for block in blocks) <= 10
    assert sorted(np.concatenate(blocks).tolist()) == list(range(57))
    assert np.mean([np.ptp(positions[b], axis=0).max() for b in blocks]) < 70.0


def test_blocks_give_nearly_the_map_of_all_at_once() -> None:
    whole = mapped(court(2), 2)[3]
    parts = mapped(court(2), 2, block_size=2)[3]
    for index, structure in whole.items():
        both, a, b = np.intersect1d(structure.keypoint, parts[index].keypoint, return_indices=True)
        assert len(both) > 0.9 * len(structure)
        off = np.linalg.norm(structure.points[a] - parts[index].points[b], axis=1)
        assert np.quantile(off, 0.9) < 0.05


def test_pairs_look_at_the_same_place() -> None:
    world = court(3)
    turn = Rigid3(np.diag([-1.0, 1.0, -1.0]), np.zeros(3))  # about the vertical image axis
    poses = [*world.references, world.references[0] @ turn]
    pairs = choose_pairs(Frusta.of(poses, [CAMERA] * len(poses), 30.0), 3)
    assert all(a < b < len(world.references) for a, b in pairs)
    assert {index for pair in pairs for index in pair} == set(range(len(world.references)))
    assert len(pairs) == len(set(pairs)) <= 3 * len(world.references)


def test_matches_that_contradict_the_poses_are_dropped() -> None:
    rng = np.random.default_rng(4)
    world = court(4)
    a, b = (photograph(world, pose, rng, blunders=0.3) for pose in world.references[:2])
    kept = match_pair(a.posed(), b.posed(), MutualNearest(), 2048, 3.0)
    everything = MutualNearest().match(a.features, b.features)
    wrong = a.blunder[kept.indices[:, 0]] | b.blunder[kept.indices[:, 1]]
    wrong_before = a.blunder[everything.indices[:, 0]] | b.blunder[everything.indices[:, 1]]
    assert wrong_before.mean() > 0.4
    assert wrong.mean() < 0.15
    assert (~wrong).sum() > 0.95 * (~wrong_before).sum()
    assert len(match_pair(a.posed(), photograph(world, a.truth, rng).posed(), MutualNearest(), 2048, 3.0)) == 0


def test_a_keypoint_may_come_with_several_points_and_one_remains() -> None:
    reference, query, seen, found = mapped(court(5), 5)
    matches = {i: MutualNearest().match(query.features, s.features) for i, s in enumerate(seen)}
    wrong = Matches(matches[1].indices.copy(), matches[1].scores)
    wrong.indices[:, 1] = np.roll(wrong.indices[:, 1], 1)  # each keypoint now has a second, false point
    model, chosen = global_model(found, {**matches, 1: wrong}, reference.views)
    assert len(model) > len(np.unique(model.keypoint)) > 60
    assert len({*zip(model.keypoint, map(tuple, model.points), strict=True)}) == len(model)
    assert set(chosen) <= set(range(len(reference)))
    assert model.observations.view.max() < len(chosen) == len(model.views)
    outcome = localized(reference, query)
    assert len(np.unique(outcome.keypoints)) == len(outcome.keypoints) > 40


def test_no_map_is_an_error_and_not_another_method() -> None:
    reference, query, _, _ = mapped(court(6), 6)
    bare = ReferenceMap(Campaign("reference", reference.images), reference._read, NOISE)
    with pytest.raises(ValueError, match="no precomputed map"):
        localized(bare, query)


def test_poses_and_covariances_are_honest() -> None:
    values: list[float] = []
    errors: list[float] = []
    for seed in range(20):
        reference, query, _, _ = mapped(court(seed % 5), seed)
        outcome = localized(reference, query)
        values.append(pose_nees(query.truth, outcome.world_from_cam, outcome.world_from_cam_cov) / 6.0)
        errors.append(float(np.linalg.norm(outcome.world_from_cam.translation - query.truth.translation)))
    assert 0.001 < np.median(errors) < 0.03, np.median(errors)
    assert 0.6 < np.mean(values) < 1.7, np.mean(values)
