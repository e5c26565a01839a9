"""PnP with wide, distorted and unknown cameras: errors inside two-sided bounds, covariances against Monte Carlo."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from georef.estimation.first_pose import QueryImage, ransac_pose
from georef.estimation.local_model import query_centred_model
from georef.estimation.pnp import EstimatedPose, refine_pose
from georef.estimation.reference_errors import ReferenceErrors
from georef.evaluation.statistics import nees
from georef.geometry.camera import Camera
from georef.geometry.rigid import Array
from tests.worlds.points import (
    CAMERA,
    NOISE,
    World,
    common,
    court,
    disturbed,
    flat_wall,
    hall,
    photograph,
    pose_nees,
    scaled_noise,
)

_SEEDS = 60
_GATE_PX = 12.0
_EXACT = scaled_noise(NOISE, poses=1e-3)
FISHEYE_120 = Camera("f120", 3000, 2400, 1830.0, 1826.0, 1510.0, 1190.0, (-0.02, 3e-3), "fisheye")
FISHEYE_190 = Camera("f190", 2600, 2600, 790.0, 791.0, 1305.0, 1296.0, (-0.015, 1e-3, -1e-4), "fisheye")
STRONG_BROWN = Camera("strong", 3000, 2000, 1500.0, 1502.0, 1490.0, 1010.0, (-0.25, 0.08, 5e-4, -4e-4, -0.01))
LONG = Camera("long", 3000, 2000, 2600.0, 2600.0, 1500.0, 1000.0)
BENT = Camera("bent", 3000, 2000, 2100.0, 2100.0, 1500.0, 1000.0, (-0.13, 0.03, 0.0, 0.0))


class Draw:
    """One draw: reference keypoints and poses with new errors, the query's keypoints, its local model."""

    def __init__(
        self, world: World, seed: int, query: Camera, references: Sequence[Camera], blunders: float = 0.0
    ) -> None:
        rng = np.random.default_rng([seed, 5])
        self.truth, self.camera = world.queries[0], query
        self.given = [disturbed(pose, _EXACT, rng) for pose in world.references]
        photos = [
            photograph(world, pose, rng, camera=references[i % len(references)])
            for i, pose in enumerate(world.references)
        ]
        self.seen = photograph(world, self.truth, rng, camera=query, blunders=blunders)
        posed = [photo.posed(pose) for photo, pose in zip(photos, self.given, strict=True)]
        self.model = query_centred_model(posed, [common(self.seen, p) for p in photos], NOISE.keypoint_sigma)

    def query(self, camera: Camera) -> QueryImage:
        """The query as it is handed to the estimation, with what is thought of its camera."""
        features = self.seen.features
        sigma = NOISE.keypoint_sigma * features.scales_px.astype(float)
        return QueryImage(camera, features.keypoints_px.astype(float), sigma)

    def estimate(self, camera: Camera) -> EstimatedPose | None:
        found = ransac_pose(self.query(camera), self.model, _GATE_PX, seed=0)
        if found is None:
            return None
        query = self.query(found.camera)
        errors = ReferenceErrors.independent([_EXACT.pose_cov(pose) for pose in self.given])
        return refine_pose(found.world_from_cam, query, self.model, errors)


def interval(dof: float, tail: float = 0.005) -> tuple[float, float]:
    """Two-sided interval of a chi-square over its degrees of freedom."""
    return float(chi2.ppf(tail, dof)) / dof, float(chi2.ppf(1.0 - tail, dof)) / dof


_KNOWN = {
    "fisheye 120": (hall, FISHEYE_120, [FISHEYE_120], (0.5e-3, 12e-3)),
    "fisheye 190": (hall, FISHEYE_190, [FISHEYE_190], (0.5e-3, 15e-3)),
    "fisheye 190 in pinholes and brown": (hall, FISHEYE_190, [CAMERA, LONG], (0.5e-3, 15e-3)),
    "strong brown": (court, STRONG_BROWN, [STRONG_BROWN], (0.5e-3, 15e-3)),
    "strong brown in fisheyes": (court, STRONG_BROWN, [FISHEYE_190, FISHEYE_120], (0.5e-3, 25e-3)),
}


@pytest.mark.parametrize("case", _KNOWN)
def test_covariance_of_known_cameras_holds(case: str) -> None:
    make, camera, references, (least_m, most_m) = _KNOWN[case]
    values, errors, beyond, used, found = [], [], 0, 0, 0
    for seed in range(_SEEDS):
        draw = Draw(make(seed, points=500), seed, camera, references)
        estimate = draw.estimate(camera)
        assert estimate is not None
        used, found = used + int(estimate.inliers.sum()), found + len(estimate.inliers)
        values.append(pose_nees(draw.truth, estimate.world_from_cam, estimate.cov) / 6.0)
        errors.append(np.linalg.norm(draw.truth.local(estimate.world_from_cam)[3:]))
        beyond += int((draw.truth.inverse().apply(draw.model.points)[:, 2] < 0).sum())
    assert used > 0.97 * found
    low, high = interval(6.0 * _SEEDS)
    assert low - 0.03 < np.mean(values) < high + 0.05, np.mean(values)
    assert least_m < np.median(errors) < most_m, np.median(errors)
    if camera is FISHEYE_190 and references == [FISHEYE_190]:
        assert beyond > _SEEDS  # rays beyond 90 degrees take part


def test_blunders_of_a_fisheye_are_gated() -> None:
    draw = Draw(hall(3, points=600), 3, FISHEYE_190, [FISHEYE_190], blunders=0.35)
    estimate = draw.estimate(FISHEYE_190)
    assert estimate is not None
    bad = draw.seen.blunder[draw.model.keypoint]
    assert bad.sum() > 30
    assert (estimate.inliers & bad).sum() <= 0.03 * bad.sum()
    assert (estimate.inliers & ~bad).sum() > 0.97 * (~bad).sum()
    assert pose_nees(draw.truth, estimate.world_from_cam, estimate.cov) < chi2.ppf(0.9999, 6)


def wrong(camera: Camera, *names: str) -> Camera:
    """What is known before the estimation: a focal length of 1.2 longer sides, no distortion."""
    focal = 1.25 * camera.fx if camera.model == "fisheye" else 1.2 * max(camera.width, camera.height)
    focal = focal if "focal" in names else camera.fx
    distortion = () if "k1" in names and camera.model != "fisheye" else camera.distortion
    if "k2" not in names and "k1" in names:
        distortion = (0.0, *camera.distortion[1:])
    if "cx" in names:
        camera = replace(camera, cx=camera.cx + 14.0, cy=camera.cy - 17.0)
    return replace(camera, fx=focal, fy=focal * camera.fy / camera.fx, distortion=distortion, estimate=names)


def intrinsic_errors(estimate: EstimatedPose, camera: Camera) -> Array:
    names = estimate.camera.estimate
    return np.array(
        [
            np.log(estimate.camera.fx / camera.fx)
            if n == "focal"
            else (estimate.camera.value(n) - camera.value(n)) / estimate.camera.unit(n)
            for n in names
        ]
    )


_UNKNOWN: dict[str, tuple[Callable[..., World], Camera, tuple[str, ...], tuple[float, float]]] = {
    "focal": (court, LONG, ("focal",), (1e-4, 5e-3)),
    "focal, k1": (court, BENT, ("focal", "k1"), (1e-4, 5e-3)),
    "focal, k1, k2": (court, BENT, ("focal", "k1", "k2"), (1e-4, 5e-3)),
    "focal, principal point": (court, LONG, ("focal", "cx", "cy"), (1e-4, 5e-3)),
    "k1 alone": (court, BENT, ("k1",), (1e-5, 1e-2)),
    "focal of a fisheye": (hall, FISHEYE_190, ("focal",), (1e-5, 2e-3)),
}


@pytest.mark.parametrize("case", _UNKNOWN)
def test_covariance_of_pose_and_camera_holds_where_the_camera_is_not_known(case: str) -> None:
    make, camera, names, (least, most) = _UNKNOWN[case]
    poses, cameras, errors, wider = [], [], [], []
    for seed in range(_SEEDS):
        draw = Draw(make(seed, points=300), seed, camera, [CAMERA])
        estimate = draw.estimate(wrong(camera, *names))
        assert estimate is not None
        assert estimate.camera.estimate == names
        error = intrinsic_errors(estimate, camera)
        poses.append(pose_nees(draw.truth, estimate.world_from_cam, estimate.cov) / 6.0)
        cameras.append(nees(error, estimate.intrinsics_cov) / len(names))
        errors.append(abs(error[0]))
        if seed < 5:
            known = draw.estimate(camera)
            assert known is not None
            wider.append(np.trace(estimate.cov[3:, 3:]) / np.trace(known.cov[3:, 3:]))
    low, high = interval(6.0 * _SEEDS)
    assert low - 0.03 < np.mean(poses) < high + 0.05, np.mean(poses)
    low, high = interval(len(names) * _SEEDS)
    assert low < np.mean(cameras) < high, np.mean(cameras)
    assert least < np.median(errors) < most, np.median(errors)
    assert 1.0 < np.median(wider) < 200.0, np.median(wider)


def test_a_flat_wall_seen_square_on_leaves_focal_length_and_distance_open_and_says_so() -> None:
    flat = Draw(flat_wall(1), 1, LONG, [CAMERA])
    relief = Draw(court(1), 1, LONG, [CAMERA])
    estimates = [draw.estimate(wrong(LONG, "focal")) for draw in (flat, relief)]
    known = flat.estimate(LONG)
    assert known is not None
    sigma = [
        np.inf if e is None else float(np.sqrt(np.linalg.eigvalsh(e.cov[3:, 3:])[-1])) for e in (*estimates, known)
    ]
    assert sigma[0] > 10.0 * sigma[1]
    assert sigma[0] > 10.0 * sigma[2]


def test_a_known_camera_has_no_covariance_and_is_kept() -> None:
    draw = Draw(court(2), 2, LONG, [CAMERA])
    estimate = draw.estimate(LONG)
    assert estimate is not None
    assert estimate.camera == LONG
    assert estimate.intrinsics_cov.shape == (0, 0)
