"""Wide, distorted and unknown cameras through matching, localization and adjustment."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import chi2

from georef.config import CandidatesConfig, LocalizeConfig
from georef.estimation.guided import GuidedOptions, epipolar_band, epipolar_distances, guided_matches
from georef.estimation.localization import localize_image
from georef.evaluation.statistics import nees
from georef.features.nearest import MutualNearest
from georef.geometry.camera import Camera, project
from georef.io.items import read_outcome, write_outcome
from georef.types.campaign import Campaign
from georef.types.results import Localized, Outcome, Rejected, RejectReason, with_estimated_cameras
from tests.worlds.adjusted import adjusted
from tests.worlds.blocks import block
from tests.worlds.points import (
    CAMERA,
    NOISE,
    World,
    common,
    court,
    disturbed,
    flat_wall,
    hall,
    new_image,
    photograph,
    pose_nees,
    reference_map,
    scaled_noise,
)

FISHEYE = Camera("f190", 2600, 2600, 790.0, 791.0, 1305.0, 1296.0, (-0.015, 1e-3, -1e-4), "fisheye")
FISHEYE_120 = Camera("f120", 3000, 2400, 1830.0, 1826.0, 1510.0, 1190.0, (-0.02, 3e-3), "fisheye")
STRONG_BROWN = Camera("strong", 3000, 2000, 1500.0, 1502.0, 1490.0, 1010.0, (-0.25, 0.08, 5e-4, -4e-4, -0.01))
LONG = Camera("long", 3000, 2000, 2600.0, 2600.0, 1500.0, 1000.0)


# --- guided matching ------------------------------------------------------------------------------


@pytest.mark.parametrize(("first", "second"), [(FISHEYE, FISHEYE), (FISHEYE, CAMERA), (STRONG_BROWN, FISHEYE_120)])
def test_guided_matches_of_any_two_cameras(first: Camera, second: Camera) -> None:
    world, rng = hall(3, points=500), np.random.default_rng(3)
    a = photograph(world, world.references[1], rng, clutter=200, camera=first)
    b = photograph(world, world.references[3], rng, clutter=200, camera=second)
    truth = {tuple(pair) for pair in common(a, b).indices.tolist()}
    found = guided_matches(a.posed(), b.posed(), GuidedOptions(gate=3.0, min_similarity=0.6, ratio=0.95))
    pairs = {tuple(pair) for pair in found.indices.tolist()}
    assert len(truth) > 40
    assert len(pairs & truth) > 0.95 * len(truth)
    assert len(pairs - truth) <= 0.02 * len(pairs)
    assert epipolar_band(a.posed(), b.posed(), 3.0).mean() < 0.06


def test_the_epipolar_distance_of_a_fisheye_is_in_its_pixels() -> None:
    """A keypoint moved across its epipolar curve by so many pixels is that far from it, also to the side."""
    world, rng = hall(4, points=500), np.random.default_rng(4)
    a, b = (photograph(world, world.references[i], rng, keypoint_sigma=0.0, camera=FISHEYE) for i in (0, 4))
    pairs = common(a, b).indices
    posed_a, posed_b = a.posed(), b.posed()
    assert np.median(epipolar_distances(posed_a, posed_b, pairs)[:, 1]) < 1e-3
    centre_of_a = posed_b.world_from_cam.inverse().apply(posed_a.world_from_cam.translation)
    for k, (_, in_b) in enumerate(pairs[:40]):
        ray = posed_b.bearings.rays[in_b]
        along = project(FISHEYE, np.stack([ray + 1e-4 * centre_of_a, ray - 1e-4 * centre_of_a]))
        curve = (along[0] - along[1]) / np.linalg.norm(along[0] - along[1])
        moved = b.features.keypoints_px.copy()
        moved[in_b] += 4.0 * np.array([-curve[1], curve[0]])
        other = replace(b, features=replace(b.features, keypoints_px=moved)).posed()
        assert epipolar_distances(posed_a, other, pairs[[k]])[0, 1] == pytest.approx(4.0, rel=0.05)


# --- localization ---------------------------------------------------------------------------------


def localized(
    world: World, camera: Camera, thought: Camera, references: Camera, seed: int, method: str = "query-centred"
) -> tuple[Outcome, float]:
    """The outcome of an image of `camera`, which is thought to be another, and its NEES."""
    rng = np.random.default_rng([seed, 31])
    exact = scaled_noise(NOISE, poses=1e-3)
    seen = [photograph(world, pose, rng, clutter=80, camera=references) for pose in world.references]
    given = [disturbed(pose, exact, rng) for pose in world.references]
    query = photograph(world, world.queries[0], rng, clutter=80, blunders=0.05, camera=camera)
    image = new_image("q", camera=thought)
    config = LocalizeConfig(method=method)  # pyright: ignore[reportArgumentType]
    reference = reference_map(seen, given, exact)
    outcome = localize_image(
        image, query.features, reference, MutualNearest(), CandidatesConfig(ranking="votes"), config, 2048
    )
    if isinstance(outcome, Rejected):
        return outcome, np.nan
    return outcome, pose_nees(query.truth, outcome.world_from_cam, outcome.world_from_cam_cov)


_KNOWN = [(hall, FISHEYE, FISHEYE), (hall, FISHEYE_120, CAMERA), (court, STRONG_BROWN, FISHEYE_120)]


@pytest.mark.parametrize("method", ["query-centred", "published"])
@pytest.mark.parametrize(("make", "camera", "references"), _KNOWN)
def test_an_image_of_a_wide_camera_is_localized(make, camera: Camera, references: Camera, method: str) -> None:
    outcome, value = localized(make(2, points=500), camera, camera, references, 2, method)
    assert isinstance(outcome, Localized), outcome
    assert outcome.correspondence_count > 40
    assert outcome.camera is None
    if method == "query-centred":  # COLMAP's pose is robust, not of least variance
        assert 0.3 < value < chi2.ppf(0.9999, 6)
    assert 1e-4 < np.linalg.norm(outcome.world_from_cam.translation - make(2, points=500).queries[0].translation) < 0.05


@pytest.mark.parametrize("method", ["query-centred", "published"])
def test_an_image_of_unknown_focal_length_is_localized_with_its_camera(method: str, tmp_path: Path) -> None:
    thought = replace(LONG, fx=3600.0, fy=3600.0, estimate=("focal",))
    outcome, value = localized(court(5, points=500), LONG, thought, CAMERA, 5, method)
    assert isinstance(outcome, Localized), outcome
    assert value < chi2.ppf(0.9999, 6)
    focal, sigma = outcome.intrinsic_sigmas["focal"]
    assert 0.5 < sigma < 20.0
    assert abs(focal - 2600.0) < 4.5 * sigma
    write_outcome(tmp_path / "q.npz", outcome)
    stored = read_outcome(tmp_path / "q.npz")
    assert isinstance(stored, Localized)
    assert stored.camera == outcome.camera
    np.testing.assert_array_equal(stored.intrinsics_cov, outcome.intrinsics_cov)
    campaign = with_estimated_cameras(Campaign("new", (new_image("q", camera=thought), new_image("p"))), [stored])
    assert [image.camera for image in campaign.images] == [outcome.camera, CAMERA]


def test_a_flat_wall_seen_square_on_does_not_fix_pose_and_focal_length() -> None:
    thought = replace(LONG, fx=3600.0, fy=3600.0, estimate=("focal",))
    outcome, _ = localized(flat_wall(1, points=500), LONG, thought, CAMERA, 1)
    if isinstance(outcome, Rejected):
        assert outcome.reason is RejectReason.DEGENERATE
    else:
        assert np.sqrt(np.linalg.eigvalsh(outcome.world_from_cam_cov[3:, 3:])[-1]) > 0.1
    known, _ = localized(flat_wall(1, points=500), LONG, LONG, CAMERA, 1)
    assert isinstance(known, Localized)
    assert np.sqrt(np.linalg.eigvalsh(known.world_from_cam_cov[3:, 3:])[-1]) < 0.02


# --- adjustment -----------------------------------------------------------------------------------


@pytest.mark.parametrize("camera", [FISHEYE, FISHEYE_120, STRONG_BROWN], ids=["190", "120", "brown with k3"])
def test_joint_covariance_of_adjusted_wide_cameras_holds(camera: Camera) -> None:
    make = hall if camera.model == "fisheye" else court
    values, errors, behind = [], [], 0
    for seed in range(16):
        made = block(seed, noise=scaled_noise(NOISE, poses=0.1), points=150, queries=3, camera=camera, make=make)
        found = adjusted(made.problem)
        error = made.errors(found.poses)
        values.append(nees(error, found.cov) / len(error))
        errors += [np.linalg.norm(error[6 * i + 3 : 6 * i + 6]) for i in range(3)]
        obs, views = found.block.observations, found.block.views(found.state)
        behind += int((views.to_cam(obs.view, found.state.points[obs.point])[:, 2] < 0).sum())
    dof = 16 * 18
    assert chi2.ppf(0.0005, dof) / dof - 0.03 < np.mean(values) < chi2.ppf(0.9995, dof) / dof + 0.15, np.mean(values)
    assert 0.5e-3 < np.median(errors) < 15e-3, np.median(errors)
    assert behind > 0 or camera is not FISHEYE


def test_an_image_whose_camera_was_estimated_keeps_its_localization_in_the_adjustment() -> None:
    made = block(3, unknown=[1])
    problem = made.problem
    assert set(problem.pose_priors) == {1}
    assert not (problem.observations.view == 1).any()
    found = adjusted(problem)
    prior = problem.pose_priors[1]
    np.testing.assert_allclose(found.poses[1].local(prior.world_from_cam), 0.0, atol=1e-6)
    np.testing.assert_allclose(found.joint([1]), prior.cov, rtol=1e-3, atol=1e-10)
    assert np.trace(found.joint([0])) < 0.05 * np.trace(prior.cov)


def test_an_epoch_of_unknown_cameras_alone_is_adjusted_by_its_pose_priors() -> None:
    found = adjusted(block(3, unknown=range(4)).problem)
    assert len(found.block.observations) == 0
    assert set(found.block.pose_priors.image.tolist()) == set(range(4))
