"""Coordinates of control and check points, with their standard deviations."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, cast

from georef.geometry.rigid import Array
from georef.io.columns import SIGMA_COLUMNS, CrsKind, PositionTable, read_positions, read_sigmas, require_columns
from georef.io.tables import Table, TableFormat, read_table
from georef.types.constraints import CheckKind

PointRole = Literal["control", "check"]


@dataclass(frozen=True, eq=False)
class PointTable(PositionTable):
    """N surveyed points: see PositionTable; a kind is None where the file does not say it."""

    point_ids: tuple[str, ...]
    roles: tuple[PointRole, ...]
    sigmas_m: Array  # (N, 3) m along the axes of the CRS (geographic: east, north, up)
    kinds: tuple[CheckKind | None, ...]


def read_points(
    path: Path | str,
    *,
    crs_kind: CrsKind,
    columns: Mapping[str, str] | None = None,
    table_format: TableFormat | None = None,
    role: PointRole | None = None,
) -> PointTable:
    """Read point, role (control or check), position, three sigmas (m) and optionally kind (absolute or relative).

    role: that of all points of a table without such a column, where something else says who takes part.
    Raises InputError for columns that are missing, values that cannot be, unknown roles, sigmas that are not
    positive, and points that are listed twice.
    """
    table = read_table(path, columns=columns, table_format=table_format)
    named = role is None or table.has("role")
    require_columns(table, crs_kind, ("point", *(("role",) if named else ()), *SIGMA_COLUMNS[crs_kind]))
    point_ids = table.unique_ids("point")
    roles = table.choices("role", ("control", "check")) if named else (role,) * len(table)
    roles = cast(tuple[PointRole, ...], roles)
    return PointTable(
        path=table.path,
        declared=table.declared,
        rows=table.rows,
        positions_in_crs=read_positions(table, crs_kind),
        point_ids=point_ids,
        roles=roles,
        sigmas_m=_sigmas(table, crs_kind, point_ids, roles),
        kinds=_kinds(table),
    )


def _sigmas(table: Table, crs_kind: CrsKind, point_ids: tuple[str, ...], roles: tuple[PointRole, ...]) -> Array:
    return read_sigmas(
        table,
        SIGMA_COLUMNS[crs_kind],
        lambda i: f"{roles[i].capitalize()} point {point_ids[i]!r}",
        expected="a positive standard deviation in metres (surveyed points: 0.01 to 0.05).",
        remedy=lambda i: (
            "Correct the value, or list the point as a check point." if roles[i] == "control" else "Correct the value."
        ),
    )


def _kinds(table: Table) -> tuple[CheckKind | None, ...]:
    if not table.has("kind"):
        return (None,) * len(table)
    values = table.choices("kind", [kind.value for kind in CheckKind], allow_empty=True)
    return tuple(CheckKind(value) if value else None for value in values)
