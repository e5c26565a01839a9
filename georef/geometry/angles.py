"""Exterior orientation angles <-> rotation matrices.

The matrices here are `axes_from_cam`: camera (x right, y down, z forward) to the axes that the angles refer to
(east, north, up of the CRS, or x, y, z of an engineering or geocentric CRS).

- omega-phi-kappa: R = Rx(omega) Ry(phi) Rz(kappa) takes image axes (right, top, back) to the CRS axes.
- yaw-pitch-roll: yaw is the heading of the optical axis, clockwise from grid north; pitch its elevation above the
  horizon; roll turns the camera clockwise about the optical axis, seen from behind it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from georef.geometry.rigid import Array

IMAGE_FROM_CAM = np.diag([1.0, -1.0, -1.0])
"""Image axes (right, top, back) from camera axes (right, down, forward); its own inverse."""

_LEVEL_NORTH = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""enu_from_cam of a level camera that looks north."""

_GIMBAL_LOCK = 1e-10  # cosine of the middle angle below which the outer two are one

_LEAST_LEVEL = 0.1  # sine of the angle from the vertical below which an optical axis has no heading


def rotation_x(angle_rad: float) -> Array:
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])


def rotation_y(angle_rad: float) -> Array:
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


def rotation_z(angle_rad: float) -> Array:
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def rotation_from_omega_phi_kappa(angles_rad: Sequence[float] | Array) -> Array:
    """axes_from_cam (3, 3) of omega, phi, kappa in radians."""
    omega, phi, kappa = angles_rad
    return rotation_x(omega) @ rotation_y(phi) @ rotation_z(kappa) @ IMAGE_FROM_CAM


def omega_phi_kappa_from_rotation(axes_from_cam: Array) -> Array:
    """omega, phi, kappa (3,) in radians, phi in [-pi/2, pi/2]; at phi = +-90 deg kappa is set to 0."""
    r = axes_from_cam @ IMAGE_FROM_CAM
    cos_phi = float(np.hypot(r[0, 0], r[0, 1]))
    phi = float(np.arctan2(r[0, 2], cos_phi))
    if cos_phi < _GIMBAL_LOCK:
        return np.array([np.arctan2(r[1, 0] * np.sign(phi), r[1, 1]), phi, 0.0])
    omega = float(np.arctan2(-r[1, 2], r[2, 2]))
    # Near phi = +-90 deg omega is ill-determined: kappa follows from it, so that the three still give the rotation.
    kappa_only = (rotation_x(omega) @ rotation_y(phi)).T @ r
    return np.array([omega, phi, np.arctan2(kappa_only[1, 0], kappa_only[0, 0])])


def rotation_from_yaw_pitch_roll(angles_rad: Sequence[float] | Array) -> Array:
    """axes_from_cam (3, 3) of yaw, pitch, roll in radians."""
    yaw, pitch, roll = angles_rad
    return rotation_z(-yaw) @ _LEVEL_NORTH @ rotation_x(pitch) @ rotation_z(roll)


def yaw_pitch_roll_from_rotation(axes_from_cam: Array) -> Array:
    """yaw, pitch, roll (3,) in radians, pitch in [-pi/2, pi/2]; at pitch = +-90 deg roll is set to 0."""
    right, forward = axes_from_cam[:, 0], axes_from_cam[:, 2]
    cos_pitch = float(np.hypot(forward[0], forward[1]))
    pitch = float(np.arctan2(forward[2], cos_pitch))
    if cos_pitch < _GIMBAL_LOCK:
        return np.array([np.arctan2(-right[1], right[0]), pitch, 0.0])
    yaw = float(np.arctan2(forward[0], forward[1]))
    # Near pitch = +-90 deg yaw is ill-determined: roll follows from it, so that the three still give the rotation.
    roll_only = (rotation_z(-yaw) @ _LEVEL_NORTH @ rotation_x(pitch)).T @ axes_from_cam
    return np.array([yaw, pitch, np.arctan2(roll_only[1, 0], roll_only[0, 0])])


def heading_of(axes_from_cam: Array) -> float:
    """Heading of the optical axis, clockwise from grid north, in [-pi, pi] rad; NaN within 6 degrees of the vertical.

    There it says nothing of where the camera looks: a small tilt turns it round.
    """
    east, north = axes_from_cam[0, 2], axes_from_cam[1, 2]
    if np.hypot(east, north) < _LEAST_LEVEL:
        return float("nan")
    return float(np.arctan2(east, north))


def omega_phi_kappa_jacobian(axes_from_cam: Array) -> Array:
    """d(omega, phi, kappa) / d(rotation vector in the camera frame, right perturbation), (3, 3), rad per rad.

    With R = Rx Ry Rz F, a right perturbation w in the camera is u = F w in image axes, and
    u = Rz^T Ry^T e_x domega + Rz^T e_y dphi + e_z dkappa. Singular at phi = +-90 deg.
    """
    _, phi, kappa = omega_phi_kappa_from_rotation(axes_from_cam)
    rates = np.column_stack(
        [
            rotation_z(kappa).T @ rotation_y(phi).T @ [1.0, 0.0, 0.0],
            rotation_z(kappa).T @ [0.0, 1.0, 0.0],
            [0.0, 0.0, 1.0],
        ]
    )
    return np.linalg.inv(rates) @ IMAGE_FROM_CAM
