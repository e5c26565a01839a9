"""Tables of rigs: where each camera of a vehicle or a frame sits, and how well that is calibrated."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from georef.geometry.panorama import head_pose
from georef.geometry.rigid import Array
from georef.io.table import Table
from georef.io.tables import TableFormat, read_table
from georef.types.campaign import Mounting

_ANGLES, _POSITION, _SIGMAS = ("yaw", "pitch", "roll"), ("x", "y", "z"), ("sigma_m", "sigma_deg")


def read_rig(
    path: Path | str, *, columns: Mapping[str, str] | None = None, table_format: TableFormat | None = None
) -> dict[str, Mounting]:
    """Read camera, x, y, z (m), yaw, pitch, roll (deg), sigma_m, sigma_deg: mountings by the ids of their cameras.

    As for the heads of a panorama: x right, y down, z forward of the rig; yaw clockwise from forward, pitch up, roll
    clockwise about the optical axis. The sigmas are of each coordinate and of the rotation about each axis. One camera
    may have both zero: then the rig is where this camera is. Raises InputError.
    """
    table = read_table(path, columns=columns, table_format=table_format)
    table.require(("camera", *_POSITION, *_ANGLES, *_SIGMAS))
    cameras = table.unique_ids("camera")
    angles = np.radians(table.stack(_ANGLES))
    sigmas = _checked_sigmas(table, cameras)
    positions = table.stack(_POSITION)
    return {
        name: Mounting(name, head_pose(angles[i], positions[i]), _cov(*sigmas[i])) for i, name in enumerate(cameras)
    }


def _checked_sigmas(table: Table, cameras: tuple[str, ...]) -> Array:
    sigmas = table.stack(_SIGMAS)
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
    return sigmas


def _cov(sigma_m: float, sigma_deg: float) -> Array | None:
    """Covariance (6, 6) of a mounting; None where it defines the rig."""
    if sigma_m == 0:
        return None
    return np.diag([np.radians(sigma_deg) ** 2] * 3 + [sigma_m**2] * 3)
