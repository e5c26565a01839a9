"""Coordinates of control and check points, with their standard deviations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, cast

import numpy as np

from georef.geometry.rigid import Array
from georef.io.columns import SIGMA_COLUMNS, CrsKind, PositionTable, read_positions, read_sigmas, require_columns
from georef.io.tables import Table, TableFormat, read_table
from georef.types.constraints import CheckKind

PointRole = Literal["control", "check"]
_REMEDY = {"control": "Correct the value, or list the point as a check point.", "check": "Correct the value."}


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
    allow_partial: bool = False,
) -> PointTable:
    """Read point, role (control or check), position, three sigmas (m) and optionally kind (absolute or relative).

    role: that of all points of a table without such a column, where something else says who takes part.
    allow_partial: a control point without sigma of its height is known horizontally, one without those of its
    horizontal coordinates by its height; coordinates without sigma are approximate, their sigmas NaN.
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
        sigmas_m=_sigmas(table, crs_kind, point_ids, roles, allow_partial),
        kinds=_kinds(table),
    )


def _sigmas(
    table: Table, crs_kind: CrsKind, point_ids: tuple[str, ...], roles: tuple[PointRole, ...], allow_partial: bool
) -> Array:
    names = SIGMA_COLUMNS[crs_kind]
    if not allow_partial:
        return _all_sigmas(table, names, point_ids, roles)
    given = table.stack(names, allow_empty=True)
    empty = np.isnan(given)
    horizontal, height = empty[:, 2] & ~empty[:, :2].any(axis=1), empty[:, :2].all(axis=1) & ~empty[:, 2]
    allowed = (horizontal | height) & (np.array(roles) == "control") & (crs_kind != "geocentric")
    for i in np.flatnonzero(empty.any(axis=1) & ~allowed)[:1]:
        raise table.error(
            int(i),
            f"{roles[i].capitalize()} point {point_ids[i]!r} has no {' and no '.join(np.array(names)[empty[i]])}.",
            expected="three sigmas; of a control point that is known horizontally the first two, of one known by its "
            "height the last.",
            remedy="Fill in what is missing; its coordinates stay, as approximate ones.",
        )
    whole = table.take(np.flatnonzero(~empty.any(axis=1)))
    _all_sigmas(
        whole, names, tuple(np.array(point_ids)[~empty.any(axis=1)]), tuple(np.array(roles)[~empty.any(axis=1)])
    )
    for i, k in np.argwhere(given <= 0)[:1]:
        raise table.error(
            int(i),
            f"{roles[i].capitalize()} point {point_ids[i]!r} has {names[k]} = {float(given[i, k])}, "
            + ("which would fix it exactly." if given[i, k] == 0 else "and a standard deviation is never negative."),
            expected="a positive standard deviation in metres (surveyed points: 0.01 to 0.05).",
            remedy=_REMEDY[roles[i]],
        )
    return given


def _all_sigmas(table: Table, names: Sequence[str], point_ids: tuple[str, ...], roles: tuple[PointRole, ...]) -> Array:
    return read_sigmas(
        table,
        names,
        lambda i: f"{roles[i].capitalize()} point {point_ids[i]!r}",
        expected="a positive standard deviation in metres (surveyed points: 0.01 to 0.05).",
        remedy=lambda i: _REMEDY[roles[i]],
    )


def _kinds(table: Table) -> tuple[CheckKind | None, ...]:
    if not table.has("kind"):
        return (None,) * len(table)
    values = table.choices("kind", [kind.value for kind in CheckKind], allow_empty=True)
    return tuple(CheckKind(value) if value else None for value in values)
