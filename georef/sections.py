"""Sections of project.toml that all projects share, and those of a block: image measurements without images."""

from __future__ import annotations

import re
from typing import Literal

from pydantic import Field, field_validator, model_validator

from georef.config import Section

AngleConvention = Literal["omega-phi-kappa", "yaw-pitch-roll"]
AngleUnit = Literal["deg", "gon", "rad"]
Metres3 = tuple[float, float, float]


class CrsSection(Section):
    horizontal: str
    height: str | None = None
    origin: tuple[float, float, float] | None = None


class TableSection(Section):
    """How a table is written, where detection is not enough."""

    delimiter: str | None = None
    decimal: Literal[".", ","] | None = None
    encoding: str | None = None
    columns: dict[str, str] = Field(default_factory=dict)


def _positive(values: Metres3 | None) -> Metres3 | None:
    if values is not None and min(values) <= 0:
        raise ValueError("each 1-sigma must be positive")
    return values


class BlockObservations(Section):
    """Image measurements, and which of their points are marks of surveyed points: those whose id has a prefix.

    format: "bingo", millimetres, or "pix4d", pixels (`*_tp_pix4d.txt`). sensor_mm: width and height of the sensor that
    the image shows; by the id of the camera where they differ; left out where the headers of the file say it, as
    Pix4D's do (H_35.0_23.3).
    """

    format: Literal["bingo", "pix4d"]
    file: str
    sensor_mm: tuple[float, float] | dict[str, tuple[float, float]] | None = None
    sigma_px: float = Field(default=1.0, gt=0)
    mark_prefix: str | None = Field(default=None, min_length=1)
    mark_sigma_px: float = Field(default=0.5, gt=0)

    @field_validator("sensor_mm")
    @classmethod
    def _sizes(cls, value: tuple[float, float] | dict[str, tuple[float, float]] | None):
        sizes = value.values() if isinstance(value, dict) else () if value is None else (value,)
        if any(min(size) <= 0 for size in sizes):
            raise ValueError("expected the width and height of the sensor in millimetres")
        return value


def _groups(pattern: str | None) -> str | None:
    """A regular expression with a group, which says what of a name is meant."""
    if pattern is None:
        return None
    try:
        groups = re.compile(pattern).groups
    except re.error as error:
        raise ValueError(f"not a regular expression: {error}") from None
    if not groups:
        raise ValueError("expected a regular expression with a group in brackets, such as '^([A-Z])'")
    return pattern


class GnssDrift(Section):
    """Offsets of GNSS positions that differ by flight, or change in time: one of sigma_m (east, north, up) about zero
    for each flight, or every interval_s seconds, linear between.

    flight: the column of the table that names the flight of a position, or flight_pattern, whose groups say it of the
    name of an image; without both, all is one flight. interval_s asks for a column `time`.
    """

    sigma_m: Metres3
    flight: str | None = None
    flight_pattern: str | None = None
    interval_s: float | None = Field(default=None, gt=0)

    _check_sigma = field_validator("sigma_m")(_positive)
    _check_pattern = field_validator("flight_pattern")(_groups)

    @model_validator(mode="after")
    def _one_way(self) -> GnssDrift:
        if self.flight is not None and self.flight_pattern is not None:
            raise ValueError("name one of: flight, flight_pattern")
        return self


class BlockGnss(Section):
    """Positions of an antenna, by image or by exposure. lever_arm_m is in the frame of the rig, or of the camera where
    there is no rig; by the id of the camera where they differ.

    lever_arm_sigma_m: estimated with this prior; without it, held. offset_sigma_m: prior of an offset east, north, up
    that all positions share, as of a base station that is not where it is said to be; without it, none. drift: offsets
    by flight or time instead. sigma_m: of every position of a table that states none.
    """

    file: str
    lever_arm_m: Metres3 | dict[str, Metres3] = (0.0, 0.0, 0.0)
    lever_arm_sigma_m: Metres3 | None = None
    offset_sigma_m: Metres3 | None = None
    drift: GnssDrift | None = None
    sigma_m: Metres3 | None = None
    table: TableSection = TableSection()

    _check_sigmas = field_validator("lever_arm_sigma_m", "offset_sigma_m", "sigma_m")(_positive)

    @model_validator(mode="after")
    def _one_kind_of_drift(self) -> BlockGnss:
        if self.offset_sigma_m is not None and self.drift is not None:
            raise ValueError("name one of: offset_sigma_m (one for all), drift (by flight or time)")
        return self


class BlockRig(Section):
    """Cameras that expose together. file: a table of their mountings (camera, x, y, z, yaw, pitch, roll or omega, phi,
    kappa, sigma_m, sigma_deg; sigmas of 0: the camera that defines the rig; empty: estimated freely).

    Without a table the mountings start from the table of attitudes, that of `reference` defining the rig; sigma_m and
    sigma_deg are then their weights about that, estimated freely without. Which images were exposed together: a column
    `station` of the table of positions or attitudes, station_pattern, whose groups say it of the name of an image,
    station_within_s of each other by a column `time`, or "position": where the table gives the same position.
    """

    file: str | None = None
    reference: str | None = None
    station: Literal["column", "position"] = "column"
    station_pattern: str | None = None
    station_within_s: float | None = Field(default=None, gt=0)
    sigma_m: float | None = Field(default=None, gt=0)
    sigma_deg: float | None = Field(default=None, gt=0)

    _check_pattern = field_validator("station_pattern")(_groups)

    @model_validator(mode="after")
    def _complete(self) -> BlockRig:
        if self.file is None and self.reference is None:
            raise ValueError("name the table of mountings (file), or the camera that defines the rig (reference)")
        if (self.sigma_m is None) != (self.sigma_deg is None):
            raise ValueError("sigma_m and sigma_deg go together")
        return self


class Distance(Section):
    """A measured length between two points: scale bar, tape, distance meter."""

    a: str
    b: str
    distance_m: float = Field(gt=0)
    sigma_m: float = Field(gt=0)


class BlockAttitude(Section):
    """Rotations to start from, of a table of exterior orientations; they are no observations."""

    file: str
    angles: AngleConvention
    angle_unit: AngleUnit
    table: TableSection = TableSection()


class HoldOut(Section):
    """Adjust again and again with `control` of the points as control, all others as check: `count` such splits."""

    control: int = Field(ge=1)
    count: int = Field(default=20, ge=1)


class BlockComparison(Section):
    """Another program's calibrations, which the report compares with.

    camera: a file of one camera or, in the order of the ids in `order`, of several; or parameters: of all images.
    """

    format: Literal["pix4d"]
    camera: str | None = None
    order: tuple[str, ...] | None = None
    parameters: str | None = None

    @model_validator(mode="after")
    def _one_file(self) -> BlockComparison:
        if (self.camera is None) == (self.parameters is None):
            raise ValueError("name one of: camera, parameters")
        return self


class BlockSection(Section):
    """attitude: "vertical" where the cameras (of a rig its reference camera) look straight down but for a few degrees,
    else a table to start from.

    camera_pattern: its groups say the camera by the name of an image. camera_sigma: 1-sigma of what is estimated of
    cameras, in the unit of its value (focal, cx, cy: px); what is not named is estimated freely. control: ids of points
    that take part, or "table": as its column role says. check: ids of check points, or "others". distances: between
    points that are no check points.
    """

    observations: BlockObservations
    cameras: str
    camera_pattern: str | None = None
    gnss: BlockGnss | None = None
    attitude: Literal["vertical"] | BlockAttitude = "vertical"
    rig: str | BlockRig | None = None
    camera_sigma: dict[str, float] = Field(default_factory=dict)
    control: Literal["all", "none", "table"] | tuple[str, ...] = "all"
    check: Literal["others"] | tuple[str, ...] = "others"
    distances: tuple[Distance, ...] = ()
    hold_out: HoldOut | None = None
    compare: BlockComparison | None = None

    _check_pattern = field_validator("camera_pattern")(_groups)

    @property
    def mounted(self) -> BlockRig | None:
        """The rig as a section; a name alone is that of its table."""
        return BlockRig(file=self.rig) if isinstance(self.rig, str) else self.rig

    @field_validator("camera_sigma")
    @classmethod
    def _positive_sigmas(cls, value: dict[str, float]) -> dict[str, float]:
        if any(sigma <= 0 for sigma in value.values()):
            raise ValueError("each 1-sigma must be positive; what is not estimated, the table of cameras leaves out")
        return value

    @model_validator(mode="after")
    def _positions_to_start_from(self) -> BlockSection:
        if self.gnss is None and self.attitude == "vertical":
            raise ValueError("nothing says where its images were taken: name gnss, or a table with `attitude`")
        rig = self.mounted
        if rig is not None and rig.file is None and self.attitude == "vertical":
            raise ValueError("a rig without a table of mountings needs a table of attitudes to start them from")
        return self

    @model_validator(mode="after")
    def _one_role_each(self) -> BlockSection:
        both = set(self.control) & set(self.check) if isinstance(self.control, tuple) else set()
        if isinstance(self.check, tuple) and both:
            raise ValueError(f"{min(both)} is control and check at once")
        return self
