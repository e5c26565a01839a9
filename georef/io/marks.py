"""Image measurements (marks) of control and check points."""

from __future__ import annotations

import logging
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from georef.errors import InputError
from georef.geometry.rigid import Array
from georef.io.columns import read_sigmas
from georef.io.tables import IntArray, TableFormat, read_table

log = logging.getLogger(__name__)

Repeats = Literal["refuse", "mean"]
_ROWS_TO_NAME = 10
_AGREE_SIGMAS = 3.0


@dataclass(frozen=True, eq=False)
class MarkTable:
    """N image measurements: observed (distorted) full-resolution pixels; the top-left pixel's centre is (0.5, 0.5)."""

    path: Path
    rows: IntArray  # (N,) line numbers
    point_ids: tuple[str, ...]
    image_ids: tuple[str, ...]
    pixels: Array  # (N, 2)
    sigmas_px: Array  # (N,)

    def __len__(self) -> int:
        return len(self.rows)


def read_marks(
    path: Path | str,
    *,
    repeats: Repeats = "refuse",
    columns: Mapping[str, str] | None = None,
    table_format: TableFormat | None = None,
) -> MarkTable:
    """Read point, image, x, y (px), sigma_px (px, both axes).

    A point that is marked more than once in an image is refused, or with repeats="mean" becomes one mark at the mean
    (the largest sigma kept, the first row; logged) where its marks agree. Raises InputError for repeats, columns that
    are missing, values that cannot be and sigmas that are not positive.
    """
    table = read_table(path, columns=columns, table_format=table_format)
    table.require(("point", "image", "x", "y", "sigma_px"))
    point_ids, image_ids = table.ids("point"), table.ids("image")
    keys = list(zip(point_ids, image_ids, strict=True))

    def subject(i: int) -> str:
        return f"The mark of point {point_ids[i]!r} in image {image_ids[i]!r}"

    if repeats == "refuse":
        table.refuse_duplicates(keys, subject)
    expected = "a positive standard deviation in pixels (0.2 to 2)."
    sigmas_px = read_sigmas(table, ("sigma_px",), subject, expected=expected)[:, 0]
    marks = MarkTable(table.path, table.rows, point_ids, image_ids, table.stack(("x", "y")), sigmas_px)
    return marks if len(set(keys)) == len(keys) else _merged(marks, keys)


def check_marks(marks: MarkTable, point_ids: Collection[str], image_sizes: Mapping[str, tuple[int, int]]) -> None:
    """Raise InputError for marks of unknown points, in unknown images, or outside their image, naming their rows.

    point_ids: those of the point table; image_sizes: (width, height) in pixels of the images of the epoch.
    """
    known_points = set(point_ids)
    _refuse(
        marks,
        np.array([point not in known_points for point in marks.point_ids], dtype=bool),
        lambda i: f"Point {marks.point_ids[i]!r} is marked and has no coordinates.",
        "a point that the table of points lists.",
        "Add the point to that table, correct its name, or delete its marks.",
    )
    _refuse(
        marks,
        np.array([image not in image_sizes for image in marks.image_ids], dtype=bool),
        lambda i: f"Image {marks.image_ids[i]!r} has a mark and is not in the epoch.",
        "an image of the epoch that the marks belong to.",
        "Correct the name of the image, name the table under the right epoch in project.toml, or delete the row.",
    )
    sizes = np.array([image_sizes[image] for image in marks.image_ids], dtype=float).reshape(-1, 2)
    _refuse(
        marks,
        np.any((marks.pixels < 0) | (marks.pixels > sizes), axis=1),
        lambda i: (
            f"The mark of point {marks.point_ids[i]!r} at ({marks.pixels[i, 0]}, {marks.pixels[i, 1]}) lies outside "
            f"image {marks.image_ids[i]!r}, which has {sizes[i, 0]:g} x {sizes[i, 1]:g} pixels."
        ),
        "pixels x (right) and y (down) from the top-left corner of the full-resolution image.",
        "Correct the mark; check for swapped x and y, and for marks on a resized image.",
    )


def _merged(marks: MarkTable, keys: list[tuple[str, str]]) -> MarkTable:
    """One mark a key, at the mean. Raises InputError where a mark is too far from the mean of its key."""
    firsts = list(dict.fromkeys(keys))
    index = {key: g for g, key in enumerate(firsts)}
    group = np.array([index[key] for key in keys])
    sums = np.zeros((len(firsts), 2))
    np.add.at(sums, group, marks.pixels)
    means = sums / np.bincount(group)[:, None]
    apart = np.linalg.norm(marks.pixels - means[group], axis=1)
    _refuse(
        marks,
        apart > _AGREE_SIGMAS * marks.sigmas_px,
        lambda i: (
            f"Point {marks.point_ids[i]!r} is marked more than once in image {marks.image_ids[i]!r}, "
            f"{apart[i]:.2f} px from the mean."
        ),
        f"repeated marks within {_AGREE_SIGMAS:g} sigma_px of their mean.",
        "Delete the wrong mark.",
    )
    sigmas = np.zeros(len(firsts))
    np.maximum.at(sigmas, group, marks.sigmas_px)
    rows = marks.rows[np.unique(group, return_index=True)[1]]
    log.warning("%s: %d repeated marks, each set replaced by its mean", marks.path, len(keys) - len(firsts))
    point_ids, image_ids = zip(*firsts, strict=True)
    return MarkTable(marks.path, rows, point_ids, image_ids, means, sigmas)


def _refuse(marks: MarkTable, faulty: np.ndarray, problem: Callable[[int], str], expected: str, remedy: str) -> None:
    rows = marks.rows[faulty]
    if len(rows) == 0:
        return
    others = ", ".join(map(str, rows[1:_ROWS_TO_NAME])) + (", ..." if len(rows) > _ROWS_TO_NAME else "")
    more = f" The same is wrong in {len(rows) - 1} more: rows {others}." if others else ""
    first = int(np.flatnonzero(faulty)[0])
    raise InputError(problem(first) + more, expected=expected, remedy=remedy, path=marks.path, row=int(rows[0]))
