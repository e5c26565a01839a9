"""Surveyed points of which some are known horizontally or in height alone."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import numpy as np
from numpy.typing import NDArray

from georef.geometry.rigid import Array
from georef.io.columns import (
    POSITION_COLUMNS,
    SIGMA_COLUMNS,
    CrsKind,
    PositionTable,
    read_positions,
    read_sigmas,
    require_columns,
)
from georef.io.points import PointRole
from georef.io.tables import Table, TableFormat, read_table

_COMPONENTS = {"3d": (True, True, True), "horizontal": (True, True, False), "height": (False, False, True)}


@dataclass(frozen=True, eq=False)
class PartialPoints(PositionTable):
    """N surveyed points: see PositionTable; coordinates that the file leaves empty are NaN.

    known: which coordinates are given with a sigma and count; sigmas of the others may be NaN.
    """

    point_ids: tuple[str, ...]
    roles: tuple[PointRole, ...] | None  # None: the file has no such column
    sigmas_m: Array  # (N, 3) m along the axes of the CRS (geographic: east, north, up)
    known: NDArray[np.bool_]  # (N, 3)


def read_partial_points(
    path: Path | str,
    *,
    crs_kind: CrsKind,
    columns: Mapping[str, str] | None = None,
    table_format: TableFormat | None = None,
) -> PartialPoints:
    """Read point, position, three sigmas (m) and optionally role (control or check) and components.

    A point is known horizontally or in height alone where cells of its coordinates or sigmas are empty, or where the
    column `components` says so (3d, horizontal or height). Raises InputError for columns that are missing, values that
    cannot be, sigmas that are not positive, points that are listed twice, and points of which nothing is known.
    """
    table = read_table(path, columns=columns, table_format=table_format)
    require_columns(table, crs_kind, ("point", *SIGMA_COLUMNS[crs_kind]))
    point_ids = table.unique_ids("point")
    positions = read_positions(table, crs_kind, allow_empty=True)
    sigmas = read_sigmas(
        table,
        SIGMA_COLUMNS[crs_kind],
        lambda i: f"Point {point_ids[i]!r}",
        expected="a positive standard deviation in metres (surveyed points: 0.01 to 0.05).",
        remedy=lambda _: "Correct the value, or leave it empty where the coordinate is not to count.",
        allow_partly_empty=True,
    )
    return PartialPoints(
        path=table.path,
        declared=table.declared,
        rows=table.rows,
        positions_in_crs=positions,
        point_ids=point_ids,
        roles=_roles(table),
        sigmas_m=sigmas,
        known=_known(table, crs_kind, point_ids, np.isfinite(positions) & np.isfinite(sigmas)),
    )


def _roles(table: Table) -> tuple[PointRole, ...] | None:
    return cast(tuple[PointRole, ...], table.choices("role", ("control", "check"))) if table.has("role") else None


def _known(table: Table, crs_kind: CrsKind, point_ids: tuple[str, ...], given: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Which coordinates (N, 3) count, of those that are given. Raises InputError unless all, the horizontal ones or the
    height do."""
    known = given & _asked(table, point_ids, given)
    names = POSITION_COLUMNS[crs_kind]
    whole, horizontal = known.all(axis=1), known[:, 0] & known[:, 1]
    impossible = (known[:, 0] != known[:, 1]) | (~horizontal & ~known[:, 2]) | (~whole & (crs_kind == "geocentric"))
    for i in np.flatnonzero(impossible)[:1]:
        there = [name for name, counts in zip(names, known[i], strict=True) if counts]
        or_less = "." if crs_kind == "geocentric" else f", or {names[0]} and {names[1]}, or {names[2]}."
        raise table.error(
            int(i),
            f"Point {point_ids[i]!r} has {'only ' + there[0] if there else 'no coordinate'} with a sigma.",
            expected=f"all of {', '.join(names)} with their sigmas{or_less}",
            remedy="Fill in what is missing, or delete the row.",
        )
    return known


def _asked(table: Table, point_ids: tuple[str, ...], given: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Which coordinates (N, 3) the column `components` asks for; all where it is empty or not there."""
    if not table.has("components"):
        return np.ones_like(given)
    words = table.choices("components", tuple(_COMPONENTS), allow_empty=True)
    asked = np.array([_COMPONENTS.get(word, (True, True, True)) for word in words])
    stated = np.array([bool(word) for word in words])
    for i in np.flatnonzero((asked & ~given).any(axis=1) & stated)[:1]:
        raise table.error(
            int(i),
            f"Point {point_ids[i]!r} is said to be {words[i]!r}, and not all of that has a value and a sigma.",
            expected="a coordinate and a standard deviation of each component that counts.",
            remedy="Fill them in, or correct the column `components`.",
        )
    return asked
