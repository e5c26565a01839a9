"""Delimited text tables: one reader for all of them.

A table has a header row with names (any case), one row an item, and comment lines that start with '#'. Encoding,
delimiter and decimal sign are detected, or stated by a TableFormat. Rows in messages are physical line numbers.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from georef.errors import InputError
from georef.io.declarations import check_declared_crs, check_declared_height, parse_declarations
from georef.io.files import read_text
from georef.io.table import IntArray, Table
from georef.io.text import (
    DELIMITER_NAMES,
    TableFormat,
    detect_decimal,
    detect_delimiter,
    split_fields,
    split_lines,
    stated_delimiter,
)

__all__ = ["IntArray", "Table", "TableFormat", "check_declared_crs", "check_declared_height", "read_table"]


def read_table(
    path: Path | str,
    *,
    columns: Mapping[str, str] | None = None,
    table_format: TableFormat | None = None,
    allow_no_rows: bool = False,
) -> Table:
    """Read a delimited text table with a header row.

    columns maps our names to names in the file; a name that is not mapped, or mapped to a column that is not there,
    stands for itself. Raises InputError for a file that cannot be read or is empty, an ambiguous delimiter or decimal
    sign, a bad header, and rows that are longer or shorter than the header.
    """
    path, stated = Path(path), table_format or TableFormat()
    lines = split_lines(read_text(path, stated.encoding), path)
    delimiter = stated_delimiter(stated.delimiter, path) if stated.delimiter else detect_delimiter(lines, path)
    decimal = stated.decimal or detect_decimal(lines, delimiter, path)
    fields = split_fields(lines, delimiter, path)
    header = _checked_header([name.strip() for name in fields[0]], path, lines.rows[0])
    _refuse_ragged(fields, lines.rows, delimiter, path)
    kept = [i for i in range(1, len(fields)) if any(fields[i])]  # rows of delimiters only, as spreadsheets leave them
    if not kept and not allow_no_rows:
        raise InputError(
            "The table has a header and no rows.", expected="one row an item.", remedy="Add the rows.", path=path
        )
    values = list(zip(*(fields[i] for i in kept), strict=True)) if kept else [()] * len(header)
    cells = {name.lower(): tuple(map(str.strip, column)) for name, column in zip(header, values, strict=True) if name}
    unnamed = [column for name, column in zip(header, values, strict=True) if not name and any(column)]
    if unnamed:
        raise _header_error("The header has a column without a name.", "Name it.", path, lines.rows[0])
    return Table(
        path=path,
        header=tuple(name for name in header if name),
        header_row=lines.rows[0],
        cells=cells,
        rows=np.array([lines.rows[i] for i in kept], dtype=np.int64),
        decimal=decimal,
        declared=parse_declarations(lines.comments, path),
        mapping=dict(columns or {}),
    )


def _checked_header(names: list[str], path: Path, row: int) -> list[str]:
    lower = [name.lower() for name in names if name]
    twice = next((name for name in names if name and lower.count(name.lower()) > 1), None)
    if twice is not None:
        raise _header_error(f"The header has the column {twice!r} twice.", "Rename or delete one of them.", path, row)
    values = [name for name in names if re.fullmatch(r"[+-]?\d+(?:[.,]\d*)?", name)]
    if values:
        raise _header_error(
            f"The first row holds values, not the names of columns: {', '.join(names)}.",
            "Add a header row; if it stands in a comment, delete its '#'.",
            path,
            row,
        )
    return names


def _header_error(problem: str, remedy: str, path: Path, row: int) -> InputError:
    return InputError(problem, expected="a header row with one name a column.", remedy=remedy, path=path, row=row)


def _refuse_ragged(fields: list[list[str]], rows: list[int], delimiter: str, path: Path) -> None:
    width = len(fields[0])
    for i, values in enumerate(fields):
        if len(values) == width or not any(values):
            continue
        remedy = "Correct the row, or the delimiter. " if delimiter != "," else "Correct the row. "
        if delimiter == "," and len(values) > width:
            remedy += "If its numbers have decimal commas, write decimal points or delimit the table by semicolons."
        elif delimiter == " ":
            remedy += "If an id holds blanks, quote it and delimit the table by commas."
        split = f"(delimited by {DELIMITER_NAMES.get(delimiter, delimiter)})"
        raise InputError(
            f"The row has {len(values)} values, the header has {width} names {split}.",
            expected="as many values as the header has names.",
            remedy=remedy.strip(),
            path=path,
            row=rows[i],
        )
