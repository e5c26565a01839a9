"""The text of a delimited table: its lines, its delimiter and its decimal sign.

Rows are physical line numbers, counted from 1 as an editor counts them.
"""

from __future__ import annotations

import csv
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from georef.errors import InputError

_DELIMITER_WORDS = {
    "comma": ",",
    "semicolon": ";",
    "tab": "\t",
    "\\t": "\t",
    "space": " ",
    "blank": " ",
    "whitespace": " ",
}
DELIMITER_NAMES = {",": "commas", ";": "semicolons", "\t": "tabs", " ": "spaces"}
FORMAT_HINT = 'State it in project.toml, e.g. table = { delimiter = ";", decimal = "," }'
_LINES_TO_COMPARE = 50

_DECIMAL_COMMA, _DECIMAL_POINT = r"\d+,\d+", r"\d+\.\d+"
_NOT_THOUSANDS = r"(?:\d{4,},\d+|0\d*,\d+|\d+,(?:\d{1,2}|\d{4,}))"


@dataclass(frozen=True)
class TableFormat:
    """What the user states of a table; what is None is detected.

    delimiter is one character (" ": any blanks) or its name, "comma", "semicolon", "tab" or "space".
    """

    delimiter: str | None = None
    decimal: Literal[".", ","] | None = None
    encoding: str | None = None


@dataclass(frozen=True)
class TableLines:
    """Leading comments (row, text without '#'), and the header and data lines with their rows."""

    comments: tuple[tuple[int, str], ...]
    rows: list[int]
    lines: list[str]


def split_lines(text: str, path: Path) -> TableLines:
    """The lines of a table without blank and comment lines. Raises InputError when no header is left."""
    comments: list[tuple[int, str]] = []
    rows: list[int] = []
    lines: list[str] = []
    for row, line in enumerate(text.split("\n"), start=1):
        content = line.strip()
        if not content:
            continue
        if content[0] != "#":
            rows.append(row)
            lines.append(line)
        elif not lines:
            comments.append((row, content.lstrip("#").strip()))
    if not lines:
        raise InputError(
            "The file holds only comments." if comments else "The file is empty.",
            expected="a header row with the names of the columns, then one row an item.",
            remedy="Write the table again, or name another file in project.toml.",
            path=path,
        )
    return TableLines(tuple(comments), rows, lines)


def stated_delimiter(name: str, path: Path) -> str:
    """The delimiter that a TableFormat states. Raises InputError for one that cannot be."""
    delimiter = _DELIMITER_WORDS.get(name.lower(), name)
    if len(delimiter) == 1 and not delimiter.isalnum() and delimiter not in '"#.+-\r\n':
        return delimiter
    raise InputError(
        f"The delimiter {name!r} cannot be one.",
        expected='one character such as "," or ";", or comma, semicolon, tab, space.',
        remedy="Correct it in project.toml: table = { delimiter = ... }.",
        path=path,
    )


def detect_delimiter(table: TableLines, path: Path) -> str:
    """The delimiter of the header row: comma, semicolon or tab, else a blank. Raises InputError when several fit."""
    header = table.lines[0]
    candidates = [delimiter for delimiter in ",;\t" if delimiter in header]
    if not candidates:
        return " " if len(header.split()) > 1 else ","
    if len(candidates) > 1:
        sample = table.lines[:_LINES_TO_COMPARE]
        fitting = [d for d in candidates if len({len(fields) for fields in csv.reader(sample, delimiter=d)}) == 1]
        candidates = fitting or candidates
    if len(candidates) == 1:
        return candidates[0]
    raise InputError(
        f"The header may be delimited by {' or by '.join(DELIMITER_NAMES[d] for d in candidates)}: {header.strip()!r}.",
        expected="one delimiter that splits all rows into as many values as the header has names.",
        remedy=f"{FORMAT_HINT}.",
        path=path,
        row=table.rows[0],
    )


def detect_decimal(table: TableLines, delimiter: str, path: Path) -> Literal[".", ","]:
    """The decimal sign of the numbers of a table. Raises InputError when it cannot be told from the numbers."""
    if delimiter == "," or not any("," in line for line in table.lines[1:]):
        return "."
    body = "\n".join(table.lines[1:])
    comma, point = _find_number(_DECIMAL_COMMA, body, delimiter), _find_number(_DECIMAL_POINT, body, delimiter)
    if comma is None:
        return "."
    row = table.rows[1 + body.count("\n", 0, comma.start(1))]
    if point is not None:
        problem = f"The table mixes decimal commas and decimal points: {comma[1]!r} and {point[1]!r}."
    elif _find_number(_NOT_THOUSANDS, body, delimiter) is None:
        problem = f"The comma of {comma[1]!r} may be a decimal sign or a thousands separator."
    else:
        return ","
    raise InputError(
        problem,
        expected="one decimal sign in the whole table and no thousands separators.",
        remedy=f"Write decimal points, or state the decimal sign. {FORMAT_HINT}.",
        path=path,
        row=row,
    )


def split_fields(table: TableLines, delimiter: str, path: Path) -> list[list[str]]:
    """The fields of each line, the header first. Raises InputError for a quote that its line does not close."""
    if delimiter == " ":
        return [line.split() for line in table.lines]
    fields: list[list[str]] = []
    reader = csv.reader(table.lines, delimiter=delimiter, skipinitialspace=delimiter != "\t", strict=True)
    fault = "a quote is not closed on its line"
    try:
        for values in reader:
            fields.append(values)
            if reader.line_num != len(fields):
                raise csv.Error(fault)
    except csv.Error as error:
        first = len(fields) - (str(error) == fault)
        detail = fault if str(error) in (fault, "unexpected end of data") else str(error)
        raise InputError(
            f"The row cannot be split into values: {detail}.",
            expected="values that hold no quotes, or are quoted as a whole, with inner quotes doubled.",
            remedy="Correct the quotes.",
            path=path,
            row=table.rows[first],
        ) from error
    return fields


def _find_number(number: str, body: str, delimiter: str) -> re.Match[str] | None:
    """The first cell that is a number of the given form; the number is group 1."""
    edge = re.escape(delimiter) + '"'
    pattern = rf"(?:^|(?<=[{edge}])) *([+-]?{number}(?:[eE][+-]?\d+)?)(?= *(?:$|[{edge}]))"
    return re.search(pattern, body, re.MULTILINE)
