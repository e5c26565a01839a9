"""Tables of figures: columns that say their unit, cells that carry their interval; as text, CSV and JSON."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from georef.evaluation.statistics import Interval

UNKNOWN, INFINITE = "\N{EN DASH}", "\N{INFINITY}"


@dataclass(frozen=True)
class Column:
    """Values are kept in `unit`; they are shown times `scale`, in `shown_unit`, with so many digits."""

    key: str
    title: str
    unit: str = ""
    digits: int = 0
    scale: float = 1.0
    shown_unit: str | None = None  # None: as `unit`
    interval: bool = False  # whether cells have a 95 % interval

    @property
    def heading(self) -> str:
        """Title and unit as they are shown."""
        unit = self.unit if self.shown_unit is None else self.shown_unit
        return f"{self.title} ({unit})" if unit else self.title


@dataclass(frozen=True)
class Estimate:
    """A value with its 95 % interval; infinite for an error of images that have no pose."""

    value: float | None
    interval: Interval | None = None


Cell = str | int | float | Estimate | None


@dataclass(frozen=True, eq=False)
class Table:
    """Rows map column keys to cells; a row that lacks a key leaves the cell unknown."""

    name: str
    title: str
    columns: tuple[Column, ...]
    rows: tuple[Mapping[str, Cell], ...]
    caption: str = ""
    notes: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON, with the cells as they are shown: main text and interval."""
        return {
            "name": self.name,
            "title": self.title,
            "caption": self.caption,
            "notes": list(self.notes),
            "columns": [{"key": c.key, "heading": c.heading, "unit": c.unit} for c in self.columns],
            "rows": [{c.key: _plain(row.get(c.key)) for c in self.columns} for row in self.rows],
            "shown": [[list(shown(c, row.get(c.key))) for c in self.columns] for row in self.rows],
        }

    def csv(self) -> str:
        """Comma-separated values: numbers in the columns' units, intervals in columns of their own."""
        header = [name for column in self.columns for name in _csv_names(column)]
        lines = [[text for c in self.columns for text in _csv_cells(c, row.get(c.key))] for row in self.rows]
        return "".join(",".join(map(_quoted, line)) + "\n" for line in [header, *lines])


def shown(column: Column, cell: Cell) -> tuple[str, str]:
    """A cell as text: the value, and its interval or nothing."""
    if isinstance(cell, Estimate):
        interval = ""
        if cell.interval is not None:
            interval = " to ".join(_number(column, limit) for limit in cell.interval)
        return _number(column, cell.value), interval
    return (cell, "") if isinstance(cell, str) else (_number(column, cell), "")


def _number(column: Column, value: float | None) -> str:
    if value is None or np.isnan(value):
        return UNKNOWN
    return INFINITE if np.isinf(value) else f"{column.scale * value:,.{column.digits}f}".replace(",", "\u202f")


def _plain(cell: Cell) -> Any:
    if isinstance(cell, Estimate):
        limits = None if cell.interval is None else [_json_number(limit) for limit in cell.interval]
        return {"value": _json_number(cell.value), "interval_95": limits}
    return cell if isinstance(cell, str) else _json_number(cell)


def _json_number(value: float | None) -> float | int | str | None:
    if value is None or np.isnan(value):
        return None
    return "infinite" if np.isinf(value) else value


def _csv_names(column: Column) -> list[str]:
    suffix = {"": "", "%": "_percent"}.get(column.unit, f"_{column.unit.replace(' ', '_').replace('/', '_per_')}")
    name = f"{column.key}{suffix}"
    return [name, f"{name}_low", f"{name}_high"] if column.interval else [name]


def _csv_cells(column: Column, cell: Cell) -> list[str]:
    if not column.interval:
        return [_csv_text(cell.value if isinstance(cell, Estimate) else cell)]
    estimate = cell if isinstance(cell, Estimate) else Estimate(cell if not isinstance(cell, str) else None)
    return [_csv_text(estimate.value), *map(_csv_text, estimate.interval or (None, None))]


def _csv_text(value: str | float | None) -> str:
    if value is None or (isinstance(value, float) and np.isnan(value)):
        return ""
    return f"{value:.9g}" if isinstance(value, float) else str(value)


def _quoted(text: str) -> str:
    needs = any(mark in text for mark in ',"\n')
    return '"' + text.replace('"', '""') + '"' if needs else text
