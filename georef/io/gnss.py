"""Positions of images by GNSS, with their standard deviations and, where there are any, headings."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from georef.geometry.rigid import Array
from georef.io.columns import SIGMA_COLUMNS, CrsKind, PositionTable, read_positions, read_sigmas, require_columns
from georef.io.tables import Table, TableFormat, read_table


@dataclass(frozen=True, eq=False)
class GnssTable(PositionTable):
    """Measured positions of N images: see PositionTable, and

    heading_deg: of the optical axis, clockwise from north, NaN where it is empty or the file has no such column;
    cameras: the id of each image's camera, empty where none is named;
    stations: the exposure that each image belongs to with other cameras of its rig, empty where it was taken alone.
    """

    image_ids: tuple[str, ...]
    sigmas_m: Array  # (N, 3) m along the axes of the CRS (geographic: east, north, up), NaN where none is stated
    heading_deg: Array  # (N,)
    cameras: tuple[str, ...]
    stations: tuple[str, ...]
    times_s: Array = field(default_factory=lambda: np.zeros(0))  # (N,) of exposure; empty without such a column
    flights: tuple[str, ...] = ()  # N, of the column that was asked for; empty without

    @property
    def unstated(self) -> bool:
        """Whether the file has no sigmas at all."""
        return bool(np.isnan(self.sigmas_m).all())


def read_gnss(
    path: Path | str,
    *,
    crs_kind: CrsKind,
    columns: Mapping[str, str] | None = None,
    table_format: TableFormat | None = None,
    flight: str | None = None,
) -> GnssTable:
    """Read image, position, three sigmas (m) and optionally heading_deg, camera, station, time (or time_s) and the
    column `flight`.

    A file may be without any column of sigmas; some of them alone are refused. Raises InputError for columns that are
    missing, values that cannot be, sigmas that are not positive, and images
    that are listed twice.
    """
    table = read_table(path, columns=columns, table_format=table_format)
    stated = any(table.has(name) for name in SIGMA_COLUMNS[crs_kind]) or any("sigma" in n.lower() for n in table.header)
    require_columns(table, crs_kind, ("image", *(SIGMA_COLUMNS[crs_kind] if stated else ())))
    image_ids = table.unique_ids("image")
    return GnssTable(
        path=table.path,
        declared=table.declared,
        rows=table.rows,
        positions_in_crs=read_positions(table, crs_kind),
        image_ids=image_ids,
        sigmas_m=_sigmas(table, crs_kind, image_ids) if stated else np.full((len(table), 3), np.nan),
        heading_deg=_headings(table),
        cameras=table.text("camera") if table.has("camera") else ("",) * len(table),
        stations=table.text("station") if table.has("station") else ("",) * len(table),
        times_s=_times(table),
        flights=() if flight is None else table.ids(flight),
    )


def _sigmas(table: Table, crs_kind: CrsKind, image_ids: tuple[str, ...]) -> Array:
    return read_sigmas(
        table,
        SIGMA_COLUMNS[crs_kind],
        lambda i: f"The position of image {image_ids[i]!r}",
        expected="a positive standard deviation in metres (RTK: 0.02 to 0.05; single receiver: 1 to 5).",
        remedy=lambda _: "Correct the value, or delete the row if the image has no GNSS position.",
    )


def _times(table: Table) -> Array:
    """Seconds (N,) of column `time` or `time_s`: numbers, or dates and times (ISO 8601, UTC where no zone is named)."""
    name = next((name for name in ("time", "time_s") if table.has(name)), None)
    if name is None:
        return np.zeros(0)
    out = np.empty(len(table))
    for i, text in enumerate(table.ids(name)):
        try:
            out[i] = float(text)
        except ValueError:
            out[i] = _instant(table, name, i, text)
    return out


def _instant(table: Table, name: str, index: int, text: str) -> float:
    try:
        instant = datetime.fromisoformat(text)
    except ValueError:
        raise table.error(
            index,
            f"Column {name!r} has {text!r}.",
            expected="seconds, or a date and time such as 2024-05-31T10:15:20.125.",
            remedy="Correct the value.",
        ) from None
    return (instant if instant.tzinfo else instant.replace(tzinfo=UTC)).timestamp()


def _headings(table: Table) -> Array:
    if not table.has("heading_deg"):
        return np.full(len(table), np.nan)
    headings = table.numbers("heading_deg", allow_empty=True)
    for i in np.flatnonzero(np.abs(headings) > 360.0)[:1]:
        raise table.error(
            int(i),
            f"Column 'heading_deg' has {headings[i]}.",
            expected="degrees clockwise from north, between -360 and 360.",
            remedy="Correct the value, or leave it empty.",
        )
    return headings
