"""Cameras: projection, undistortion round trips, rays."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from georef.geometry.camera import Camera, ideal_from_observed, project, rays_from_ideal
from georef.geometry.rigid import Array

_LENSES = [
    (),
    (-0.1, 0.02, 5e-4, -3e-4),
    (-0.3, 0.1, 1e-3, 1e-3),
    (-0.35, 0.12, 0.0, 0.0),
    (0.35, 0.0, 0.0, 0.0),
    (0.5, 0.2, -1e-3, 2e-3),
]


def camera(distortion: tuple[float, ...] = ()) -> Camera:
    return Camera("c", 6000, 4000, 3500.0, 3490.0, 3010.0, 1995.0, distortion)


def grid() -> Array:
    return np.stack(np.meshgrid(np.linspace(0.5, 5999.5, 25), np.linspace(0.5, 3999.5, 17)), axis=-1).reshape(-1, 2)


@pytest.mark.parametrize("distortion", _LENSES)
def test_undistortion_is_the_inverse_of_projection_up_to_the_corners(distortion: tuple[float, ...]) -> None:
    lens = camera(distortion)
    rays = rays_from_ideal(lens, ideal_from_observed(lens, grid()))
    np.testing.assert_allclose(project(lens, 7.0 * rays), grid(), atol=1e-9)


@given(st.floats(-0.3, 0.3), st.floats(0.0, 0.1), st.floats(-2e-3, 2e-3), st.floats(-2e-3, 2e-3))
def test_undistortion_round_trip_over_lenses(k1: float, k2: float, p1: float, p2: float) -> None:
    lens = camera((k1, k2, p1, p2))
    points = np.concatenate([grid()[::7] / 2000.0 - [1.5, 1.0], np.full((len(grid()[::7]), 1), 2.5)], axis=1)
    ideal = points[:, :2] / points[:, 2:] * [lens.fx, lens.fy] + [lens.cx, lens.cy]
    np.testing.assert_allclose(ideal_from_observed(lens, project(lens, points)), ideal, atol=1e-8)


def test_beyond_the_fold_of_a_lens_the_ideal_pixel_is_finite() -> None:
    assert np.isfinite(ideal_from_observed(camera((-0.9, 0.0, 0.0, 0.0)), grid())).all()


def test_pinhole_pixels_are_ideal_already() -> None:
    np.testing.assert_array_equal(ideal_from_observed(camera(), grid()), grid())
    assert camera().model == "pinhole"
    assert camera((0.1, 0.0, 0.0, 0.0)).model == "brown"


def test_the_optical_axis_hits_the_principal_point_and_x_is_right() -> None:
    lens = camera((-0.1, 0.02, 0.0, 0.0))
    np.testing.assert_allclose(project(lens, [[0.0, 0.0, 3.0]]), [[lens.cx, lens.cy]])
    right, below = project(lens, [[0.1, 0.0, 1.0], [0.0, 0.1, 1.0]]) - [lens.cx, lens.cy]
    assert right[0] > 0 < below[1]
    np.testing.assert_allclose(camera().matrix @ [0.2, -0.1, 1.0], [*project(camera(), [[0.4, -0.2, 2.0]])[0], 1.0])


def test_points_that_are_not_in_front_have_no_pixel() -> None:
    pixels = project(camera(), [[0.0, 0.0, -1.0], [0.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    np.testing.assert_array_equal(np.isnan(pixels).all(axis=1), [True, True, False])


def test_half_view_angle_is_that_of_the_farthest_corner() -> None:
    lens = camera()
    corners = rays_from_ideal(lens, [[0, 0], [lens.width, 0], [0, lens.height], [lens.width, lens.height]])
    assert lens.half_view_angle_rad == pytest.approx(float(np.arccos(corners[:, 2]).max()))
