"""The cells of a table, and accessors whose errors name column, value, row, file and remedy."""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from georef.errors import InputError
from georef.geometry.rigid import Array
from georef.io.declarations import Declared
from georef.io.text import FORMAT_HINT

IntArray = NDArray[np.int64]
_DECIMAL_COMMA = re.compile(r"[+-]?\d+,\d+")


@dataclass(frozen=True, eq=False)
class Table:
    """The cells of a table as stripped text, by column.

    cells: header name in lower case -> N values; header: the names as the file spells them; rows: (N,) line numbers;
    mapping: our name -> name in the file, where the project states one.
    """

    path: Path
    header: tuple[str, ...]
    header_row: int
    cells: Mapping[str, tuple[str, ...]]
    rows: IntArray
    decimal: Literal[".", ","]
    declared: Declared
    mapping: Mapping[str, str]

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def declared_crs(self) -> str | None:
        """The CRS of the leading comments, "EPSG:25832" or "local"; None where they declare none."""
        return self.declared.crs

    def has(self, *names: str) -> bool:
        """Whether all the columns are there."""
        return all(self._key(name) is not None for name in names)

    def require(self, names: Sequence[str], remedy: str = "") -> None:
        """Raise InputError naming the first missing column, the columns there are, and the nearest of them."""
        missing = [name for name in names if not self.has(name)]
        if not missing:
            return
        wanted = self.mapping.get(missing[0], missing[0])
        near = difflib.get_close_matches(wanted.lower(), list(self.cells), n=1, cutoff=0.5)
        spelled = [name for name in self.header if name.lower() in near]
        hint = f"Did you mean {spelled[0]!r}? " if spelled else ""
        example = f'table.columns = {{ {missing[0]} = "{spelled[0] if spelled else "..."}" }}'
        raise InputError(
            f"The table has no column {wanted!r}; its columns are: {', '.join(self.header)}.",
            expected=f"the columns {', '.join(names)}.",
            remedy=remedy or f"{hint}Add or rename the column, or map it in project.toml: {example}.",
            path=self.path,
            row=self.header_row,
        )

    def take(self, indices: Sequence[int] | IntArray) -> Table:
        """The table of some of its items, their rows kept."""
        cells = {name: tuple(values[i] for i in indices) for name, values in self.cells.items()}
        return replace(self, cells=cells, rows=self.rows[np.asarray(indices, dtype=np.int64)])

    def text(self, name: str) -> tuple[str, ...]:
        """The N values of a column, which may be empty. Raises InputError for a missing column."""
        self.require([name])
        return self.cells[self._key(name) or name]

    def ids(self, name: str) -> tuple[str, ...]:
        """The N values of a column, none of them empty."""
        values = self.text(name)
        if "" in values:
            raise self.error(
                values.index(""), f"Column {name!r} is empty.", expected=f"the id of the {name}.", remedy="Fill it in."
            )
        return values

    def unique_ids(self, name: str) -> tuple[str, ...]:
        """The N values of a column, none empty, none twice."""
        values = self.ids(name)
        self.refuse_duplicates(values, lambda i: f"{name.capitalize()} {values[i]!r}")
        return values

    def numbers(self, name: str, *, allow_empty: bool = False) -> Array:
        """A column as finite numbers (N,), float64; NaN for empty cells where they are allowed."""
        values = self.text(name)
        plain = [value.replace(",", ".") for value in values] if self.decimal == "," else values
        usual = not any("_" in v for v in plain) and not (self.decimal == "," and any("." in v for v in values))
        if usual:
            try:
                out = np.fromiter(map(float, plain), dtype=np.float64, count=len(values))
                if np.all(np.isfinite(out)):
                    return out
            except ValueError:
                pass
        return np.array([self._number(i, name, value, allow_empty) for i, value in enumerate(values)], dtype=np.float64)

    def stack(self, names: Sequence[str], *, allow_empty: bool = False) -> Array:
        """Columns as finite numbers (N, len(names)). Raises InputError where one is missing or not a number."""
        self.require(names)
        return np.stack([self.numbers(name, allow_empty=allow_empty) for name in names], axis=1)

    def integers(self, name: str) -> IntArray:
        """A column as whole numbers (N,)."""
        values = self.numbers(name)
        for i in np.flatnonzero(values != np.round(values))[:1]:
            raise self.error(
                int(i), f"Column {name!r} has {values[i]}.", expected="a whole number.", remedy="Correct it."
            )
        return values.astype(np.int64)

    def choices(self, name: str, allowed: Iterable[str], *, allow_empty: bool = False) -> tuple[str, ...]:
        """A column of words in lower case, each one of `allowed`."""
        values, allowed = tuple(value.lower() for value in self.text(name)), tuple(allowed)
        for i, value in enumerate(values):
            if value not in allowed and not (allow_empty and not value):
                near = difflib.get_close_matches(value, allowed, n=1)
                raise self.error(
                    i,
                    f"Column {name!r} has {self.text(name)[i]!r}.",
                    expected=f"one of: {', '.join(allowed)}.",
                    remedy=f"Did you mean {near[0]!r}? Correct the value." if near else "Correct the value.",
                )
        return values

    def refuse_duplicates(self, keys: Sequence[Hashable], subject: Callable[[int], str]) -> None:
        """Raise InputError where a key (one an item) occurs twice, naming both rows."""
        if len(set(keys)) == len(keys):
            return
        first: dict[Hashable, int] = {}
        for i, key in enumerate(keys):
            if key in first:
                raise self.error(
                    i,
                    f"{subject(i)} is listed twice, in rows {self.rows[first[key]]} and {self.rows[i]}.",
                    expected="each one once.",
                    remedy="Delete one of the two rows.",
                )
            first[key] = i

    def error(self, index: int, problem: str, *, expected: str = "", remedy: str = "") -> InputError:
        """The error of an item, with its row and file."""
        return InputError(problem, expected=expected, remedy=remedy, path=self.path, row=int(self.rows[index]))

    def _key(self, name: str) -> str | None:
        candidates = (self.mapping.get(name, name).strip().lower(), name.lower())
        return next((key for key in candidates if key in self.cells), None)

    def _number(self, index: int, name: str, value: str, allow_empty: bool) -> float:
        if not value:
            if allow_empty:
                return math.nan
            raise self.error(index, f"Column {name!r} is empty.", expected="a number.", remedy="Fill it in.")
        try:
            if "_" in value or (self.decimal == "," and "." in value):
                raise ValueError
            number = float(value.replace(",", ".") if self.decimal == "," else value)
        except ValueError:
            sign = "comma" if self.decimal == "," else "point"
            raise self.error(
                index,
                f"Column {name!r} has {value!r}, which is not a number.",
                expected=f"a number with a decimal {sign} and no thousands separators.",
                remedy=f"If its comma is a decimal sign, say so. {FORMAT_HINT}."
                if _DECIMAL_COMMA.fullmatch(value)
                else "Correct the value.",
            ) from None
        if not math.isfinite(number):
            raise self.error(
                index,
                f"Column {name!r} has {value!r}, which is not a finite number.",
                expected="a finite number.",
                remedy="Correct the value, or delete the row if the item was not measured.",
            )
        return number
