"""Tracks: one point each, conflicts left out, spread over the images, renumbered with their points."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest

from georef.estimation.tracks import (
    PairMatches,
    build_tracks,
    distributed,
    nearest_ray_angles,
    quantized,
    select_points,
    triangulated_tracks,
)
from georef.types.scene import Observations
from tests.worlds.points import NOISE, Seen, common, court, disturbed, loose_cov, photograph, scaled_noise

_SIGMA = NOISE.keypoint_sigma


def photographs(seed: int, count: int = 4, **options: float) -> list[Seen]:
    world, rng = court(seed, references=count), np.random.default_rng(seed)
    return [photograph(world, pose, rng, **options) for pose in world.references]  # pyright: ignore[reportArgumentType]


def all_pairs(seen: list[Seen]) -> list[PairMatches]:
    return [PairMatches(i, j, common(seen[i], seen[j]).indices) for i, j in combinations(range(len(seen)), 2)]


def points_of(seen: list[Seen], obs: Observations) -> list[set[int]]:
    """The true points behind the observations of each track."""
    out: list[set[int]] = [set() for _ in range(int(obs.point.max()) + 1)]
    for point, view, keypoint in zip(obs.point, obs.view, obs.keypoint, strict=True):
        out[point].add(int(seen[view].point[keypoint]))
    return out


def test_a_track_is_one_point_with_all_its_observations() -> None:
    seen = photographs(1)
    posed = [s.posed() for s in seen]
    count, obs = build_tracks(posed, all_pairs(seen), _SIGMA)
    truth = points_of(seen, obs)
    assert count == len(truth) == len({next(iter(t)) for t in truth})
    assert all(len(t) == 1 for t in truth)
    in_images = np.bincount(np.concatenate([s.point for s in seen]), minlength=300)
    np.testing.assert_array_equal(np.bincount(obs.point), [in_images[next(iter(t))] for t in truth])
    for view, image in enumerate(posed):
        here = obs.view == view
        np.testing.assert_array_equal(obs.pixel[here], image.pixels[obs.keypoint[here]])
        ratio = obs.sigma_px[here] / (_SIGMA * image.features.scales_px[obs.keypoint[here]])
        assert np.abs(np.log2(ratio)).max() <= 0.125 + 1e-6


def test_a_chain_of_pairs_is_one_track() -> None:
    seen = photographs(2, 3)
    chain = [PairMatches(0, 1, common(seen[0], seen[1]).indices), PairMatches(1, 2, common(seen[1], seen[2]).indices)]
    _, obs = build_tracks([s.posed() for s in seen], chain, _SIGMA)
    in_all = set(seen[0].point) & set(seen[1].point) & set(seen[2].point)
    assert len(in_all) > 20
    assert np.count_nonzero(np.bincount(obs.point) == 3) == len(in_all)


def test_an_image_with_two_keypoints_leaves_the_track() -> None:
    """Keypoint 0 of image 0 is matched with 0 of image 1; a wrong match ties 1 of image 0 to the same track."""
    posed = [s.posed() for s in photographs(3, 3)]
    matches = [
        PairMatches(0, 1, np.array([[0, 0], [5, 5]], np.int32)),
        PairMatches(1, 2, np.array([[0, 0], [5, 5]], np.int32)),
        PairMatches(0, 2, np.array([[1, 0], [5, 5]], np.int32)),
    ]
    count, obs = build_tracks(posed, matches, _SIGMA)
    tracks = {tuple(sorted(zip(obs.view[obs.point == p], obs.keypoint[obs.point == p], strict=True))) for p in range(2)}
    assert count == 2
    assert tracks == {((1, 0), (2, 0)), ((0, 5), (1, 5), (2, 5))}


def test_no_matches_no_tracks() -> None:
    posed = [s.posed() for s in photographs(4, 2)]
    for matches in ([], [PairMatches(0, 1, np.zeros((0, 2), np.int32))]):
        count, obs = build_tracks(posed, matches, _SIGMA)
        assert (count, len(obs)) == (0, 0)


def test_quantized_sigmas_are_few_and_near() -> None:
    sigma = np.exp(np.random.default_rng(5).uniform(-2, 2, 1000))
    rounded = quantized(sigma)
    assert len(np.unique(rounded)) < 30
    assert np.abs(rounded / sigma - 1.0).max() <= 2**0.125 - 1 + 1e-9
    assert np.mean(np.log(rounded / sigma)) == pytest.approx(0.0, abs=0.01)


def test_triangulated_tracks_are_renumbered_with_their_points_and_lose_blunders() -> None:
    world, rng = court(6), np.random.default_rng(6)
    seen = [photograph(world, pose, rng, blunders=0.08) for pose in world.references]
    noise = scaled_noise(NOISE, poses=3.0)
    images = [s.posed(disturbed(s.truth, noise, rng)) for s in seen]
    count, obs = build_tracks(images, all_pairs(seen), _SIGMA)
    points, kept = triangulated_tracks(count, obs, images, [noise.pose_cov(s.truth) for s in seen])
    assert len(points) == kept.point.max() + 1 == len(np.unique(kept.point))
    truth = np.array([next(iter(t)) for t in points_of(seen, kept)])
    error = np.linalg.norm(points - world.points[truth], axis=1)
    assert np.median(error) < 0.1
    assert np.quantile(error, 0.95) < 0.4
    assert set(np.unique(kept.sigma_px)) <= set(np.unique(obs.sigma_px))  # the loose sigmas were for the gate alone
    blunder = np.array([seen[v].blunder[k] for v, k in zip(kept.view, kept.keypoint, strict=True)])
    planted = np.array([seen[v].blunder[k] for v, k in zip(obs.view, obs.keypoint, strict=True)])
    assert planted.sum() > 30
    assert blunder.sum() < 0.2 * planted.sum()
    assert (~blunder).sum() > 0.7 * (~planted).sum()


def test_loose_poses_keep_tracks_that_tight_poses_would_lose() -> None:
    world, rng = court(7), np.random.default_rng(7)
    seen = [photograph(world, pose, rng) for pose in world.references]
    images = [s.posed(s.truth.retract(rng.normal(size=6) * np.repeat([0.003, 0.05], 3))) for s in seen]
    count, obs = build_tracks(images, all_pairs(seen), _SIGMA)
    loose, tight = (
        len(triangulated_tracks(count, obs, images, [loose_cov(s.truth, *sigmas) for s in seen])[0])
        for sigmas in ((0.05, 0.003), (1e-4, 1e-6))
    )
    assert loose > 1.5 * tight


def scattered(views: int, per_view: int, seed: int) -> tuple[Observations, np.ndarray]:
    """Points seen in all views, crowded in one corner; and the image sizes."""
    rng = np.random.default_rng(seed)
    pixel = np.concatenate([rng.uniform(0, [300, 200], (per_view - 200, 2)), rng.uniform(0, [3000, 2000], (200, 2))])
    point = np.tile(np.arange(per_view), views)
    view = np.repeat(np.arange(views), per_view)
    size = len(point)
    return (
        Observations(point, view, np.tile(pixel, (views, 1)), np.ones(size), np.arange(size)),
        np.tile([3000.0, 2000.0], (views, 1)),
    )


def test_distributed_thins_the_crowd_and_keeps_the_lonely() -> None:
    obs, sizes = scattered(2, 2000, 8)
    keep = distributed(obs, sizes, np.array([True, True]), 192)
    crowd = (obs.pixel[:2000] < [250, 250]).all(axis=1)
    assert keep[crowd].sum() <= 4
    assert keep[~crowd].sum() > 80
    assert keep.sum() <= 192
    everything = distributed(obs, sizes, np.array([True, True]), 96 * 2000)
    assert everything.all()


def test_distributed_prefers_long_tracks_and_counts_limited_views_alone() -> None:
    obs, sizes = scattered(3, 2000, 9)
    long = np.arange(2000) % 7 == 0
    obs = obs.take((obs.view < 2) | long[obs.point])
    keep = distributed(obs, sizes, np.array([True, True, False]), 96)
    crowd = np.flatnonzero((obs.pixel[:2000] < [250, 250]).all(axis=1))
    assert long[crowd[keep[crowd]]].all()
    only_third = obs.take(obs.view == 2)
    assert not distributed(only_third, sizes, np.array([True, True, False]), 96).any()


def test_select_points_renumbers() -> None:
    obs, _ = scattered(2, 300, 10)
    points = np.random.default_rng(10).normal(size=(300, 3))
    keep = np.arange(300) % 3 == 0
    chosen, kept = select_points(points, obs, keep)
    np.testing.assert_array_equal(chosen, points[::3])
    np.testing.assert_array_equal(3 * kept.point, obs.point[keep[obs.point]])
    empty, none = select_points(points, replace(obs), np.zeros(300, bool))
    assert (len(empty), len(none)) == (0, 0)


def test_the_angle_of_each_ray_to_the_nearest_other_of_its_point() -> None:
    across = np.radians([0.0, 10.0, 35.0, 90.0])
    centres = np.column_stack([np.sin(across), np.cos(across), np.zeros(4)]) * [[1.0], [2.0], [3.0], [4.0]]
    point, view = np.array([0, 1, 0, 1, 0, 2]), np.array([2, 0, 0, 3, 1, 1])
    observations = Observations(point, view, np.zeros((6, 2)), np.ones(6), np.arange(6))
    angle = np.degrees(nearest_ray_angles(np.zeros((3, 3)), observations, centres))
    np.testing.assert_allclose(angle, [25.0, 90.0, 10.0, 90.0, 10.0, np.inf], atol=1e-9)
