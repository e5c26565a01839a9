"""The tables of a block: where its images were taken, and rotations to start from."""

from __future__ import annotations

import logging
import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from georef.crs import CrsDefinition
from georef.errors import InputError
from georef.geometry.rigid import Array
from georef.io.bingo import BingoTable
from georef.io.columns import CrsKind
from georef.io.exterior_orientation import ExteriorOrientationTable, read_exterior_orientation
from georef.io.gnss import GnssTable, read_gnss
from georef.io.table import IntArray
from georef.project import BlockSection, Project
from georef.stages.reference import table_format
from georef.stages.survey import check_frame

logger = logging.getLogger(__name__)
_ENDING = re.compile(r"\.[A-Za-z]{3,4}$")


@dataclass(frozen=True, eq=False)
class BlockTables:
    """The tables of positions and of rotations to start from."""

    gnss: GnssTable | None
    attitude: ExteriorOrientationTable | None

    @property
    def positions_in_crs(self) -> Array:
        return np.concatenate([table.positions_in_crs for table in (self.gnss, self.attitude) if table is not None])


def read_tables(project: Project, section: BlockSection, kind: CrsKind, definition: CrsDefinition) -> BlockTables:
    """Positions and rotations as the section declares them. Raises InputError or CrsError."""
    gnss = attitude = None
    if section.gnss is not None:
        table = section.gnss.table
        path = project.data(section.gnss.file)
        gnss = read_gnss(path, crs_kind=kind, columns=table.columns or None, table_format=table_format(table))
        check_frame(gnss, definition)
        if gnss.unstated:
            raise InputError(
                "The table of positions states no sigmas.",
                expected="a standard deviation of each coordinate: positions are observations of the adjustment.",
                remedy="Add the columns, or map them in project.toml: table.columns = { sigma_e = ... }.",
                path=gnss.path,
            )
    if section.attitude != "vertical":
        given = section.attitude
        attitude = read_exterior_orientation(
            project.data(given.file),
            crs_kind=kind,
            angles=given.angles,
            angle_unit=given.angle_unit,
            columns=given.table.columns or None,
            table_format=table_format(given.table),
        )
        check_frame(attitude, definition)
    return BlockTables(gnss, attitude)


def rows_of(table: GnssTable | ExteriorOrientationTable, image_ids: Sequence[str], measured: BingoTable) -> IntArray:
    """The row of each image in a table that may name images with the ending of their file. Raises InputError."""
    index = {_ENDING.sub("", name): i for i, name in enumerate(table.image_ids)}
    index |= {name: i for i, name in enumerate(table.image_ids)}
    missing = [k for k, name in enumerate(image_ids) if name not in index]
    if missing:
        raise InputError(
            f"{len(missing)} images have measurements and no row in {table.path.name}, the first is "
            f"'{image_ids[missing[0]]}'.",
            expected="the names of images of the measurements, with or without the ending of their files.",
            remedy=f"Add their rows to {table.path}, or delete their measurements.",
            path=measured.path,
            row=int(measured.image_rows[missing[0]]),
        )
    if len(table) > len(image_ids):
        logger.warning("%s: %d images have no measurements", table.path, len(table) - len(image_ids))
    return np.array([index[name] for name in image_ids], dtype=np.int64)
