"""Tables of rigs: where each camera of a vehicle or a frame sits, and how well that is calibrated."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from georef.geometry.angles import rotation_from_omega_phi_kappa
from georef.geometry.panorama import head_pose
from georef.geometry.rigid import Array, Rigid3
from georef.io.table import Table
from georef.io.tables import TableFormat, read_table
from georef.types.campaign import Mounting

_ANGLES, _POSITION, _SIGMAS = ("yaw", "pitch", "roll"), ("x", "y", "z"), ("sigma_m", "sigma_deg")
_IMAGE_ANGLES = ("omega", "phi", "kappa")
FREE = (0.5, 5.0)
"""Sigmas (m, deg) that localization allows a mounting that nobody states a sigma for."""


def read_rig(
    path: Path | str,
    *,
    columns: Mapping[str, str] | None = None,
    table_format: TableFormat | None = None,
) -> dict[str, Mounting]:
    """Read camera, x, y, z (m), yaw, pitch, roll (deg), sigma_m, sigma_deg: mountings by the ids of their cameras.

    As for the heads of a panorama: x right, y down, z forward of the rig; yaw clockwise from forward, pitch up, roll
    clockwise about the optical axis. Or omega, phi, kappa (deg): R = Rx(omega) Ry(phi) Rz(kappa) turns the image axes
    (x right, y up, z towards the viewer) of the camera to those of the rig; x, y, z stay as they are. The sigmas are of
    each coordinate and of the rotation about each axis. One camera may have both zero: then the rig is where it is.
    Both empty: nobody knows how good the values are; an adjustment estimates them without a weight. Raises InputError.
    """
    table = read_table(path, columns=columns, table_format=table_format)
    by_images = table.has(*_IMAGE_ANGLES)
    table.require(("camera", *_POSITION, *(_IMAGE_ANGLES if by_images else _ANGLES), *_SIGMAS))
    cameras = table.unique_ids("camera")
    angles = np.radians(table.stack(_IMAGE_ANGLES if by_images else _ANGLES))
    sigmas, free = _checked_sigmas(table, cameras)
    positions = table.stack(_POSITION)
    pose = _pose_by_images if by_images else head_pose
    return {
        name: Mounting(name, pose(angles[i], positions[i]), _cov(*sigmas[i]), free=bool(free[i]))
        for i, name in enumerate(cameras)
    }


def _pose_by_images(omega_phi_kappa_rad: Array, position_in_rig_m: Array) -> Rigid3:
    """rig_from_cam of angles between image axes."""
    turned = rotation_from_omega_phi_kappa(omega_phi_kappa_rad)  # from x right, y down, z forward of the camera
    return Rigid3(np.diag([1.0, -1.0, -1.0]) @ turned, position_in_rig_m)


def _checked_sigmas(table: Table, cameras: tuple[str, ...]) -> tuple[Array, NDArray[np.bool_]]:
    """Sigmas (N, 2), and which mountings (N,) have none stated."""
    sigmas = table.stack(_SIGMAS, allow_empty=True)
    free = np.isnan(sigmas)
    for i in np.flatnonzero(free.any(axis=1) & ~free.all(axis=1))[:1]:
        raise table.error(
            int(i),
            f"Camera {cameras[i]!r} has one of sigma_m, sigma_deg.",
            expected="both, or none where its mounting is to be estimated freely.",
            remedy="Fill in the other.",
        )
    sigmas = np.where(free, FREE, sigmas)
    for i, k in np.argwhere((sigmas < 0) | ((sigmas == 0) & (sigmas.max(axis=1, keepdims=True) > 0)))[:1]:
        raise table.error(
            int(i),
            f"Camera {cameras[i]!r} has {_SIGMAS[k]} = {sigmas[i, k]}.",
            expected="positive standard deviations (a calibrated rig: 0.001 m, 0.01 deg), or both 0 for the one camera "
            "that defines the rig.",
            remedy="Correct the value.",
        )
    exact = np.flatnonzero(sigmas.max(axis=1) == 0)
    if len(exact) > 1:
        raise table.error(
            int(exact[1]),
            f"Cameras {cameras[exact[0]]!r} and {cameras[exact[1]]!r} both have sigmas of 0: their relative "
            "orientation would be exact.",
            expected="sigmas of 0 for one camera at most, the one that defines the rig.",
            remedy="Give the others the standard deviations of their calibration.",
        )
    return sigmas, np.asarray(free.all(axis=1))


def _cov(sigma_m: float, sigma_deg: float) -> Array | None:
    """Covariance (6, 6) of a mounting; None where it defines the rig."""
    if sigma_m == 0:
        return None
    return np.diag([np.radians(sigma_deg) ** 2] * 3 + [sigma_m**2] * 3)
