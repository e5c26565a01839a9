"""The tables of a block: where its images were taken, and rotations to start from."""

from __future__ import annotations

import logging
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from georef.crs import CrsDefinition
from georef.errors import InputError
from georef.geometry.rigid import Array
from georef.io.bingo import BingoTable
from georef.io.columns import CrsKind
from georef.io.exposures import Exposures, read_exposures
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
    times_s: Array | None = None  # of the rows of gnss; None: not said
    flights: tuple[str, ...] | None = None  # the same; None: not asked for

    @property
    def positions_in_crs(self) -> Array:
        return np.concatenate([table.positions_in_crs for table in (self.gnss, self.attitude) if table is not None])


def read_tables(project: Project, section: BlockSection, kind: CrsKind, definition: CrsDefinition) -> BlockTables:
    """Positions and rotations as the section declares them. Raises InputError or CrsError."""
    gnss = attitude = None
    said = Exposures(None, None)
    if section.gnss is not None:
        table = section.gnss.table
        path = project.data(section.gnss.file)
        written = {"columns": table.columns or None, "table_format": table_format(table)}
        gnss = read_gnss(path, crs_kind=kind, **written)
        drift = section.gnss.drift
        said = read_exposures(path, flight=None if drift is None else drift.flight, **written)
        check_frame(gnss, definition)
        if gnss.unstated and section.gnss.sigma_m is None:
            raise InputError(
                "The table of positions states no sigmas.",
                expected="a standard deviation of each coordinate: positions are observations of the adjustment.",
                remedy="Add the columns, map them in project.toml: table.columns = { sigma_e = ... }, or state one for "
                "all: gnss.sigma_m = [0.02, 0.02, 0.04].",
                path=gnss.path,
            )
        if gnss.unstated:
            gnss = replace(gnss, sigmas_m=np.tile(np.array(section.gnss.sigma_m), (len(gnss), 1)))
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
    return BlockTables(gnss, attitude, said.times_s, said.flights)


def rows_of(
    table: GnssTable | ExteriorOrientationTable, image_ids: Sequence[str], stations: Sequence[str] | None = None
) -> IntArray:
    """The row of each image (M,) in a table that may name images with the ending of their file, or their exposures
    (M names); -1 where it has none."""
    index = {name: i for i, name in enumerate(table.image_ids)}
    bare = {bare_name(name): i for name, i in index.items()}
    found = [index.get(name, bare.get(bare_name(name), -1)) for name in image_ids]
    if stations is not None:
        found = [row if row >= 0 else index.get(name, -1) for row, name in zip(found, stations, strict=True)]
    taken = len({row for row in found if row >= 0})
    if taken < len(table):
        logger.warning("%s: %d rows are of no image that has measurements", table.path, len(table) - taken)
    return np.array(found, dtype=np.int64)


def require_rows(found: NDArray[np.bool_], path: Path, image_ids: Sequence[str], measured: BingoTable) -> None:
    """Raises InputError where an image has nothing to start from: found (M,)."""
    missing = np.flatnonzero(~found)
    if len(missing):
        raise InputError(
            f"{len(missing)} images have measurements and no row in {path.name}, the first is "
            f"'{image_ids[missing[0]]}'.",
            expected="the names of images of the measurements, with or without the ending of their files.",
            remedy=f"Add their rows to {path}, or delete their measurements.",
            path=measured.path,
            row=int(measured.image_rows[missing[0]]),
        )


def bare_name(image_id: str) -> str:
    """The name without the ending of its file."""
    return _ENDING.sub("", image_id)


def by_pattern(pattern: str, image_ids: Sequence[str], what: str) -> tuple[str, ...]:
    """What the groups of a pattern say of each name (M), joined. Raises InputError where it does not fit."""
    expression = re.compile(pattern)
    out: list[str] = []
    for name in image_ids:
        found = expression.search(name)
        if found is None or not any(found.groups()):
            raise InputError(
                f"The pattern {pattern!r} does not fit the image '{name}': nothing says its {what}.",
                expected=f"a regular expression whose groups are the {what} in every name.",
                remedy="Correct the pattern in project.toml.",
            )
        out.append("_".join(group for group in found.groups() if group))
    return tuple(out)
