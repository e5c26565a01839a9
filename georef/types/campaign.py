"""What a survey brings along: images with their cameras, positions and poses."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from georef.geometry.camera import Camera
from georef.geometry.rigid import Array, Rigid3


@dataclass(frozen=True, eq=False)
class PositionPrior:
    """A measured position of a camera centre (GNSS) with its covariance."""

    position_in_world: Array  # (3,) m
    cov: Array  # (3, 3) m^2

    def __post_init__(self) -> None:
        require_covariance(self.cov, 3)


@dataclass(frozen=True, eq=False)
class PosePrior:
    """A measured or computed pose with its covariance, right perturbation of world_from_cam."""

    world_from_cam: Rigid3
    cov: Array  # (6, 6)

    def __post_init__(self) -> None:
        require_covariance(self.cov, 6)


@dataclass(frozen=True)
class PoseSigma:
    """Given 1-sigma of a reference pose: of its position east, north, up, and of its rotation about the camera axes."""

    position_m: tuple[float, float, float]
    rotation_rad: tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class Image:
    """One photograph: where its file lies, its camera, and what is known of its pose."""

    image_id: str
    path: Path
    camera: Camera
    epoch: str
    world_from_cam: Rigid3 | None = None  # reference images: the given exterior orientation
    gnss: PositionPrior | None = None
    near: Array | None = (
        None  # (3,) m, a position that nobody states a sigma for: a place to search about, no observation
    )
    station: str | None = None  # of images that were taken as one, heads of a panorama or of a rig: they share a fix
    heading_rad: float | None = None  # of the optical axis, clockwise from the world's north
    given_sigma: PoseSigma | None = None  # of world_from_cam, where the project declares it


@dataclass(frozen=True, eq=False)
class Mounting:
    """Where a camera sits on its rig; one calibration for all exposures."""

    camera: str  # the id of a camera, or of a head
    rig_from_cam: Rigid3
    cov: Array | None = None  # (6, 6) right perturbation of rig_from_cam; None: exact
    free: bool = False  # nobody states a sigma: estimated without a weight, cov being wide

    def __post_init__(self) -> None:
        if self.cov is not None:
            require_covariance(self.cov, 6)


@dataclass(frozen=True, eq=False)
class Campaign:
    """The images of one epoch, in the order of the table that lists them.

    mountings: by image id, of images that belong to a station whose rig is known. fixes: positions as they were
    measured, where those of the images allow for the way from antenna to camera or an offset; times_s: of exposure.
    """

    epoch: str
    images: tuple[Image, ...]
    mountings: Mapping[str, Mounting] = field(default_factory=dict)
    fixes: Mapping[str, PositionPrior] = field(default_factory=dict)
    times_s: Mapping[str, float] = field(default_factory=dict)

    def __getitem__(self, image_id: str) -> Image:
        return self._by_id[image_id]

    @property
    def _by_id(self) -> dict[str, Image]:
        # A frozen dataclass keeps no cache; campaigns are looked up by id in loops, so one is stored aside.
        index = self.__dict__.get("_index")
        if index is None:
            index = {image.image_id: image for image in self.images}
            object.__setattr__(self, "_index", index)
        return index


def require_covariance(cov: Array, size: int) -> None:
    if cov.shape != (size, size) or not np.all(np.isfinite(cov)) or np.linalg.eigvalsh(cov)[0] <= 0:
        raise ValueError(f"a covariance must be a positive definite ({size}, {size}) matrix")
