"""One point through georef, pycolmap, OpenCV and gtsam: the same pixel, the same tangents, the same covariance."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import gtsam
import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from georef.estimation.colmap import colmap_camera
from georef.evaluation.statistics import summarize_nees
from georef.geometry.angles import rotation_from_omega_phi_kappa, rotation_from_yaw_pitch_roll
from georef.geometry.camera import Camera, intrinsic_derivatives, project, rays_from_pixels
from georef.geometry.covariance import world_from_cam_cov_from_colmap
from georef.geometry.projection import Views, linearize
from georef.geometry.rigid import Array, Rigid3, exp_so3, log_so3, right_jacobian_so3

_PINHOLE = Camera("pinhole", 4000, 3000, 2510.0, 2495.0, 2003.5, 1496.5)
_BROWN = Camera("brown", 4000, 3000, 2510.0, 2495.0, 2003.5, 1496.5, (-0.12, 0.03, 4e-4, -7e-4))
_FISHEYE = Camera("fisheye", 4000, 3000, 1310.0, 1305.0, 2003.5, 1496.5, (-0.02, 4e-3, -1e-3, 1e-4), "fisheye")
_K3 = Camera("k3", 4000, 3000, 2510.0, 2495.0, 2003.5, 1496.5, (-0.22, 0.06, 4e-4, -7e-4, 0.01))
_RATIONAL = Camera(
    "rational",
    4000,
    3000,
    2510.0,
    2495.0,
    2003.5,
    1496.5,
    (0.31, -0.12, 4e-4, -7e-4, 0.02, 0.42, -0.08, 0.01),
    "rational",
)
_CAMERAS = pytest.mark.parametrize("camera", [_PINHOLE, _BROWN, _FISHEYE], ids=["pinhole", "brown", "fisheye"])
_ALL_LENSES = pytest.mark.parametrize(
    "camera", [_PINHOLE, _BROWN, _FISHEYE, _K3, _RATIONAL], ids=["pinhole", "brown", "fisheye", "k3", "rational"]
)
_WORLD_FROM_CAM = Rigid3.exp([0.4, -1.1, 0.7, 120.0, -50.0, 30.0])
_XI = np.array([0.3, -0.8, 0.5, 2.0, -1.0, 0.7])


def points_in_world() -> Array:
    rng = np.random.default_rng(0)
    slopes = rng.uniform([-0.7, -0.5], [0.7, 0.5], (40, 2))
    return _WORLD_FROM_CAM.apply(np.column_stack([slopes, np.ones(40)]) * rng.uniform(2.0, 60.0, (40, 1)))


def gtsam_camera(camera: Camera, world_from_cam: Rigid3) -> Any:
    pose, pinhole = gtsam.Pose3(world_from_cam.matrix()), (camera.fx, camera.fy, 0.0, camera.cx, camera.cy)
    if camera.model == "pinhole":
        return gtsam.PinholeCameraCal3_S2(pose, gtsam.Cal3_S2(*pinhole))
    if camera.model == "brown":
        return gtsam.PinholeCameraCal3DS2(pose, gtsam.Cal3DS2(*pinhole, *camera.distortion))
    return gtsam.PinholeCameraCal3Fisheye(pose, gtsam.Cal3Fisheye(*pinhole, *camera.distortion))


# --- one point, four libraries --------------------------------------------------------------------


@_ALL_LENSES
def test_the_same_pixel_as_colmap(camera: Camera) -> None:
    cam_from_world = _WORLD_FROM_CAM.inverse()
    pose = pycolmap.Rigid3d(pycolmap.Rotation3d(cam_from_world.rotation), cam_from_world.translation)
    in_cam = np.array([pose * point for point in points_in_world()])
    pixels = colmap_camera(camera).img_from_cam(in_cam)
    assert pixels is not None
    np.testing.assert_allclose(project(camera, cam_from_world.apply(points_in_world())), pixels, atol=1e-9)
    rays = rays_from_pixels(camera, pixels)
    slopes = rays[:, :2] / rays[:, 2:]
    np.testing.assert_allclose(slopes, in_cam[:, :2] / in_cam[:, 2:], atol=1e-12)
    theirs = colmap_camera(camera).cam_from_img(pixels)
    assert theirs is not None
    np.testing.assert_allclose(slopes, theirs, atol=4e-10)  # COLMAP stops at 1e-10 of a slope


@_ALL_LENSES
def test_the_same_pixel_as_opencv(camera: Camera) -> None:
    cam_from_world, points = _WORLD_FROM_CAM.inverse(), points_in_world()
    rvec, _ = cv2.Rodrigues(cam_from_world.rotation)
    coefficients, shift = np.array(camera.distortion or (0.0,) * 4), cam_from_world.translation
    if camera.model == "fisheye":
        pixels, _ = cv2.fisheye.projectPoints(points[:, None], rvec, shift, camera.matrix, coefficients)
    else:
        pixels, _ = cv2.projectPoints(points, rvec, shift, camera.matrix, coefficients)
    ours = project(camera, cam_from_world.apply(points))
    np.testing.assert_allclose(ours, np.asarray(pixels).reshape(-1, 2), atol=1e-9)
    np.testing.assert_allclose(rvec.ravel(), log_so3(cam_from_world.rotation), atol=1e-12)


@_CAMERAS
def test_the_same_pixel_as_gtsam(camera: Camera) -> None:
    theirs = gtsam_camera(camera, _WORLD_FROM_CAM)
    pixels = [theirs.project(point) for point in points_in_world()]
    ours = project(camera, _WORLD_FROM_CAM.inverse().apply(points_in_world()))
    np.testing.assert_allclose(ours, pixels, atol=1e-9)


@_CAMERAS
def test_the_same_derivatives_as_gtsam(camera: Camera) -> None:
    views, points = Views.of([_WORLD_FROM_CAM], [camera]), points_in_world()[:5]
    lin = linearize(views, np.zeros(5, np.int64), points)
    theirs = gtsam_camera(camera, _WORLD_FROM_CAM)
    for k, point in enumerate(points):
        by_pose, by_point = np.zeros((2, 6), order="F"), np.zeros((2, 3), order="F")
        by_calibration = np.zeros((2, 5 if camera.model == "pinhole" else 9), order="F")
        theirs.project(point, by_pose, by_point, by_calibration)
        np.testing.assert_allclose(lin.by_pose[k], by_pose, rtol=1e-9, atol=1e-8)
        np.testing.assert_allclose(lin.by_point[k], by_point, rtol=1e-9, atol=1e-8)
        if camera.model != "pinhole":
            in_cam = _WORLD_FROM_CAM.inverse().apply(point[None])
            ours = intrinsic_derivatives(camera, in_cam, ("k1", "k2"))[0]
            np.testing.assert_allclose(ours, by_calibration[:, 5:7], rtol=1e-9, atol=1e-8)


# --- rotations and transforms ---------------------------------------------------------------------


def test_exp_log_and_jacobian_of_rotations_as_in_gtsam_and_scipy() -> None:
    w = _XI[:3]
    np.testing.assert_allclose(exp_so3(w), gtsam.Rot3.Expmap(w).matrix(), atol=1e-14)
    np.testing.assert_allclose(exp_so3(w), Rotation.from_rotvec(w).as_matrix(), atol=1e-14)
    np.testing.assert_allclose(log_so3(exp_so3(w)), gtsam.Rot3.Logmap(gtsam.Rot3.Expmap(w)), atol=1e-14)
    for change in 1e-6 * np.eye(3):
        moved = gtsam.Rot3.Logmap(gtsam.Rot3.Expmap(w).between(gtsam.Rot3.Expmap(w + change)))
        np.testing.assert_allclose(moved, right_jacobian_so3(w) @ change, atol=1e-11)


def test_transforms_have_the_tangent_of_gtsam() -> None:
    ours, theirs = Rigid3.exp(_XI), gtsam.Pose3.Expmap(_XI)
    other = Rigid3.exp([-0.2, 0.9, 1.3, -4.0, 0.3, 8.0])
    pose, target = gtsam.Pose3(_WORLD_FROM_CAM.matrix()), gtsam.Pose3(other.matrix())
    np.testing.assert_allclose(ours.matrix(), theirs.matrix(), atol=1e-14)
    np.testing.assert_allclose(ours.log(), gtsam.Pose3.Logmap(theirs), atol=1e-13)
    np.testing.assert_allclose(_WORLD_FROM_CAM.adjoint(), pose.AdjointMap(), atol=1e-12)
    np.testing.assert_allclose(_WORLD_FROM_CAM.local(other), pose.localCoordinates(target), atol=1e-11)
    np.testing.assert_allclose(_WORLD_FROM_CAM.retract(_XI).matrix(), pose.retract(_XI).matrix(), atol=1e-12)
    np.testing.assert_allclose((_WORLD_FROM_CAM @ other).matrix(), pose.compose(target).matrix(), atol=1e-12)


def test_a_fixed_omega_phi_kappa_against_its_written_out_matrix() -> None:
    omega, phi, kappa = np.deg2rad([81.2, -14.5, 203.75])
    (so, sp, sk), (co, cp, ck) = np.sin([omega, phi, kappa]), np.cos([omega, phi, kappa])
    # Kraus, "Photogrammetry" (2007): rotation of image axes (right, top, back) into object axes.
    crs_from_image = np.array(
        [
            [cp * ck, -cp * sk, sp],
            [co * sk + so * sp * ck, co * ck - so * sp * sk, -so * cp],
            [so * sk - co * sp * ck, so * ck + co * sp * sk, co * cp],
        ]
    )
    expected = crs_from_image * [1.0, -1.0, -1.0]  # camera y is down, z forward
    np.testing.assert_allclose(rotation_from_omega_phi_kappa((omega, phi, kappa)), expected, atol=1e-15)
    by_scipy = Rotation.from_euler("XYZ", [omega, phi, kappa]).as_matrix() @ np.diag([1.0, -1.0, -1.0])
    np.testing.assert_allclose(rotation_from_omega_phi_kappa((omega, phi, kappa)), by_scipy, atol=1e-15)


def test_a_fixed_yaw_pitch_roll_against_vectors_turned_one_by_one() -> None:
    yaw, pitch, roll = np.deg2rad([127.0, 22.0, -9.0])
    forward = np.array([np.sin(yaw) * np.cos(pitch), np.cos(yaw) * np.cos(pitch), np.sin(pitch)])
    level_right = np.array([np.cos(yaw), -np.sin(yaw), 0.0])
    right, down = (
        Rotation.from_rotvec(roll * forward).as_matrix() @ v for v in (level_right, -np.cross(level_right, forward))
    )
    enu_from_cam = rotation_from_yaw_pitch_roll((yaw, pitch, roll))
    np.testing.assert_allclose(enu_from_cam, np.column_stack([right, down, forward]), atol=1e-15)


# --- COLMAP's pose covariance ---------------------------------------------------------------------


@dataclass(frozen=True)
class _Run:
    xi: Array  # (6,) estimate @ Exp(xi) = truth
    converted: Array  # (6, 6)
    raw: Array  # (6, 6) as COLMAP returns it, in its order


def refined(rng: np.random.Generator, camera: Camera, points: Array, sigma_px: float) -> _Run:
    """One pose refined by COLMAP from noisy pixels of 40 points, and its covariance at that noise."""
    exact = _WORLD_FROM_CAM.inverse()
    observed = project(camera, exact.apply(points)) + sigma_px * rng.normal(size=(len(points), 2))
    start = pycolmap.Rigid3d(pycolmap.Rotation3d(exact.rotation), exact.translation)
    options = pycolmap.AbsolutePoseRefinementOptions()
    options.gradient_tolerance, options.loss_function_scale, options.max_num_iterations = 1e-10, 1e6, 200
    mask, lens = np.ones(len(points), dtype=bool), colmap_camera(camera)
    found = pycolmap.refine_absolute_pose(start, observed, points, mask, lens, options, return_covariance=True)
    assert found is not None
    cam_from_world = Rigid3.from_matrix(found["cam_from_world"].matrix())
    raw = sigma_px**2 * np.asarray(found["covariance"])
    xi = cam_from_world.inverse().local(_WORLD_FROM_CAM)
    return _Run(xi, world_from_cam_cov_from_colmap(cam_from_world, raw), raw)


def test_colmap_covariance_is_true_once_converted_and_wrong_before() -> None:
    rng, points, sigma_px = np.random.default_rng(6), points_in_world(), 0.8
    runs = [refined(rng, _BROWN, points, sigma_px) for _ in range(400)]

    def ratio(covs: list[Array]) -> float:
        values = [float(run.xi @ np.linalg.solve(cov, run.xi)) for run, cov in zip(runs, covs, strict=True)]
        return summarize_nees(values, 6).mean_ratio or np.nan

    assert summarize_nees([float(r.xi @ np.linalg.solve(r.converted, r.xi)) for r in runs], 6).consistent
    for part in (slice(0, 3), slice(3, 6)):
        values = [float(r.xi[part] @ np.linalg.solve(r.converted[part, part], r.xi[part])) for r in runs]
        assert summarize_nees(values, 3).consistent
    assert ratio([run.raw for run in runs]) > 10.0
    halved = np.kron(np.diag([0.5, 1.0]), np.eye(3))  # half angles taken for angles
    assert ratio([halved @ run.converted @ halved for run in runs]) > 1.5


def test_the_converted_covariance_is_the_inverse_of_our_own_normal_matrix() -> None:
    points, sigma_px = points_in_world(), 1e-4  # so small that COLMAP linearises at the truth
    run = refined(np.random.default_rng(7), _PINHOLE, points, sigma_px)
    views = Views.of([_WORLD_FROM_CAM], [_PINHOLE])
    rows = linearize(views, np.zeros(len(points), np.int64), points).by_pose.reshape(-1, 6) / sigma_px
    scale = np.sqrt(np.diag(run.converted))
    difference = (run.converted - np.linalg.inv(rows.T @ rows)) / np.outer(scale, scale)
    np.testing.assert_allclose(difference, 0.0, atol=1e-4)
