"""Sections of project.toml that all projects share, and those of a block: image measurements without images."""

from __future__ import annotations

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

    sensor_mm: width and height of the sensor that the image shows; by the id of the camera where they differ.
    """

    format: Literal["bingo"]
    file: str
    sensor_mm: tuple[float, float] | dict[str, tuple[float, float]]
    sigma_px: float = Field(default=1.0, gt=0)
    mark_prefix: str | None = Field(default=None, min_length=1)
    mark_sigma_px: float = Field(default=0.5, gt=0)

    @field_validator("sensor_mm")
    @classmethod
    def _sizes(cls, value: tuple[float, float] | dict[str, tuple[float, float]]):
        sizes = value.values() if isinstance(value, dict) else (value,)
        if any(min(size) <= 0 for size in sizes):
            raise ValueError("expected the width and height of the sensor in millimetres")
        return value


class BlockGnss(Section):
    """Positions of an antenna. lever_arm_m is in the frame of the rig, or of the camera where there is no rig.

    lever_arm_sigma_m: estimated with this prior; without it, held. offset_sigma_m: prior of an offset east, north, up
    that all positions share, as of a base station that is not where it is said to be; without it, none.
    """

    file: str
    lever_arm_m: Metres3 = (0.0, 0.0, 0.0)
    lever_arm_sigma_m: Metres3 | None = None
    offset_sigma_m: Metres3 | None = None
    table: TableSection = TableSection()

    _check_sigmas = field_validator("lever_arm_sigma_m", "offset_sigma_m")(_positive)


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
    """Another program's calibrations, which the report compares with: `camera`, a file of one camera or, in the order of
    the ids in `order`, of several; or `parameters`, a file of the parameters of all images."""

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
    """attitude: "vertical" where all cameras look straight down but for a few degrees, else a table to start from.

    camera_sigma: 1-sigma of what is estimated of cameras, in the unit of its value (focal, cx, cy: px); what is not
    named is estimated freely. control: ids of points that take part; the others are check points.
    """

    observations: BlockObservations
    cameras: str
    gnss: BlockGnss | None = None
    attitude: Literal["vertical"] | BlockAttitude = "vertical"
    rig: str | None = None
    camera_sigma: dict[str, float] = Field(default_factory=dict)
    control: Literal["all", "none"] | tuple[str, ...] = "all"
    hold_out: HoldOut | None = None
    compare: BlockComparison | None = None

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
        if self.rig is not None and self.gnss is None:
            raise ValueError("a rig needs the column `station` of a table of positions (gnss)")
        return self
