"""Guided matching: geometry against its definition, recall and precision on a world that knows the truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from georef.estimation.guided import (
    GuidedOptions,
    PosedFeatures,
    epipolar_band,
    epipolar_distances,
    essential_matrix,
    guided_matches,
)
from georef.geometry.rigid import Rigid3
from georef.types.features import Matches
from tests.worlds.points import Seen, common, court, photograph

_OPTIONS = GuidedOptions(gate=3.0, min_similarity=0.6, ratio=0.95)


def two_photographs(seed: int, *, clutter: int = 0, blunders: float = 0.0, points: int = 300) -> tuple[Seen, Seen]:
    world, rng = court(seed, points=points), np.random.default_rng(seed)
    first, second = world.references[1], world.references[3]
    return photograph(world, first, rng, clutter=clutter), photograph(
        world, second, rng, clutter=clutter, blunders=blunders
    )


def test_essential_matrix_vanishes_on_exact_pairs() -> None:
    world, rng = court(1), np.random.default_rng(1)
    a, b = (photograph(world, world.references[i], rng, keypoint_sigma=0.0) for i in (0, 3))
    pairs = common(a, b).indices
    posed_a, posed_b = a.posed(), b.posed()
    rays_a, rays_b = posed_a.bearings.rays[pairs[:, 0]], posed_b.bearings.rays[pairs[:, 1]]
    assert np.abs(np.einsum("ni,ij,nj->n", rays_b, essential_matrix(posed_a, posed_b), rays_a)).max() < 1e-5
    distance = epipolar_distances(posed_a, posed_b, pairs)
    assert len(pairs) > 50
    assert distance.max() < 1e-3  # float32 keypoints


def test_band_is_symmetric_and_in_keypoint_scales() -> None:
    a, b = two_photographs(2, clutter=40)
    band = epipolar_band(a.posed(), b.posed(), 3.0)
    np.testing.assert_array_equal(band, epipolar_band(b.posed(), a.posed(), 3.0).T)
    pairs = common(a, b).indices
    assert band[pairs[:, 0], pairs[:, 1]].mean() > 0.97  # noise of 0.4 scales a coordinate in each image
    assert band.mean() < 0.05
    coarse_a, coarse_b = (
        replace(s.posed(), features=replace(s.features, scales_px=10.0 * s.features.scales_px)) for s in (a, b)
    )
    wide = epipolar_band(coarse_a, coarse_b, 0.3)
    np.testing.assert_array_equal(wide, band)


@pytest.mark.parametrize("origin", [(0.0, 0.0, 0.0), (4e5, 5e6, 300.0)])
def test_finds_the_true_pairs_among_clutter(origin: tuple[float, ...]) -> None:
    world, rng = court(3, origin=origin), np.random.default_rng(3)
    a, b = (photograph(world, world.references[i], rng, clutter=300) for i in (1, 3))
    found = guided_matches(a.posed(), b.posed(), _OPTIONS)
    truth = {tuple(pair) for pair in common(a, b).indices.tolist()}
    pairs = {tuple(pair) for pair in found.indices.tolist()}
    assert len(pairs & truth) > 0.95 * len(truth)
    assert len(pairs - truth) <= 0.02 * len(pairs)
    assert ((found.scores >= 0.6) & (found.scores <= 1.0 + 1e-6)).all()


def test_keypoints_off_their_epipolar_line_find_no_partner() -> None:
    a, b = two_photographs(4, blunders=0.3, points=600)
    found = guided_matches(a.posed(), b.posed(), _OPTIONS)
    planted = int(b.blunder[common(a, b).indices[:, 1]].sum())
    assert planted > 20
    assert b.blunder[found.indices[:, 1]].sum() <= 0.2 * planted  # the share that moved along the line


def test_each_keypoint_once_and_known_matches_inside_the_band_are_kept() -> None:
    a, b = two_photographs(5, clutter=100)
    pairs = common(a, b)
    posed_a, posed_b = a.posed(), b.posed()
    band = epipolar_band(posed_a, posed_b, _OPTIONS.gate)
    wrong = np.argwhere(~band)[0].astype(np.int32)
    chosen = pairs.indices[:20]
    chosen = chosen[(chosen[:, 0] != wrong[0]) & (chosen[:, 1] != wrong[1])]
    known = Matches(np.vstack([chosen, wrong]), np.full(len(chosen) + 1, 0.25, np.float32))
    found = guided_matches(posed_a, posed_b, _OPTIONS, known)
    assert len(np.unique(found.indices[:, 0])) == len(np.unique(found.indices[:, 1])) == len(found)
    kept = found.indices[found.scores == 0.25].tolist()
    assert kept == [pair for pair in chosen.tolist() if band[pair[0], pair[1]]]
    assert len(kept) > 15
    assert len(found) > len(kept) + 30


def test_the_ratio_refuses_two_alike_on_one_line() -> None:
    """A second keypoint with the same look near the first, on the same line: neither is distinct."""
    a, b = two_photographs(6)
    pairs = common(a, b).indices
    twins = b.features.take(np.concatenate([np.arange(len(b.features)), pairs[:, 1]]))
    twins.keypoints_px[len(b.features) :] += 0.2
    doubled = PosedFeatures.of(twins, b.posed().camera, b.truth)
    assert len(guided_matches(a.posed(), b.posed(), _OPTIONS)) > 0.9 * len(pairs)
    assert len(guided_matches(a.posed(), doubled, _OPTIONS)) < 0.1 * len(pairs)


def test_empty_images_and_equal_positions_give_no_matches() -> None:
    a, b = two_photographs(7)
    nothing = replace(a, features=a.features.head(0)).posed()
    assert len(guided_matches(nothing, b.posed(), _OPTIONS)) == 0
    assert len(guided_matches(b.posed(), nothing, _OPTIONS)) == 0
    turned = Rigid3(b.truth.rotation, a.truth.translation)
    assert len(guided_matches(a.posed(), b.posed(turned), _OPTIONS)) == 0
