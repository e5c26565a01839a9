"""Triangulation: exact without noise, covariances against Monte Carlo, and what has no solution."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from georef.geometry.camera import Camera
from georef.geometry.projection import Views
from georef.geometry.rigid import Array, Rigid3
from georef.geometry.triangulation import segment_sum, triangulate

_CAMERA = Camera("c", 4000, 3000, 2500.0, 2500.0, 2000.0, 1500.0)


def street_views(count: int = 4) -> Views:
    """Cameras along x, 1.5 m apart, that look along y (level), turned slightly towards each other."""
    poses = []
    for i in range(count):
        level = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
        turn = Rigid3.exp([0.02 * i, 0.05 * (i - count / 2), 0.01, 0.0, 0.0, 0.0]).rotation
        poses.append(Rigid3(level @ turn, np.array([1.5 * i, 0.1 * i, 2.0])))
    return Views.of(poses, [_CAMERA] * count)


def points(count: int) -> Array:
    return np.random.default_rng(1).uniform([-1.0, 10.0, 0.5], [6.0, 25.0, 5.0], (count, 3))


def pairs(point_count: int, view_count: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    point = np.repeat(np.arange(point_count), view_count)
    return point, np.tile(np.arange(view_count), point_count)


def test_exact_pixels_give_the_points_back() -> None:
    views, truth = street_views(), points(50)
    point, view = pairs(50, 4)
    found = triangulate(views, point, view, views.project(view, truth[point]), np.ones(200), 50)
    np.testing.assert_allclose(found.points, truth, atol=1e-9)
    np.testing.assert_allclose(found.residual_px, 0.0, atol=1e-9)


@pytest.mark.parametrize("sigmas_px", [(0.5, 0.5, 0.5, 0.5), (0.2, 1.0, 0.4, 0.8)])
def test_covariances_hold_in_monte_carlo(sigmas_px: tuple[float, ...]) -> None:
    views, count = street_views(), 3000
    truth = np.tile(points(30), (100, 1))
    point, view = pairs(count, 4)
    sigma = np.tile(sigmas_px, count)
    noise = np.random.default_rng(2).normal(size=(len(point), 2)) * sigma[:, None]
    found = triangulate(views, point, view, views.project(view, truth[point]) + noise, sigma, count)
    error = found.points - truth
    ratio = np.einsum("pi,pij,pj->p", error, np.linalg.inv(found.cov), error).mean() / 3.0
    # 95 % of the mean of 9,000 squares is 1 +- 0.03; with Huber weights at 2 sigma its expectation is 0.995 (measured).
    assert 0.96 < ratio < 1.03
    empirical = np.cov(error.T)
    np.testing.assert_allclose(np.diag(found.cov.mean(axis=0)), np.diag(empirical), rtol=0.12)


def test_a_wrong_observation_among_many_hardly_moves_the_point() -> None:
    views, truth = street_views(8), points(20)
    point, view = pairs(20, 8)
    pixel = views.project(view, truth[point])
    pixel[::8] += 60.0
    found = triangulate(views, point, view, pixel, np.full(len(point), 0.5), 20)
    plain_like = np.linalg.norm(found.points - truth, axis=1)
    assert plain_like.max() < 0.15


def test_points_without_a_solution_are_nan_and_leave_the_others_alone() -> None:
    views, truth = street_views(3), points(3)
    point, view = np.array([0, 0, 0, 1, 2, 2]), np.array([0, 1, 2, 0, 1, 1])  # 1: one ray; 2: the same view twice
    pixel = views.project(view, truth[point])
    found = triangulate(views, point, view, pixel, np.ones(6), 4)  # 3: never observed
    np.testing.assert_allclose(found.points[0], truth[0], atol=1e-9)
    np.testing.assert_array_equal(np.isnan(found.points).all(axis=1), [False, True, True, True])


def test_rays_that_meet_behind_the_cameras_are_no_point() -> None:
    views = street_views(2)
    behind = np.array([[0.7, -15.0, 2.0]])
    in_cam = views.to_cam(np.array([0, 1]), np.repeat(behind, 2, axis=0))
    pixel = in_cam[:, :2] / in_cam[:, 2:] * 2500.0 + [2000.0, 1500.0]  # the rays, prolonged backwards
    found = triangulate(views, np.array([0, 0]), np.array([0, 1]), pixel, np.ones(2), 1)
    assert np.isnan(found.points).all()


def test_segment_sum_adds_rows_of_equal_index() -> None:
    values = np.arange(24.0).reshape(4, 2, 3)
    total = segment_sum(values, np.array([2, 0, 2, 0]), 4)
    np.testing.assert_array_equal(total[0], values[1] + values[3])
    np.testing.assert_array_equal(total[2], values[0] + values[2])
    np.testing.assert_array_equal(total[[1, 3]], np.zeros((2, 2, 3)))
    assert segment_sum(np.zeros((0, 3)), np.zeros(0, np.int64), 2).shape == (2, 3)
