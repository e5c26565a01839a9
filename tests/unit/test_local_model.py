"""The local model: exact without noise, covariances against Monte Carlo, what is inconsistent or weak left out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from georef.estimation.local_model import LocalModel, query_centred_model
from georef.geometry.rigid import Array, Rigid3
from georef.types.features import Matches
from tests.worlds.points import NOISE, Seen, World, common, court, photograph, scaled_noise

_SIGMA = NOISE.keypoint_sigma
_EXACT = 1e-5


def photographs(world: World, seed: int, sigma: float = _SIGMA, blunders: float = 0.0) -> tuple[Seen, list[Seen]]:
    """The first query, and the references; blunders are in the references."""
    rng = np.random.default_rng(seed)
    query = photograph(world, world.queries[0], rng, keypoint_sigma=sigma)
    return query, [photograph(world, p, rng, keypoint_sigma=sigma, blunders=blunders) for p in world.references]


def model_of(query: Seen, references: list[Seen], sigma: float = _SIGMA) -> LocalModel:
    return query_centred_model([r.posed() for r in references], [common(query, r) for r in references], sigma)


def errors(world: World, query: Seen, model: LocalModel) -> Array:
    return model.points - world.points[query.point[model.keypoint]]


@pytest.mark.parametrize("origin", [(0.0, 0.0, 0.0), (4e5, 5e6, 300.0)])
def test_exact_keypoints_give_the_points_and_keep_every_observation(origin: tuple[float, ...]) -> None:
    world = court(1, origin=origin)
    query, references = photographs(world, 1, sigma=_EXACT)
    model = model_of(query, references)
    assert np.abs(errors(world, query, model)).max() < 2e-3  # keypoints are float32: 1e-4 px
    seen = np.bincount(np.concatenate([r.point[common(query, r).indices[:, 1]] for r in references]), minlength=300)
    used = np.bincount(model.observations.point, minlength=len(model))
    np.testing.assert_array_equal(used, seen[query.point[model.keypoint]])
    assert used.min() >= 2


def test_covariances_hold_in_monte_carlo() -> None:
    world = court(2)
    ratios = []
    for seed in range(12):
        query, references = photographs(world, seed)
        model = model_of(query, references)
        error = errors(world, query, model)
        ratios.append(np.einsum("pi,pij,pj->p", error, np.linalg.inv(model.cov), error) / 3.0)
    mean = np.mean(np.concatenate(ratios))
    assert len(np.concatenate(ratios)) > 600
    assert 0.9 < mean < 1.1, mean


def test_inconsistent_observations_leave_and_their_points_stay_where_others_agree() -> None:
    world = court(3)
    query, references = photographs(world, 3, blunders=0.1)
    model = model_of(query, references)
    obs = model.observations
    blunder = np.array([references[v].blunder[k] for v, k in zip(obs.view, obs.keypoint, strict=True)])
    matched = [common(query, r).indices[:, 1] for r in references]
    planted = sum(int(r.blunder[k].sum()) for r, k in zip(references, matched, strict=True))
    healthy = sum(int((~r.blunder[k]).sum()) for r, k in zip(references, matched, strict=True))
    assert planted > 20
    assert blunder.sum() < 0.1 * planted  # two observations agree by chance where the error is along the epipolar line
    assert (~blunder).sum() > 0.75 * healthy
    many = np.bincount(obs.point)[obs.point] >= 3
    assert blunder[many].sum() <= 0.01 * many.sum()


def test_observations_are_of_the_matched_keypoints() -> None:
    world = court(4)
    query, references = photographs(world, 4)
    model = model_of(query, references)
    obs = model.observations
    for index, reference in enumerate(references):
        here = obs.view == index
        np.testing.assert_array_equal(reference.point[obs.keypoint[here]], query.point[model.keypoint[obs.point[here]]])
        np.testing.assert_allclose(obs.pixel[here], reference.posed().pixels[obs.keypoint[here]])
        scales = reference.features.scales_px[obs.keypoint[here]]
        np.testing.assert_allclose(obs.sigma_px[here], _SIGMA * scales)


def test_points_of_unknown_depth_are_left_out() -> None:
    """Two cameras 2 cm apart see the points, but not how far they are."""
    world = court(5)
    first = world.references[0]
    beside = Rigid3(first.rotation, first.translation + np.array([0.02, 0.0, 0.0]))
    narrow = replace(world, references=(first, beside))
    query, references = photographs(narrow, 5)
    assert len(common(query, references[0])) > 30
    assert len(model_of(query, references)) == 0
    assert len(model_of(*photographs(replace(world, references=(first, world.references[2])), 5))) > 20


def test_take_keeps_the_observations_of_what_it_keeps() -> None:
    query, references = photographs(court(6), 6)
    model = model_of(query, references)
    chosen = np.arange(len(model)) % 3 == 1
    part = model.take(chosen)
    np.testing.assert_array_equal(part.keypoint, model.keypoint[chosen])
    for point in range(len(part)):
        whole = model.observations.take(model.observations.point == np.flatnonzero(chosen)[point])
        kept = part.observations.take(part.observations.point == point)
        np.testing.assert_array_equal(kept.keypoint, whole.keypoint)
        np.testing.assert_array_equal(kept.view, whole.view)


def test_nothing_in_nothing_out() -> None:
    query, references = photographs(court(7), 7)
    posed = [r.posed() for r in references]
    assert len(query_centred_model(posed, [Matches.empty()] * len(posed), _SIGMA)) == 0
    alone = [common(query, references[0]), *[Matches.empty()] * (len(posed) - 1)]
    assert len(query_centred_model(posed, alone, _SIGMA)) == 0


def test_larger_reference_errors_lose_observations_but_give_no_wrong_ones() -> None:
    """Errors of the reference poses of a few pixels: what stays agrees with the poses as they are given."""
    world, rng = court(8), np.random.default_rng(8)
    noise = scaled_noise(NOISE, poses=3.0)
    query, references = photographs(world, 8)
    moved = [
        r.posed(r.truth.retract(np.linalg.cholesky(noise.pose_cov(r.truth)) @ rng.normal(size=6))) for r in references
    ]
    matches = [common(query, r) for r in references]
    model = query_centred_model(moved, matches, _SIGMA)
    full = query_centred_model([r.posed() for r in references], matches, _SIGMA)
    assert 0.5 * len(full) < len(model) <= len(full)
    pixel = model.views.project(model.observations.view, model.points[model.observations.point])
    distance = np.linalg.norm(pixel - model.observations.pixel, axis=1) / model.observations.sigma_px
    assert distance.max() <= 3.5 + 1e-9


def test_no_references_no_points() -> None:
    assert len(query_centred_model([], [], _SIGMA)) == 0
