"""Exterior orientation angles: round trips, worked directions, gimbal lock, derivatives."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from georef.geometry.angles import (
    heading_of,
    omega_phi_kappa_from_rotation,
    omega_phi_kappa_jacobian,
    rotation_from_omega_phi_kappa,
    rotation_from_yaw_pitch_roll,
    yaw_pitch_roll_from_rotation,
)
from georef.geometry.rigid import Array, exp_so3, nearest_rotation

_TURN = st.floats(-3.14, 3.14)
_MIDDLE = st.floats(-1.57, 1.57)
_BELOW_RIGHT_ANGLE = [0.0, 1e-14, 1e-12, 1e-10, 2e-10, 1e-9, 1e-8, 1e-6, 1e-4]
_BOTH = [
    (rotation_from_omega_phi_kappa, omega_phi_kappa_from_rotation),
    (rotation_from_yaw_pitch_roll, yaw_pitch_roll_from_rotation),
]
_Forward = Callable[[Array], Array]


@given(_TURN, _MIDDLE, _TURN)
def test_omega_phi_kappa_round_trip(omega: float, phi: float, kappa: float) -> None:
    rotation = rotation_from_omega_phi_kappa((omega, phi, kappa))
    assert np.linalg.det(rotation) == pytest.approx(1.0)
    np.testing.assert_allclose(
        rotation_from_omega_phi_kappa(omega_phi_kappa_from_rotation(rotation)), rotation, atol=1e-13
    )


@given(_TURN, _MIDDLE, _TURN)
def test_yaw_pitch_roll_round_trip(yaw: float, pitch: float, roll: float) -> None:
    rotation = rotation_from_yaw_pitch_roll((yaw, pitch, roll))
    np.testing.assert_allclose(
        rotation_from_yaw_pitch_roll(yaw_pitch_roll_from_rotation(rotation)), rotation, atol=1e-13
    )


@pytest.mark.parametrize(("forward", "backward"), _BOTH)
def test_angles_come_back_away_from_gimbal_lock(forward: _Forward, backward: _Forward) -> None:
    angles = np.array([0.7, -0.4, 2.9])
    np.testing.assert_allclose(backward(forward(angles)), angles, atol=1e-14)


@pytest.mark.parametrize("below", _BELOW_RIGHT_ANGLE)
@pytest.mark.parametrize(("forward", "backward"), _BOTH)
def test_the_rotation_comes_back_in_and_near_gimbal_lock(forward: _Forward, backward: _Forward, below: float) -> None:
    rng = np.random.default_rng(0)
    for sign in (1.0, -1.0):
        for first, last in rng.uniform(-np.pi, np.pi, (30, 2)):
            exact = forward(np.array([first, sign * (np.pi / 2 - below), last]))
            rotation = nearest_rotation(exact + 1e-16 * rng.normal(size=(3, 3)))  # as after products of rotations
            found = backward(rotation)
            assert np.isfinite(found).all()
            np.testing.assert_allclose(forward(found), rotation, atol=3e-10)
            if below < 1e-11:
                assert found[2] == 0.0


def test_a_vertical_image_looks_down_with_its_top_to_the_north() -> None:
    enu_from_cam = rotation_from_omega_phi_kappa((0.0, 0.0, 0.0))
    np.testing.assert_allclose(enu_from_cam @ [0, 0, 1], [0, 0, -1], atol=1e-15)
    np.testing.assert_allclose(enu_from_cam @ [0, -1, 0], [0, 1, 0], atol=1e-15)


def test_omega_of_90_deg_looks_north_and_level() -> None:
    enu_from_cam = rotation_from_omega_phi_kappa((np.pi / 2, 0.0, 0.0))
    np.testing.assert_allclose(enu_from_cam, rotation_from_yaw_pitch_roll((0.0, 0.0, 0.0)), atol=1e-15)
    np.testing.assert_allclose(enu_from_cam @ [0, 0, 1], [0, 1, 0], atol=1e-15)
    np.testing.assert_allclose(enu_from_cam @ [0, 1, 0], [0, 0, -1], atol=1e-15)


def test_yaw_is_a_heading_pitch_an_elevation_and_roll_clockwise_from_behind() -> None:
    forward, right, up = np.array([0, 0, 1.0]), np.array([1.0, 0, 0]), np.array([0, -1.0, 0])
    east = rotation_from_yaw_pitch_roll((np.pi / 2, 0.0, 0.0))
    np.testing.assert_allclose(east @ forward, [1, 0, 0], atol=1e-15)
    raised = rotation_from_yaw_pitch_roll((0.0, np.deg2rad(30.0), 0.0))
    np.testing.assert_allclose(raised @ forward, [0, np.sqrt(0.75), 0.5], atol=1e-15)
    rolled = rotation_from_yaw_pitch_roll((0.0, 0.0, np.deg2rad(10.0)))
    assert (rolled @ right)[2] < 0 < (rolled @ up)[0]


@given(_TURN, st.floats(-1.4, 1.4), _TURN)
def test_omega_phi_kappa_jacobian_by_finite_differences(omega: float, phi: float, kappa: float) -> None:
    rotation, step = rotation_from_omega_phi_kappa((omega, phi, kappa)), 1e-6
    numeric = np.empty((3, 3))
    for k, unit in enumerate(np.eye(3)):
        plus = omega_phi_kappa_from_rotation(rotation @ exp_so3(step * unit))
        minus = omega_phi_kappa_from_rotation(rotation @ exp_so3(-step * unit))
        numeric[:, k] = ((plus - minus + np.pi) % (2.0 * np.pi) - np.pi) / (2.0 * step)
    np.testing.assert_allclose(omega_phi_kappa_jacobian(rotation), numeric, atol=2e-7)


@pytest.mark.parametrize("heading_deg", [0.0, 37.0, 90.0, -135.0, 179.0])
@pytest.mark.parametrize("pitch_deg", [0.0, -60.0, 83.0, -83.0])
@pytest.mark.parametrize("roll_deg", [0.0, 25.0])
def test_a_heading_is_the_yaw(heading_deg: float, pitch_deg: float, roll_deg: float) -> None:
    rotation = rotation_from_yaw_pitch_roll(np.radians([heading_deg, pitch_deg, roll_deg]))
    assert np.degrees(heading_of(rotation)) == pytest.approx(heading_deg)


@pytest.mark.parametrize("pitch_deg", [85.0, -85.0, 90.0, -90.0])
def test_what_looks_up_or_down_has_no_heading(pitch_deg: float) -> None:
    assert np.isnan(heading_of(rotation_from_yaw_pitch_roll(np.radians([37.0, pitch_deg, 0.0]))))
