"""Projection into many views: against the camera model one by one, and its derivatives by finite differences."""

from __future__ import annotations

import numpy as np

from georef.geometry.camera import Camera, project, rays_from_pixels
from georef.geometry.projection import Views, linearize
from georef.geometry.rigid import Array, Rigid3

_CAMERAS = (
    Camera("wide", 4000, 3000, 2000.0, 2010.0, 1990.0, 1505.0),
    Camera("long", 2000, 3000, 5000.0, 5000.0, 1000.5, 1499.5, (-0.2, 0.05, 1e-3, -5e-4)),
    Camera("fish", 3000, 3000, 800.0, 801.0, 1500.5, 1490.0, (-0.02, 1e-3), "fisheye"),
)
_VIEW = np.array([0, 1, 2, 0, 1, 2, 2, 1])


def scene() -> tuple[list[Rigid3], list[Camera], Array]:
    rng = np.random.default_rng(5)
    poses = [Rigid3.exp(np.concatenate([rng.normal(size=3), rng.normal(size=3) * 20.0])) for _ in range(3)]
    in_cam = np.column_stack([rng.uniform(-0.5, 0.5, (len(_VIEW), 2)), np.ones(len(_VIEW))])
    in_cam *= rng.uniform(2.0, 30.0, (len(_VIEW), 1))
    points = np.array([poses[v].apply(p) for v, p in zip(_VIEW, in_cam, strict=True)])
    return poses, list(_CAMERAS), points


def test_projection_agrees_with_the_camera_one_by_one() -> None:
    poses, cameras, points = scene()
    views = Views.of(poses, cameras)
    single = [project(cameras[v], poses[v].inverse().apply(p)[None])[0] for v, p in zip(_VIEW, points, strict=True)]
    np.testing.assert_allclose(views.project(_VIEW, points), single, atol=1e-9)
    np.testing.assert_allclose(linearize(views, _VIEW, points).pixel, single, atol=1e-9)
    np.testing.assert_allclose(views.centres, [pose.translation for pose in poses], atol=1e-12)
    assert len(views) == 3


def test_rays_point_from_the_centre_to_the_point() -> None:
    poses, cameras, points = scene()
    views = Views.of(poses, cameras)
    rays = views.rays(_VIEW, views.project(_VIEW, points))
    expected = points - views.centres[_VIEW]
    np.testing.assert_allclose(rays, expected / np.linalg.norm(expected, axis=1, keepdims=True), atol=1e-12)
    for i in range(3):
        in_cam = rays_from_pixels(cameras[i], views.project(_VIEW, points)[[i]])
        in_cam /= np.linalg.norm(in_cam)
        np.testing.assert_allclose(rays[[i]], in_cam @ poses[i].rotation.T, atol=1e-12)


def test_derivative_by_point_by_finite_differences() -> None:
    poses, cameras, points = scene()
    views, step = Views.of(poses, cameras), 1e-5
    numeric = np.empty((len(_VIEW), 2, 3))
    for k, unit in enumerate(np.eye(3)):
        numeric[:, :, k] = views.project(_VIEW, points + step * unit) - views.project(_VIEW, points - step * unit)
    by_point = linearize(views, _VIEW, points).by_point
    np.testing.assert_allclose(by_point, numeric / (2.0 * step), rtol=1e-6, atol=1e-4)


def test_derivative_by_pose_by_finite_differences_of_the_right_perturbation() -> None:
    poses, cameras, points = scene()
    step = 1e-6
    numeric = np.empty((len(_VIEW), 2, 6))
    for k, unit in enumerate(np.eye(6)):
        plus = Views.of([pose.retract(step * unit) for pose in poses], cameras)
        minus = Views.of([pose.retract(-step * unit) for pose in poses], cameras)
        numeric[:, :, k] = plus.project(_VIEW, points) - minus.project(_VIEW, points)
    by_pose = linearize(Views.of(poses, cameras), _VIEW, points).by_pose
    np.testing.assert_allclose(by_pose, numeric / (2.0 * step), rtol=1e-6, atol=1e-3)


def test_points_behind_a_view_are_nan() -> None:
    poses, cameras, _ = scene()
    views = Views.of(poses, cameras)
    behind = poses[0].apply(np.array([[0.5, 0.0, -0.2]]))
    assert np.isnan(views.project(np.array([0]), behind)).all()
    assert np.isnan(linearize(views, np.array([0]), behind).pixel).all()


def test_no_views_and_no_points() -> None:
    assert len(Views.of([], [])) == 0
    poses, cameras, _ = scene()
    empty = linearize(Views.of(poses, cameras), np.zeros(0, np.int64), np.zeros((0, 3)))
    assert empty.pixel.shape == (0, 2)
    assert empty.by_pose.shape == (0, 2, 6)


def test_a_fisheye_sees_what_is_not_in_front() -> None:
    poses, cameras, _ = scene()
    views, sideways = Views.of(poses, cameras), poses[2].apply(np.array([[0.5, 0.0, -0.05]]))
    assert np.isfinite(linearize(views, np.array([2]), sideways).pixel).all()
