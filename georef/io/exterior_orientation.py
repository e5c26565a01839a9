"""Exterior orientation tables: an image, its position in the CRS and its angles; optionally intrinsics and sigmas."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from georef.geometry.angles import rotation_from_omega_phi_kappa, rotation_from_yaw_pitch_roll
from georef.geometry.rigid import Array
from georef.io.columns import SIGMA_COLUMNS, CrsKind, PositionTable, read_positions, read_sigmas, require_columns
from georef.io.declarations import ANGLE_NAMES, UNIT_NAMES, AngleConvention, AngleUnit, check_declared_angles
from georef.io.tables import Table, TableFormat, read_table

log = logging.getLogger(__name__)

INTRINSICS_COLUMNS = ("fx", "fy", "cx", "cy")
FULL_TURN: dict[AngleUnit, float] = {"deg": 360.0, "gon": 400.0, "rad": 2.0 * np.pi}
_TO_ROTATION = {
    "omega-phi-kappa": rotation_from_omega_phi_kappa,
    "yaw-pitch-roll": rotation_from_yaw_pitch_roll,
}
_MIN_IMAGES_TO_SUSPECT_RADIANS = 10


@dataclass(frozen=True, eq=False)
class ExteriorOrientationTable(PositionTable):
    """Poses of N images in CRS axes: see PositionTable, and

    axes_from_cam: camera (x right, y down, z forward) to the axes that the angles refer to (E, N, up or x, y, z);
    intrinsics: fx, fy, cx, cy in pixels of each image; the sigmas are rows of NaN for images without;
    cameras: the id of each image's camera, empty where none is named.
    """

    image_ids: tuple[str, ...]
    axes_from_cam: Array  # (N, 3, 3)
    cameras: tuple[str, ...]
    intrinsics: Array | None = None  # (N, 4) px
    position_sigmas_m: Array | None = None  # (N, 3) m along the axes of the CRS
    angle_sigmas_rad: Array | None = None  # (N, 3) rad, of the angles in the order of their columns


def read_exterior_orientation(
    path: Path | str,
    *,
    crs_kind: CrsKind,
    angles: AngleConvention,
    angle_unit: AngleUnit,
    columns: Mapping[str, str] | None = None,
    table_format: TableFormat | None = None,
) -> ExteriorOrientationTable:
    """Read image, position, angles, optionally fx, fy, cx, cy (px), camera, sigmas of position (m) and of the angles.

    The convention and the unit of the angles are asked for, never guessed. Raises InputError for columns that are
    missing, values that cannot be, images listed twice, and comments that declare other angles than asked for.
    """
    table = read_table(path, columns=columns, table_format=table_format)
    return exterior_orientation_from_table(table, crs_kind=crs_kind, angles=angles, angle_unit=angle_unit)


def exterior_orientation_from_table(
    table: Table, *, crs_kind: CrsKind, angles: AngleConvention, angle_unit: AngleUnit
) -> ExteriorOrientationTable:
    """The exterior orientation of a table that is read already; see read_exterior_orientation."""
    check_declared_angles(table, angles, angle_unit)
    names = ANGLE_NAMES[angles]
    require_columns(table, crs_kind, ("image", *names))
    image_ids = table.unique_ids("image")
    to_rad = 2.0 * np.pi / FULL_TURN[angle_unit]
    angles_rad = _checked_angles(table, names, angle_unit) * to_rad
    angle_sigmas = _sigmas(table, image_ids, tuple(f"sigma_{name}" for name in names), UNIT_NAMES[angle_unit])
    return ExteriorOrientationTable(
        path=table.path,
        declared=table.declared,
        rows=table.rows,
        positions_in_crs=read_positions(table, crs_kind),
        image_ids=image_ids,
        axes_from_cam=np.array([_TO_ROTATION[angles](row) for row in angles_rad]).reshape(-1, 3, 3),
        cameras=table.text("camera") if table.has("camera") else ("",) * len(table),
        intrinsics=_intrinsics(table),
        position_sigmas_m=_sigmas(table, image_ids, SIGMA_COLUMNS[crs_kind], "metres"),
        angle_sigmas_rad=None if angle_sigmas is None else angle_sigmas * to_rad,
    )


def _checked_angles(table: Table, names: tuple[str, ...], unit: AngleUnit) -> Array:
    angles = table.stack(names)
    turn = FULL_TURN[unit]
    for i, k in np.argwhere(np.abs(angles) > turn * (1 + 1e-9))[:1]:
        other = "deg" if unit == "rad" else "gon"
        guess = f'If the file is in {UNIT_NAMES[other]}, set angle_unit = "{other}" in project.toml; else c'
        raise table.error(
            int(i),
            f"Column {names[k]!r} has {angles[i, k]}, more than a full turn in {UNIT_NAMES[unit]}.",
            expected=f"angles between {-turn:.6g} and {turn:.6g}.",
            remedy=("C" if unit == "gon" else guess) + "orrect the value.",
        )
    small = len(angles) >= _MIN_IMAGES_TO_SUSPECT_RADIANS and np.abs(angles).max() <= FULL_TURN["rad"]
    if unit != "rad" and small:
        log.warning("%s: all angles are below 6.29 %s; are they radians?", table.path, UNIT_NAMES[unit])
    return angles


def _intrinsics(table: Table) -> Array | None:
    if not any(table.has(name) for name in INTRINSICS_COLUMNS):
        return None
    values = table.stack(INTRINSICS_COLUMNS)
    for i, k in np.argwhere(values[:, :2] <= 0)[:1]:
        raise table.error(
            int(i),
            f"Column {INTRINSICS_COLUMNS[k]!r} has {values[i, k]}.",
            expected="a positive focal length in pixels.",
            remedy="Correct the value.",
        )
    return values


def _sigmas(table: Table, image_ids: tuple[str, ...], names: tuple[str, ...], unit: str) -> Array | None:
    if not any(table.has(name) for name in names):
        return None
    return read_sigmas(
        table,
        names,
        lambda i: f"Image {image_ids[i]!r}",
        expected=f"a positive standard deviation in {unit}.",
        remedy=lambda _: "Correct the value, or leave all three empty.",
        allow_empty=True,
    )
