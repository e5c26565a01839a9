"""Poses as they are published: position in the CRS, attitude, status and covariance of each image."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from georef.geometry.angles import omega_phi_kappa_from_rotation, omega_phi_kappa_jacobian
from georef.geometry.rigid import Array
from georef.io.columns import CrsKind
from georef.io.declarations import Declared
from georef.types.campaign import require_covariance

SINGULAR_WITHIN_DEG = 5.0
"""So near to phi = +-90 deg omega and kappa are not separable, and their sigmas say nothing."""


@dataclass(frozen=True)
class PosesFrame:
    """What the comments of a file of poses declare. horizontal: "EPSG:25832" or "local"; height: "ellipsoidal" or a
    vertical CRS, None where z is no height; origin: the world's origin in words with numbers, CRS and units."""

    crs_kind: CrsKind
    horizontal: str
    height: str | None
    origin: str


@dataclass(frozen=True, eq=False)
class PoseRecord:
    """The outcome of one image; an image that is "rejected: ..." has neither pose nor covariance.

    position_in_crs: in the order of POSITION_COLUMNS; axes_from_cam: camera (x right, y down, z forward) to (E, N,
    up) or (x, y, z) of the CRS; cov: (rotation rad, translation m), right perturbation of world_from_cam. Sigmas that
    are None are derived from cov where the record is written. Raises ValueError for parts that contradict each other.
    """

    image_id: str
    status: str = "localized"
    position_in_crs: Array | None = None  # (3,)
    axes_from_cam: Array | None = None  # (3, 3)
    cov: Array | None = None  # (6, 6)
    position_sigmas_m: Array | None = None  # (3,) along the axes of the CRS
    angle_sigmas_deg: Array | None = None  # (3,) omega, phi, kappa
    intrinsics: Mapping[str, tuple[float, float]] = field(default_factory=dict)  # estimated with the pose: value, sigma

    def __post_init__(self) -> None:
        rejected = is_rejected(self.status)
        if (self.position_in_crs is None) != rejected or (self.axes_from_cam is None) != rejected:
            raise ValueError(f"{self.image_id}: status {self.status!r} does not go with its pose")
        if self.cov is not None:
            require_covariance(self.cov, 6)

    @property
    def has_pose(self) -> bool:
        return self.position_in_crs is not None

    @property
    def angles_singular(self) -> bool:
        """Whether phi is so near to +-90 deg that omega and kappa have no sigmas of their own."""
        return self.axes_from_cam is not None and _is_singular(self.axes_from_cam)


@dataclass(frozen=True, eq=False)
class PoseTable:
    """A file of poses: its records in the order of the rows, and what its comments declare."""

    path: Path
    declared: Declared
    crs_kind: CrsKind
    records: tuple[PoseRecord, ...]

    @property
    def declared_crs(self) -> str | None:
        return self.declared.crs


def sigmas_from_cov(axes_from_cam: Array, cov: Array) -> tuple[Array, Array | None]:
    """1-sigma of the position (3,) m along the axes of the CRS, and of omega, phi, kappa (3,) deg.

    cov (6, 6): (rad, m), right perturbation of world_from_cam. The angles have None where they are singular.
    """
    position_cov = axes_from_cam @ cov[3:, 3:] @ axes_from_cam.T
    if _is_singular(axes_from_cam):
        return np.sqrt(np.diag(position_cov)), None
    jacobian = omega_phi_kappa_jacobian(axes_from_cam)
    return np.sqrt(np.diag(position_cov)), np.rad2deg(np.sqrt(np.diag(jacobian @ cov[:3, :3] @ jacobian.T)))


def is_rejected(status: str) -> bool:
    """Whether a status is that of an image without a pose: "rejected" or "rejected: reason"."""
    return status.lower().startswith("rejected")


def _is_singular(axes_from_cam: Array) -> bool:
    phi = omega_phi_kappa_from_rotation(axes_from_cam)[1]
    return bool(abs(phi) >= np.deg2rad(90.0 - SINGULAR_WITHIN_DEG))
