"""The reference judged by itself: its sigmas recovered, a wrong image found, and too little overlap said so."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
import pytest

from georef.config import AdjustConfig, NetworkConfig
from georef.errors import StageError
from georef.estimation.guided import GuidedOptions, PosedFeatures
from georef.estimation.reference_network import (
    NetworkResult,
    choose_images,
    estimate_noise,
    match_network,
)
from georef.estimation.tracks import PairMatches, nearest_ray_angles
from georef.estimation.widening import widening_angle
from georef.executor import Silent
from georef.geometry.angles import rotation_from_yaw_pitch_roll
from georef.geometry.projection import Views
from georef.geometry.rigid import Array, Rigid3
from georef.geometry.triangulation import triangulate
from georef.types.results import ReferenceNoise
from georef.types.scene import Observations
from tests.worlds.points import CAMERA, NOISE, Seen, common, court, disturbed, photograph, scaled_noise

_NETWORK = NetworkConfig(max_points_per_image=100)
_ADJUST = AdjustConfig()
_OPTIONS = GuidedOptions(3.0, 0.6, 0.95)


@dataclass(frozen=True, eq=False)
class Network:
    """Reference photographs at their given poses, and their true matches."""

    images: list[PosedFeatures]
    matches: list[PairMatches]


def pairs(seen: Sequence[Seen], reach: int = 4) -> list[PairMatches]:
    """Each image with its next neighbours."""
    near = [(i, j) for i, j in combinations(range(len(seen)), 2) if j - i <= reach]
    return [PairMatches(i, j, common(seen[i], seen[j]).indices) for i, j in near]


def network(seed: int, noise: ReferenceNoise, *, images: int = 14, wrong_m: float = 0.0, points: int = 130) -> Network:
    """Image 4 stands `wrong_m` too high."""
    rng = np.random.default_rng([seed, 21])
    world = court(seed, points=points, references=images)
    seen = [photograph(world, pose, rng, keypoint_sigma=noise.keypoint_sigma) for pose in world.references]
    given = [disturbed(pose, noise, rng) for pose in world.references]
    given[4] = Rigid3(given[4].rotation, given[4].translation + np.array([0.0, 0.0, wrong_m]))
    return Network([s.posed(pose) for s, pose in zip(seen, given, strict=True)], pairs(seen))


def estimated(made: Network, declared: ReferenceNoise | None = None) -> NetworkResult:
    return estimate_noise(made.images, made.matches, _NETWORK, _ADJUST, declared)


@pytest.mark.parametrize("poses", [1.0, 8.0])
def test_recovers_the_sigmas_of_the_reference_within_their_own_uncertainty(poses: float) -> None:
    noise = scaled_noise(NOISE, poses=poses)
    ratios: dict[str, list[float]] = {"keypoint": [], "reference_position": [], "reference_rotation": []}
    stated: dict[str, list[float]] = {name: [] for name in ratios}
    for seed in range(4):
        result = estimated(network(seed, noise))
        assert result.suspects == ()
        assert result.noise.source == "estimated"
        ratios["keypoint"].append(result.noise.keypoint_sigma / noise.keypoint_sigma)
        ratios["reference_position"].append(result.noise.position_sigma_m[0] / noise.position_sigma_m[0])
        ratios["reference_rotation"].append(result.noise.rotation_sigma_rad[0] / noise.rotation_sigma_rad[0])
        for name in ("reference_position", "reference_rotation"):
            sigma = result.components[name].factor_sigma
            assert sigma is not None
            stated[name].append(sigma)
    for name in ("reference_position", "reference_rotation"):
        off = np.array(ratios[name]) - 1.0
        tolerance = np.mean(stated[name])
        assert abs(off.mean()) < 3.0 * tolerance / np.sqrt(len(off)) + 0.05, (name, off)
        assert np.abs(off).max() < 5.0 * tolerance, (name, off)
        assert 0.02 < tolerance < 0.4
    assert np.mean(ratios["keypoint"]) == pytest.approx(1.0, abs=0.06)


@pytest.mark.parametrize("wrong_m", [0.06, 0.3, 3.0])
def test_a_wrong_image_is_set_aside_and_no_other(wrong_m: float) -> None:
    for seed in (0, 3):  # in the second, a gate as tight as the sigmas leaves image 4 nothing to be judged by
        result = estimated(network(seed, NOISE, wrong_m=wrong_m))
        assert result.suspects == (4,)
        assert result.noise.position_sigma_m[0] == pytest.approx(NOISE.position_sigma_m[0], rel=0.5)


def test_a_reference_too_good_for_its_keypoints_to_show_is_no_error() -> None:
    result = estimated(network(3, scaled_noise(NOISE, poses=0.05)))
    assert result.noise.position_sigma_m[0] < 0.003
    assert result.suspects == ()


def test_a_declared_noise_is_kept_apart_from_the_keypoint_sigma() -> None:
    declared = ReferenceNoise(1.0, (0.01, 0.02, 0.03), (1e-4, 2e-4, 3e-4), "declared")
    result = estimated(network(5, NOISE), declared)
    assert result.noise.position_sigma_m == declared.position_sigma_m
    assert result.noise.rotation_sigma_rad == declared.rotation_sigma_rad
    assert result.noise.source == "declared"
    assert result.noise.keypoint_sigma == pytest.approx(NOISE.keypoint_sigma, rel=0.15)


def test_matches_of_the_known_geometry_are_true_and_of_all_neighbours() -> None:
    world, rng = court(6, points=200), np.random.default_rng(6)
    seen = [photograph(world, pose, rng, clutter=100) for pose in world.references]
    found = match_network([s.posed() for s in seen], 3, _OPTIONS, Silent())
    assert len(found) == len({(m.a, m.b) for m in found})
    assert all(m.a < m.b for m in found)
    in_pairs = np.bincount([i for m in found for i in (m.a, m.b)], minlength=len(seen))
    assert in_pairs.min() >= 3
    matched = np.concatenate(
        [np.column_stack([seen[m.a].point[m.indices[:, 0]], seen[m.b].point[m.indices[:, 1]]]) for m in found]
    )
    assert len(matched) > 300
    assert (matched[:, 0] == matched[:, 1]).mean() > 0.98


def test_guided_matches_serve_as_well_as_true_ones() -> None:
    noise = scaled_noise(NOISE, poses=0.5)
    rng = np.random.default_rng(7)
    world = court(7, points=130, references=10)
    seen = [photograph(world, pose, rng, clutter=60, blunders=0.03) for pose in world.references]
    images = [s.posed(disturbed(s.truth, noise, rng)) for s in seen]
    matches = match_network(images, 4, _OPTIONS, Silent())
    result = estimated(Network(images, matches))
    assert result.noise.position_sigma_m[0] == pytest.approx(noise.position_sigma_m[0], rel=0.6)
    assert result.noise.keypoint_sigma == pytest.approx(noise.keypoint_sigma, rel=0.15)


def test_too_few_common_points_are_an_error_that_says_what_to_declare() -> None:
    made = network(8, NOISE, points=20)
    with pytest.raises(StageError, match=r"share only \d+ points"):
        estimated(made)
    with pytest.raises(StageError, match="share only 0 points"):
        estimated(Network(made.images, []))


def test_chosen_images_lie_together() -> None:
    positions = np.column_stack([np.arange(100.0), np.zeros(100), np.zeros(100)])
    rng = np.random.default_rng(9)
    shuffled = rng.permutation(100)
    chosen = choose_images(positions[shuffled], 11)
    assert len(chosen) == 11
    assert np.ptp(positions[shuffled][chosen, 0]) <= 11
    assert (np.diff(chosen) > 0).all()
    np.testing.assert_array_equal(choose_images(positions[:5], 11), np.arange(5))


def around(rng: np.random.Generator, widening_rad: float, count: int = 3000) -> tuple[Array, Observations, Views]:
    """Points seen by two to four of the cameras on an arc about them, noise growing with the angle between rays."""
    yaw = np.radians(np.sort(rng.uniform(-70, 70, 40)))
    poses = []
    for angle in yaw:
        rotation = rotation_from_yaw_pitch_roll([angle, 0.0, 0.0])
        poses.append(Rigid3(rotation, -20.0 * rotation[:, 2]))
    centres = np.array([pose.translation for pose in poses])
    points = rng.uniform(-2, 2, (count, 3))
    rays = rng.integers(2, 5, count)
    first = rng.integers(0, 40, count)
    seen_by = [(f + rng.permutation(14)[:n]) % 40 for f, n in zip(first, rays, strict=True)]
    view = np.concatenate(seen_by)
    point = np.repeat(np.arange(count), rays)
    views = Views.of(poses, [CAMERA] * 40)
    exact = Observations(
        point, view, views.project(view, points[point]), np.full(len(point), 0.5), np.arange(len(point))
    )
    wide = ReferenceNoise(1.0, (1.0, 1.0, 1.0), (1.0, 1.0, 1.0), "declared", widening_rad)
    sigma = 0.5 * wide.widening(nearest_ray_angles(points, exact, centres))
    pixel = exact.pixel + sigma[:, None] * rng.normal(size=(len(point), 2))
    solved = triangulate(views, point, view, pixel, exact.sigma_px, count)
    return solved.points, Observations(point, view, pixel, exact.sigma_px, exact.keypoint), views


@pytest.mark.parametrize("true_deg", [5.0, 15.0, 40.0])
def test_how_keypoints_grow_uncertain_with_the_angle_is_recovered(true_deg: float) -> None:
    found = [np.degrees(widening_angle(*around(np.random.default_rng([3, i]), np.radians(true_deg)))) for i in range(3)]
    assert 0.75 * true_deg < np.median(found) < 1.35 * true_deg


def test_no_growth_with_the_angle_is_nearly_none() -> None:
    assert np.degrees(widening_angle(*around(np.random.default_rng(4), np.inf))) > 200.0
