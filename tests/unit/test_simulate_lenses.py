"""Lenses of the simulated cameras: their own inverse, and the same pixels as OpenCV, half a pixel apart."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from georef.geometry.camera import Camera
from georef.simulate.lenses import Fisheye, Lens, ray_grid

PINHOLE = Lens("pinhole", 640, 480, Camera("p", 640, 480, 500.0, 502.0, 318.4, 242.1))
BROWN = Lens("brown", 640, 480, Camera("b", 640, 480, 500.0, 502.0, 318.4, 242.1, (-0.21, 0.05, 1e-3, -7e-4)))
FISHEYE = Lens("fisheye", 800, 600, None, Fisheye(380.0, 401.3, 297.2, (0.02, -0.004, 0.001, -2e-4), np.radians(85)))
LENSES = [PINHOLE, BROWN, FISHEYE, Lens("equidistant", 800, 600, None, Fisheye(380.0, 401.3, 297.2))]


def points_in_view(lens: Lens, count: int = 400) -> np.ndarray:
    rng = np.random.default_rng(4)
    pixels = rng.uniform(0, 1, (count, 2)) * [lens.width, lens.height]
    return lens.rays(pixels) * rng.uniform(1, 60, (count, 1))


@pytest.mark.parametrize("lens", LENSES, ids=lambda lens: lens.name)
def test_projecting_a_pixels_ray_gives_the_pixel(lens: Lens) -> None:
    rng = np.random.default_rng(3)
    pixels = rng.uniform(0, 1, (500, 2)) * [lens.width, lens.height]
    rays = lens.rays(pixels)
    np.testing.assert_allclose(np.linalg.norm(rays, axis=1), 1.0, atol=1e-12)
    np.testing.assert_allclose(lens.project(3.7 * rays), pixels, atol=1e-9)


@pytest.mark.parametrize("lens", [PINHOLE, BROWN], ids=lambda lens: lens.name)
def test_frame_cameras_agree_with_opencv(lens: Lens) -> None:
    """OpenCV counts from the centre of the top-left pixel, which is (0.5, 0.5) here."""
    assert lens.camera is not None
    points, matrix = points_in_view(lens), lens.camera.matrix.copy()
    matrix[:2, 2] -= 0.5
    distortion = np.array(lens.camera.distortion or (0.0,) * 4)
    theirs, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, distortion)
    np.testing.assert_allclose(lens.project(points), theirs[:, 0] + 0.5, atol=1e-9)


def test_the_fisheye_agrees_with_opencv() -> None:
    fisheye = FISHEYE.fisheye
    assert fisheye is not None
    points, focal = points_in_view(FISHEYE), fisheye.focal_px
    matrix = np.array([[focal, 0, fisheye.cx - 0.5], [0, focal, fisheye.cy - 0.5], [0, 0, 1]])
    theirs, _ = cv2.fisheye.projectPoints(
        points[:, None], np.zeros(3), np.zeros(3), matrix, np.array(fisheye.coefficients)
    )
    np.testing.assert_allclose(FISHEYE.project(points), theirs[:, 0] + 0.5, atol=1e-9)


@pytest.mark.parametrize("lens", LENSES, ids=lambda lens: lens.name)
def test_what_is_not_in_the_picture_has_no_pixel(lens: Lens) -> None:
    behind, aside = [0.1, 0.2, -5.0], [50.0, 0.0, 1.0]
    assert np.isnan(lens.project([behind, aside])).all()


def test_distortion_does_not_fold_far_points_back_into_the_picture() -> None:
    """r (1 + k1 r^2) has its largest value at the picture's rim and comes back to zero further out."""
    slopes = np.linspace(1.5, 2.5, 50)
    points = np.column_stack([slopes, np.zeros(50), np.ones(50)])
    assert np.isnan(BROWN.project(points)).all()


def test_the_grid_of_rays_stands_on_pixel_centres() -> None:
    grid = ray_grid(FISHEYE)
    assert grid.shape == (600, 800, 3)
    np.testing.assert_allclose(grid[10, 20], FISHEYE.rays([[20.5, 10.5]])[0], atol=1e-6)
