"""What else tables of positions say of exposures: when, and in which flight."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from georef.geometry.rigid import Array
from georef.io.table import Table
from georef.io.tables import TableFormat, read_table

_TIMES = ("time", "time_s")


@dataclass(frozen=True, eq=False)
class Exposures:
    """Of the N rows of a table of positions."""

    times_s: Array | None  # (N,); None: the file has no such column
    flights: tuple[str, ...] | None  # N; None: none was asked for


def read_exposures(
    path: Path | str,
    *,
    columns: Mapping[str, str] | None = None,
    table_format: TableFormat | None = None,
    flight: str | None = None,
) -> Exposures:
    """Read the column `time` or `time_s`, seconds or dates and times by ISO 8601 (UTC where they name no zone), and
    the one that `flight` names. Raises InputError."""
    table = read_table(path, columns=columns, table_format=table_format)
    name = next((name for name in _TIMES if table.has(name)), None)
    times = None if name is None else np.array([_seconds(table, name, i, t) for i, t in enumerate(table.ids(name))])
    return Exposures(times, None if flight is None else table.ids(flight))


def _seconds(table: Table, name: str, index: int, text: str) -> float:
    try:
        return float(text)
    except ValueError:
        pass
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
