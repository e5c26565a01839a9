"""What the tables of images and points share: an id, a position in the CRS, standard deviations."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from georef.geometry.rigid import Array
from georef.io.declarations import Declared
from georef.io.tables import IntArray, Table

CrsKind = Literal["projected", "geographic", "geocentric", "local"]
"""projected: easting, northing, height (m); geographic: longitude, latitude (deg), height (m); others: x, y, z (m)."""

_EAST_NORTH_UP = ("sigma_e", "sigma_n", "sigma_h")
_X_Y_Z = ("sigma_x", "sigma_y", "sigma_z")
POSITION_COLUMNS: dict[CrsKind, tuple[str, str, str]] = {
    "projected": ("easting", "northing", "height"),
    "geographic": ("longitude", "latitude", "height"),
    "geocentric": ("x", "y", "z"),
    "local": ("x", "y", "z"),
}
SIGMA_COLUMNS: dict[CrsKind, tuple[str, str, str]] = {
    "projected": _EAST_NORTH_UP,
    "geographic": _EAST_NORTH_UP,  # metres along east, north, up, not degrees
    "geocentric": _X_Y_Z,
    "local": _X_Y_Z,
}


@dataclass(frozen=True, eq=False)
class PositionTable:
    """Common to tables of positions: N items, their coordinates (N, 3) in the order of POSITION_COLUMNS, their rows."""

    path: Path
    declared: Declared
    rows: IntArray  # (N,) line numbers
    positions_in_crs: Array  # (N, 3)

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def declared_crs(self) -> str | None:
        """The CRS that the file declares, "EPSG:25832" or "local"; None where it declares none."""
        return self.declared.crs


def require_columns(table: Table, crs_kind: CrsKind, names: Sequence[str]) -> None:
    """Raise InputError unless the position columns of the CRS kind and `names` are there.

    x and y never stand in for easting and northing: which of them is which is for the user to say.
    """
    position = POSITION_COLUMNS[crs_kind]
    axes = {name: axis for name, axis in zip(position, "xyz", strict=True) if not table.has(name) and table.has(axis)}
    remedy = ""
    if crs_kind in ("projected", "geographic") and axes:
        mapping = ", ".join(f'{name} = "{axis}"' for name, axis in axes.items())
        remedy = (
            "The order of axes is never guessed: say which column is which in project.toml, e.g. "
            f"table.columns = {{ {mapping} }} (in some systems x points north)."
        )
    table.require(position, remedy)
    table.require(names)


def read_positions(table: Table, crs_kind: CrsKind, *, allow_empty: bool = False) -> Array:
    """The position columns (N, 3), unchanged: metres, or degrees and metres; NaN for empty cells where allowed.

    Raises InputError for impossible ones.
    """
    positions = table.stack(POSITION_COLUMNS[crs_kind], allow_empty=allow_empty)
    if crs_kind == "geographic":
        for axis, limit in ((1, 90.0), (0, 360.0)):
            for i in np.flatnonzero(np.abs(positions[:, axis]) > limit)[:1]:
                raise table.error(
                    int(i),
                    f"Column {POSITION_COLUMNS[crs_kind][axis]!r} has {positions[i, axis]}.",
                    expected=f"degrees, at most {limit:g} in size.",
                    remedy="Exchange longitude and latitude if they are swapped; metres need a projected CRS.",
                )
    return positions


def read_sigmas(
    table: Table,
    names: Sequence[str],
    subject: Callable[[int], str],
    *,
    expected: str,
    remedy: Callable[[int], str] = lambda _: "Correct the value.",
    allow_empty: bool = False,
    allow_partly_empty: bool = False,
) -> Array:
    """Columns of standard deviations (N, len(names)), all positive; rows of NaN for items without, where allowed, and
    single ones where that is.

    subject and remedy give, for the index of an item, its name and what to do. Raises InputError for zero, negative
    and partly empty ones.
    """
    sigmas = table.stack(names, allow_empty=allow_empty or allow_partly_empty)
    for i, k in np.argwhere(sigmas <= 0)[:1]:
        value = float(sigmas[i, k])
        fault = "which would fix it exactly" if value == 0 else "and a standard deviation is never negative"
        raise table.error(
            int(i), f"{subject(int(i))} has {names[k]} = {value}, {fault}.", expected=expected, remedy=remedy(int(i))
        )
    empty = np.isnan(sigmas) & (not allow_partly_empty)
    for i in np.flatnonzero(empty.any(axis=1) & ~empty.all(axis=1))[:1]:
        raise table.error(
            int(i),
            f"{subject(int(i))} has some of {', '.join(names)}, and not all of them.",
            expected="all or none.",
            remedy="Fill in the others, or empty them all.",
        )
    return sigmas
