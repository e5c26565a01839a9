"""Tables of mountings of blocks: as tables of rigs, or with angles between image axes, as of photogrammetrists."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from georef.geometry.angles import IMAGE_FROM_CAM, rotation_from_omega_phi_kappa
from georef.geometry.panorama import head_pose
from georef.geometry.rigid import Array, Rigid3
from georef.io.table import Table
from georef.io.tables import read_table

_IMAGE_ANGLES, _ANGLES = ("omega", "phi", "kappa"), ("yaw", "pitch", "roll")
_POSITION, _SIGMAS = ("x", "y", "z"), ("sigma_m", "sigma_deg")


@dataclass(frozen=True, eq=False)
class StatedMounting:
    """sigma_m, sigma_deg: of each coordinate and of the rotation about each axis; both 0: the camera defines the rig;
    both NaN: nothing is known of how good the values are."""

    rig_from_cam: Rigid3
    sigma_m: float
    sigma_deg: float

    @property
    def information(self) -> Array | None:
        """(6, 6) of rig_from_cam as a right perturbation; None where it is held, zeros where nothing is known."""
        if self.sigma_m == 0:
            return None
        if np.isnan(self.sigma_m):
            return np.zeros((6, 6))
        return np.diag([np.radians(self.sigma_deg) ** -2] * 3 + [self.sigma_m**-2] * 3)


def read_mountings(path: Path | str) -> dict[str, StatedMounting]:
    """Read camera, x, y, z (m), angles (deg), sigma_m, sigma_deg: mountings by the ids of their cameras.

    x, y, z are right, down, forward of the rig. yaw, pitch, roll are as in tables of rigs: clockwise from forward, up,
    clockwise about the optical axis. omega, phi, kappa: R = Rx(omega) Ry(phi) Rz(kappa) turns the image axes (x right,
    y up, z towards the viewer) of the camera to those of the rig. Raises InputError.
    """
    table = read_table(path)
    by_images = table.has(*_IMAGE_ANGLES)
    table.require(("camera", *_POSITION, *(_IMAGE_ANGLES if by_images else _ANGLES), *_SIGMAS))
    cameras, positions, sigmas = table.unique_ids("camera"), table.stack(_POSITION), _sigmas(table)
    angles = np.radians(table.stack(_IMAGE_ANGLES if by_images else _ANGLES))
    pose = _pose_by_images if by_images else head_pose
    return {name: StatedMounting(pose(angles[i], positions[i]), *sigmas[i].tolist()) for i, name in enumerate(cameras)}


def _pose_by_images(omega_phi_kappa_rad: Array, position_in_rig_m: Array) -> Rigid3:
    """rig_from_cam of angles between image axes."""
    return Rigid3(IMAGE_FROM_CAM @ rotation_from_omega_phi_kappa(omega_phi_kappa_rad), position_in_rig_m)


def _sigmas(table: Table) -> Array:
    """(N, 2), both positive, both 0 or both NaN."""
    sigmas = table.stack(_SIGMAS, allow_empty=True)
    one_empty = np.isnan(sigmas).sum(axis=1) == 1
    for i in np.flatnonzero(one_empty | (sigmas < 0).any(axis=1) | ((sigmas == 0).sum(axis=1) == 1))[:1]:
        raise table.error(
            int(i),
            f"Camera {table.text('camera')[i]!r} has sigma_m, sigma_deg = {sigmas[i, 0]}, {sigmas[i, 1]}.",
            expected="both positive, both 0 for the camera that defines the rig, or both empty for a mounting that is "
            "estimated without a weight.",
            remedy="Correct the values.",
        )
    exact = np.flatnonzero((sigmas == 0).all(axis=1))
    if len(exact) > 1:
        names = table.text("camera")
        raise table.error(
            int(exact[1]),
            f"Cameras {names[exact[0]]!r} and {names[exact[1]]!r} both have sigmas of 0: their relative orientation "
            "would be exact.",
            expected="sigmas of 0 for one camera at most, the one that defines the rig.",
            remedy="Give the others the standard deviations of their calibration.",
        )
    return sigmas
