"""Coordinates of control and check points, with their standard deviations."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, cast

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
from georef.io.tables import Table, TableFormat, read_table
from georef.types.constraints import CheckKind

PointRole = Literal["control", "check"]
_COMPONENTS = {"3d": (True, True, True), "horizontal": (True, True, False), "height": (False, False, True)}


@dataclass(frozen=True, eq=False)
class PointTable(PositionTable):
    """N surveyed points: see PositionTable; a kind is None where the file does not say it."""

    point_ids: tuple[str, ...]
    roles: tuple[PointRole, ...]
    sigmas_m: Array  # (N, 3) m along the axes of the CRS (geographic: east, north, up)
    kinds: tuple[CheckKind | None, ...]
    known: NDArray[np.bool_] | None = None  # (N, 3) which coordinates are given, with a sigma; None: all


def read_points(
    path: Path | str,
    *,
    crs_kind: CrsKind,
    columns: Mapping[str, str] | None = None,
    table_format: TableFormat | None = None,
    role: PointRole | None = None,
    partial: bool = False,
) -> PointTable:
    """Read point, role (control or check), position, three sigmas (m) and optionally kind (absolute or relative).

    role: that of all points of a table without such a column, where something else says who takes part. partial: points
    may be known horizontally or in height alone, by empty cells of coordinates or sigmas, or a column `components`
    (3d, horizontal or height).
    Raises InputError for columns that are missing, values that cannot be, unknown roles, sigmas that are not
    positive, and points that are listed twice.
    """
    table = read_table(path, columns=columns, table_format=table_format)
    named = role is None or table.has("role")
    require_columns(table, crs_kind, ("point", *(("role",) if named else ()), *SIGMA_COLUMNS[crs_kind]))
    point_ids = table.unique_ids("point")
    roles = table.choices("role", ("control", "check")) if named else (role,) * len(table)
    roles = cast(tuple[PointRole, ...], roles)
    positions = read_positions(table, crs_kind, allow_empty=partial)
    sigmas = _sigmas(table, crs_kind, point_ids, roles, partial=partial)
    return PointTable(
        path=table.path,
        declared=table.declared,
        rows=table.rows,
        positions_in_crs=positions,
        point_ids=point_ids,
        roles=roles,
        sigmas_m=sigmas,
        kinds=_kinds(table),
        known=_known(table, crs_kind, point_ids, positions, sigmas) if partial else None,
    )


def _sigmas(
    table: Table, crs_kind: CrsKind, point_ids: tuple[str, ...], roles: tuple[PointRole, ...], *, partial: bool
) -> Array:
    return read_sigmas(
        table,
        SIGMA_COLUMNS[crs_kind],
        lambda i: f"{roles[i].capitalize()} point {point_ids[i]!r}",
        expected="a positive standard deviation in metres (surveyed points: 0.01 to 0.05).",
        remedy=lambda i: (
            "Correct the value, or list the point as a check point." if roles[i] == "control" else "Correct the value."
        ),
        allow_partly_empty=partial,
    )


def _known(
    table: Table, crs_kind: CrsKind, point_ids: tuple[str, ...], positions: Array, sigmas: Array
) -> NDArray[np.bool_]:
    """Which coordinates (N, 3) are given. Raises InputError unless all, the horizontal ones or the height are."""
    known = np.isfinite(positions) & np.isfinite(sigmas)
    if table.has("components"):
        words = table.choices("components", tuple(_COMPONENTS), allow_empty=True)
        asked = np.array([_COMPONENTS.get(word, (True, True, True)) for word in words])
        for i in np.flatnonzero((asked & ~known).any(axis=1) & np.array([bool(word) for word in words]))[:1]:
            raise table.error(
                int(i),
                f"Point {point_ids[i]!r} is said to be {words[i]!r}, and not all of that has a value and a sigma.",
                expected="a coordinate and a standard deviation of each component that counts.",
                remedy="Fill them in, or correct the column `components`.",
            )
        known &= asked
    names = POSITION_COLUMNS[crs_kind]
    whole = known.all(axis=1)
    horizontal = known[:, 0] & known[:, 1]
    lone = (known[:, 0] != known[:, 1]) | (~horizontal & ~known[:, 2]) | (~whole & (crs_kind == "geocentric"))
    for i in np.flatnonzero(lone)[:1]:
        given = [name for name, there in zip(names, known[i], strict=True) if there]
        raise table.error(
            int(i),
            f"Point {point_ids[i]!r} has {'only ' + given[0] if given else 'no coordinate'} with a sigma.",
            expected=f"all of {', '.join(names)} with their sigmas"
            + ("." if crs_kind == "geocentric" else f", {names[0]} and {names[1]}, or {names[2]}."),
            remedy="Fill in what is missing, or delete the row.",
        )
    return known


def _kinds(table: Table) -> tuple[CheckKind | None, ...]:
    if not table.has("kind"):
        return (None,) * len(table)
    values = table.choices("kind", [kind.value for kind in CheckKind], allow_empty=True)
    return tuple(CheckKind(value) if value else None for value in values)
