"""Sections of project.toml that declare an epoch: images, cameras, positions, and all that is measured beside them."""

from __future__ import annotations

from typing import Any, Literal, get_args

from pydantic import Field, field_validator, model_validator

from georef.config import Section
from georef.sections import AngleConvention, AngleUnit, Metres3, TableSection

Free = Literal["free"]
Unknown = Literal["focal", "k1", "k2", "cx", "cy", "aspect"]


def _as_three(value: object) -> object:
    """One number for all axes."""
    return (value, value, value) if isinstance(value, (int, float)) and not isinstance(value, bool) else value


def _refuse_not_positive(value: Metres3 | Free | None) -> Metres3 | Free | None:
    if isinstance(value, tuple) and min(value) <= 0:
        raise ValueError('each 1-sigma must be positive; leave it out to hold the value, or say "free"')
    return value


class AntennaSection(Section):
    """Positions are of an antenna: lever_arm_m in the rig's frame (x right, y down, z forward), of images without a rig
    in that of the camera. sigma_m: estimated with it as weight, "free": without; left out: held."""

    lever_arm_m: Metres3
    sigma_m: Metres3 | Free | None = None

    _three = field_validator("sigma_m", mode="before")(_as_three)
    _positive = field_validator("sigma_m")(_refuse_not_positive)


class GnssOffsetSection(Section):
    """An offset of all positions, estimated; piecewise linear between nodes with every_s or every_stations."""

    sigma_m: Metres3 | Free
    every_s: float | None = Field(default=None, gt=0)
    every_stations: int | None = Field(default=None, ge=2)

    _three = field_validator("sigma_m", mode="before")(_as_three)
    _positive = field_validator("sigma_m")(_refuse_not_positive)

    @model_validator(mode="after")
    def _one_interval(self) -> GnssOffsetSection:
        if self.every_s is not None and self.every_stations is not None:
            raise ValueError("the interval is every_s or every_stations, not both")
        return self


class TrajectorySection(Section):
    """Poses of images by an IMU or a tracker: motions between those that follow each other in the file.

    The sigmas of a motion grow with the root of its length and duration: sigma_m^2 + sigma_m_per_root_m^2 * length +
    sigma_m_per_root_s^2 * duration, rotations alike.
    """

    file: str
    angles: AngleConvention
    angle_unit: AngleUnit
    sigma_m: float = Field(gt=0)
    sigma_deg: float = Field(gt=0)
    sigma_m_per_root_m: float = Field(default=0.0, ge=0)
    sigma_m_per_root_s: float = Field(default=0.0, ge=0)
    sigma_deg_per_root_m: float = Field(default=0.0, ge=0)
    sigma_deg_per_root_s: float = Field(default=0.0, ge=0)
    max_gap_m: float = Field(default=50.0, gt=0)

    @property
    def by_time(self) -> bool:
        """Whether a sigma grows with time."""
        return self.sigma_m_per_root_s > 0 or self.sigma_deg_per_root_s > 0


class DistancesSection(Section):
    """Measured distances between control points, or points that a table of marks of their own shows."""

    file: str
    marks: str | None = None


Calibrations = dict[str, dict[str, float | Free]]
"""By the id of a camera, or "*" for all others: 1-sigma of each parameter that the adjustment estimates, or "free"."""


def refuse_cameras_of_panoramas(cameras: str | None, panorama: PanoramaSection | None) -> None:
    """Raises ValueError: the heads of panoramas are their cameras."""
    if cameras is not None and panorama is not None:
        raise ValueError("panoramas have no camera table: name their heads with panorama.heads, and leave out cameras")


class PanoramaSection(Section):
    """The images are panoramas; pinhole heads are cut from them, five standard ones without a table of heads."""

    projection: Literal["equirectangular", "cube-map"]
    heads: str | None = None
    stitching_radius_m: float | None = Field(default=None, gt=0)


class EpochSection(Section):
    """rig: a table of how cameras are mounted; images of one `station` in the table of positions were taken together.

    intrinsics: what is not known of the cameras; "estimate" is the focal length, the principal point and k1.

    A principal point that is held where it is not makes poses wrong by more than they state.
    """

    images: str
    cameras: str | None = None
    gnss: str | None = None
    rig: str | None = None
    intrinsics: str | tuple[str, ...] | None = None
    panorama: PanoramaSection | None = None
    antenna: AntennaSection | None = None
    gnss_offset: GnssOffsetSection | None = None
    motions: str | None = None
    trajectory: TrajectorySection | None = None
    distances: DistancesSection | None = None
    calibration: Calibrations = Field(default_factory=dict)
    mountings: Literal["weighted", "held"] = "weighted"
    table: TableSection = TableSection()

    @model_validator(mode="after")
    def _beside_images(self) -> EpochSection:
        if self.gnss is None and (self.antenna is not None or self.gnss_offset is not None):
            raise ValueError("an antenna or gnss_offset says something of positions: name their table with gnss")
        if self.panorama is not None and self.antenna is not None:
            raise ValueError("positions of panoramas are of their middle: leave out antenna")
        if self.motions is not None and self.trajectory is not None:
            raise ValueError("measured motions come from a table (motions) or from a trajectory, not from both")
        if self.mountings == "held" and self.rig is None:
            raise ValueError('mountings = "held" holds the cameras of a rig: name its table with rig')
        if self.calibration and self.intrinsics is not None:
            raise ValueError(
                "intrinsics are estimated image by image in localization, calibration in the adjustment from known "
                "values: one of both"
            )
        return self

    @model_validator(mode="after")
    def _one_source_of_cameras(self) -> EpochSection:
        refuse_cameras_of_panoramas(self.cameras, self.panorama)
        if self.rig is not None and (self.panorama is not None or self.gnss is None):
            raise ValueError(
                "a rig needs the column `station` of a table of positions (gnss), which says what was exposed "
                "together; the heads of a panorama are a rig by themselves: leave out rig"
            )
        if self.panorama is not None and self.intrinsics is not None:
            raise ValueError("the heads of a panorama are known cameras: leave out intrinsics")
        if self.cameras is None and self.panorama is None and "focal" not in self.unknown:
            raise ValueError(
                'nothing says what cameras took its images: name a table with `cameras`, or set intrinsics = "estimate"'
            )
        return self

    @field_validator("intrinsics")
    @classmethod
    def _possible(cls, value: Any) -> Any:
        names = (value,) if isinstance(value, str) else value or ()
        if value != "estimate" and set(names) - set(get_args(Unknown)):
            known = ", ".join(f'"{name}"' for name in get_args(Unknown))
            raise ValueError(f'expected "estimate", or a list of {known}')
        if len(set(names)) < len(names) or {"k1", "k2"} & set(names) == {"k2"}:
            raise ValueError("each of the intrinsics at most once, and k2 only together with k1")
        return value

    @property
    def unknown(self) -> tuple[Unknown, ...]:
        """Which intrinsics are to be estimated of every image of the epoch."""
        given = ("focal", "k1", "cx", "cy") if self.intrinsics == "estimate" else self.intrinsics or ()
        names = (given,) if isinstance(given, str) else given
        return tuple(name for name in get_args(Unknown) if name in names)
