"""Cameras: projection, its inverse and its derivatives, for every model and to beyond 90 degrees."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from georef.geometry.camera import (
    ESTIMABLE,
    PLAIN,
    Camera,
    CameraModel,
    ideal_from_observed,
    intrinsic_derivatives,
    project,
    ray_derivatives,
    rays_from_pixels,
)
from georef.geometry.rigid import Array

_LENSES = [
    (),
    (-0.1, 0.02, 5e-4, -3e-4),
    (-0.3, 0.1, 1e-3, 1e-3),
    (-0.35, 0.12, 0.0, 0.0),
    (0.35, 0.0, 0.0, 0.0),
    (0.5, 0.2, -1e-3, 2e-3),
    (-0.28, 0.12, 4e-4, -2e-4, -0.02),
]
_RATIONALS = [
    (0.12, 0.02, 5e-4, -3e-4, 0.004, 0.05, 0.01, 0.002),
    (8.2, 3.9, 2e-4, -1e-4, 0.18, 8.5, 5.9, 1.02),
    (0.4, 0.1, 1e-3, 2e-3, 0.02, 0.9, 0.2, 0.0),
]
_FISHEYES = [(), (-0.01,), (0.03, -0.006, 0.001, -1e-4), (-0.02, 1e-3, -2e-4, 1e-5)]


def camera(distortion: tuple[float, ...] = (), model: CameraModel = "pinhole") -> Camera:
    if model == "rational":
        return Camera("r", 6000, 4000, 2100.0, 2090.0, 3010.0, 1995.0, distortion, "rational")
    if model == "fisheye":
        return Camera("f", 3000, 3000, 860.0, 858.0, 1510.0, 1495.0, distortion, "fisheye")
    return Camera("c", 6000, 4000, 3500.0, 3490.0, 3010.0, 1995.0, distortion)


_ALL = [
    *(camera(d) for d in _LENSES),
    *(camera(d, "fisheye") for d in _FISHEYES),
    *(camera(d, "rational") for d in _RATIONALS),
]
_CAMERAS = pytest.mark.parametrize("lens", _ALL, ids=[f"{c.model}{c.distortion}" for c in _ALL])


def grid(lens: Camera | None = None) -> Array:
    """Pixels all over the image; of a fisheye those up to 98 degrees from the axis."""
    lens = lens or camera()
    x, y = np.linspace(0.5, lens.width - 0.5, 25), np.linspace(0.5, lens.height - 0.5, 17)
    pixels = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    if lens.model == "fisheye":
        rays = rays_from_pixels(lens, pixels)
        pixels = pixels[rays[:, 2] > np.cos(np.radians(98.0))]
    return pixels


@_CAMERAS
def test_the_ray_is_the_inverse_of_projection_up_to_the_corners(lens: Camera) -> None:
    pixels = grid(lens)
    rays = rays_from_pixels(lens, pixels)
    assert len(pixels) > 250
    np.testing.assert_allclose(project(lens, 7.0 * rays), pixels, atol=1e-9)
    if lens.model == "fisheye":
        assert (rays[:, 2] < 0).sum() > 5
        np.testing.assert_allclose(np.linalg.norm(rays, axis=1), 1.0, atol=1e-12)
    else:
        np.testing.assert_array_equal(rays[:, 2], 1.0)


@_CAMERAS
def test_derivatives_are_those_of_differences(lens: Camera) -> None:
    rays = np.concatenate([rays_from_pixels(lens, grid(lens)), [[0.0, 0.0, 1.0], [1e-12, 0.0, 1.0]]])
    points = rays * np.random.default_rng(1).uniform(2.0, 40.0, (len(rays), 1))
    _, by_point, _ = lens.lens.derivatives(points, lens.coefficients, np.asarray(lens.limit))
    by_point = by_point * np.array([lens.fx, lens.fy])[:, None]
    step = 1e-5
    for axis in range(3):
        moved = np.eye(3)[axis] * step
        difference = (project(lens, points + moved) - project(lens, points - moved)) / (2 * step)
        np.testing.assert_allclose(by_point[:, :, axis], difference, rtol=1e-6, atol=1e-4)


@_CAMERAS
def test_derivatives_of_rays_are_those_of_differences(lens: Camera) -> None:
    pixels = grid(replace(lens, width=lens.width - 4, height=lens.height - 4)) + 2.0
    by_pixel = ray_derivatives(lens, rays_from_pixels(lens, pixels))
    step = 0.01
    for axis in range(2):
        moved = np.eye(2)[axis] * step
        difference = (rays_from_pixels(lens, pixels + moved) - rays_from_pixels(lens, pixels - moved)) / (2 * step)
        np.testing.assert_allclose(by_pixel[:, :, axis], difference, atol=1e-10)


@_CAMERAS
def test_derivatives_by_intrinsics_are_those_of_a_changed_camera(lens: Camera) -> None:
    names = tuple(n for n in ESTIMABLE if n in PLAIN or n in lens.lens.parameters)
    assert len(names) == 4 + {"pinhole": 0, "brown": 5, "fisheye": 4, "rational": 8}[lens.model]
    points = 3.0 * rays_from_pixels(lens, grid(lens))
    ours = intrinsic_derivatives(lens, points, names)
    assert ours.shape == (len(points), 2, len(names))
    step = 1e-6
    for column in range(len(names)):
        change = np.eye(len(names))[column] * step
        more, less = (project(lens.changed(names, sign * change), points) for sign in (1.0, -1.0))
        difference = (more - less) / (2 * step)
        seen = np.isfinite(difference).all(axis=1)
        assert seen.mean() > 0.95
        np.testing.assert_allclose(ours[seen, :, column], difference[seen], rtol=1e-6, atol=1e-4)


@given(st.floats(-0.3, 0.3), st.floats(0.0, 0.1), st.floats(-2e-3, 2e-3), st.floats(-2e-3, 2e-3))
def test_undistortion_round_trip_over_lenses(k1: float, k2: float, p1: float, p2: float) -> None:
    lens = camera((k1, k2, p1, p2))
    points = np.concatenate([grid()[::7] / 2000.0 - [1.5, 1.0], np.full((len(grid()[::7]), 1), 2.5)], axis=1)
    seen = np.isfinite(project(lens, points)).all(axis=1)
    points = points[seen]
    ideal = points[:, :2] / points[:, 2:] * [lens.fx, lens.fy] + [lens.cx, lens.cy]
    assert seen.mean() > 0.5
    np.testing.assert_allclose(ideal_from_observed(lens, project(lens, points)), ideal, atol=1e-8)


def test_beyond_the_fold_of_a_lens_there_is_no_pixel_and_no_ray() -> None:
    lens = camera((-0.9, 0.0, 0.0, 0.0))
    assert lens.limit == pytest.approx(np.sqrt(1.0 / 2.7))
    inside, outside = project(lens, [[0.999 * lens.limit, 0.0, 1.0], [1.001 * lens.limit, 0.0, 1.0]])
    assert np.isfinite(inside).all()
    assert np.isnan(outside).all()
    farthest = lens.cx + lens.fx * lens.limit * 2.0 / 3.0
    rays = rays_from_pixels(lens, [[farthest - 1.0, lens.cy], [farthest + 1.0, lens.cy]])
    np.testing.assert_array_equal(np.isnan(rays).any(axis=1), [False, True])
    assert np.isfinite(ideal_from_observed(lens, grid())).all()
    assert lens.half_view_angle_rad == pytest.approx(np.arctan(lens.limit))


def test_a_fisheye_ends_where_its_polynomial_stops_to_rise() -> None:
    lens = camera((-0.06, 0.0, 0.0, 0.0), "fisheye")
    assert lens.limit == pytest.approx(np.sqrt(1.0 / 0.18))
    beyond = [np.sin(lens.limit + 1e-3), 0.0, np.cos(lens.limit + 1e-3)]
    assert np.isnan(project(lens, [beyond])).all()
    circle = lens.fx * lens.limit * (1.0 - 0.06 * lens.limit**2)
    rays = rays_from_pixels(lens, [[lens.cx + circle - 1.0, lens.cy], [lens.cx + circle + 1.0, lens.cy]])
    np.testing.assert_array_equal(np.isnan(rays).any(axis=1), [False, True])
    assert camera((), "fisheye").limit > np.radians(179.0)


def test_pixels_outside_the_circle_of_a_fisheye_have_no_ray_and_the_others_do() -> None:
    lens = replace(camera((-0.06,), "fisheye"), width=4000, height=4000, cx=2000.0, cy=2000.0)
    rays = rays_from_pixels(lens, [[2.0, 2.0], [2000.0, 2000.0]])
    np.testing.assert_array_equal(np.isnan(rays).any(axis=1), [True, False])
    assert lens.half_view_angle_rad == lens.limit


def test_the_model_follows_from_the_distortion_or_is_named() -> None:
    np.testing.assert_array_equal(ideal_from_observed(camera(), grid()), grid())
    assert camera().model == "pinhole"
    assert camera((0.1, 0.0, 0.0, 0.0)).model == "brown"
    assert camera((), "fisheye").model == "fisheye"
    assert replace(camera(), estimate=("focal", "k1")).model == "brown"
    assert replace(camera(), estimate=("p1", "k3")).model == "brown"
    for bad in (
        {"distortion": (0.0,) * 6},
        {"distortion": (0.0,) * 5, "model": "fisheye"},
        {"distortion": (0.0,) * 9, "model": "rational"},
        {"estimate": ("skew",)},
        {"estimate": ("k4",)},
        {"estimate": ("p1",), "model": "fisheye"},
    ):
        with pytest.raises(ValueError, match="camera 'c'"):
            replace(camera(), **bad)


def test_a_changed_camera_has_its_focal_length_scaled_and_its_coefficients_shifted() -> None:
    changed = camera((-0.1, 0.02, 1e-3, 0.0)).changed(("focal", "k1"), [np.log(1.1), 0.05])
    assert (changed.fx, changed.fy) == pytest.approx((3850.0, 3839.0))
    assert changed.distortion == pytest.approx((-0.05, 0.02, 1e-3, 0.0))
    assert changed.value("focal") == changed.fx
    assert changed.value("k1") == changed.distortion[0]
    moved = camera().changed(("cx", "cy", "aspect"), [0.01, -0.01, np.log(1.02)])
    assert (moved.cx, moved.cy, moved.fx, moved.fy) == pytest.approx((3045.0, 1960.0, 3500.0, 3559.8))
    assert moved.unit("cx") == moved.value("focal")


def test_every_coefficient_can_be_changed_and_no_other_moves() -> None:
    for lens in _ALL:
        for index, name in enumerate(lens.lens.parameters):
            changed = lens.changed((name,), [0.25])
            difference = changed.coefficients - lens.coefficients
            np.testing.assert_allclose(difference, 0.25 * np.eye(8)[index], atol=1e-15)
            assert changed.value(name) == pytest.approx(lens.value(name) + 0.25)
            assert (changed.model, changed.fx, changed.cy) == (lens.model, lens.fx, lens.cy)


def test_a_rational_lens_with_a_plain_denominator_is_browns() -> None:
    k = (-0.28, 0.12, 4e-4, -2e-4, -0.02)
    brown, rational = camera(k), replace(camera(), distortion=k, model="rational")
    points = 3.0 * rays_from_pixels(brown, grid())
    np.testing.assert_allclose(project(rational, points), project(brown, points), atol=1e-10)
    assert rational.limit == pytest.approx(brown.limit)


def test_a_rational_lens_ends_where_it_folds_or_its_denominator_vanishes() -> None:
    folding = camera((0.0, 0.0, 0.0, 0.0, 0.0, 0.5), "rational")  # r / (1 + r^2 / 2) rises up to sqrt(2)
    assert folding.limit == pytest.approx(np.sqrt(2.0))
    pole = camera((0.0, 0.0, 0.0, 0.0, 0.0, -0.25), "rational")  # r / (1 - r^2 / 4)
    assert pole.limit == pytest.approx(2.0)
    for lens in (folding, pole):
        assert np.isnan(project(lens, [[lens.limit * 1.001, 0.0, 1.0]])).all()
        assert np.isfinite(project(lens, [[lens.limit * 0.999, 0.0, 1.0]])).all()
    farthest = folding.cx + folding.fx / np.sqrt(2.0)
    rays = rays_from_pixels(folding, [[farthest - 1.0, folding.cy], [farthest + 1.0, folding.cy]])
    np.testing.assert_array_equal(np.isnan(rays).any(axis=1), [False, True])
    far = rays_from_pixels(pole, [[pole.cx + 1e5, pole.cy]])  # all pixels have a ray
    np.testing.assert_allclose(project(pole, far), [[pole.cx + 1e5, pole.cy]], rtol=1e-9)
    assert camera((0.1, 0.0, 0.0, 0.0, 0.0, 0.1), "rational").limit == np.inf


def test_the_optical_axis_hits_the_principal_point_and_x_is_right() -> None:
    for lens in (camera((-0.1, 0.02, 0.0, 0.0)), camera((0.01,), "fisheye")):
        np.testing.assert_allclose(project(lens, [[0.0, 0.0, 3.0]]), [[lens.cx, lens.cy]])
        right, below = project(lens, [[0.1, 0.0, 1.0], [0.0, 0.1, 1.0]]) - [lens.cx, lens.cy]
        assert right[0] > 0 < below[1]
    np.testing.assert_allclose(camera().matrix @ [0.2, -0.1, 1.0], [*project(camera(), [[0.4, -0.2, 2.0]])[0], 1.0])


def test_points_that_are_not_in_front_have_no_pixel() -> None:
    points = [[0.0, 0.0, -1.0], [0.0, 0.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, -0.1]]
    np.testing.assert_array_equal(np.isnan(project(camera(), points)).all(axis=1), [True, True, False, True])
    fisheye = camera((), "fisheye")
    np.testing.assert_array_equal(np.isnan(project(fisheye, points)).all(axis=1), [True, True, False, False])


def test_half_view_angle_is_that_of_the_farthest_corner() -> None:
    lens = camera()
    corners = rays_from_pixels(lens, [[0, 0], [lens.width, 0], [0, lens.height], [lens.width, lens.height]])
    angles = np.arccos(corners[:, 2] / np.linalg.norm(corners, axis=1))
    assert lens.half_view_angle_rad == pytest.approx(float(angles.max()))
