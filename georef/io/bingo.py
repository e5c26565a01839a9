"""Image measurements in the BINGO format, as bundle programs and Pix4D export them.

Each image is a header, its name and optionally that of its camera, then one row a point, `point x y`, and a row `-99`.
x (right) and y (up) are millimetres on the sensor from the centre of the image, as measured: lens distortion included.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from georef.errors import InputError
from georef.geometry.rigid import Array
from georef.io.files import read_text, write_text_atomically
from georef.io.table import IntArray

_END = "-99"
_SENSOR = re.compile(r"H_(\d+(?:\.\d*)?)_(\d+(?:\.\d*)?)")
_ROW = "a header (image, camera), rows `point x y` in mm, and a row -99 after each image."


@dataclass(frozen=True, eq=False)
class BingoTable:
    """n image measurements of P points in M images, in the order of the file.

    Files of Pix4D's own format, which are written alike, have pixels from the top-left corner, x right and y down.
    """

    path: Path
    image_ids: tuple[str, ...]  # M
    cameras: tuple[str, ...]  # M, as the headers name them; empty where they do not
    image_rows: IntArray  # (M,) line numbers of the headers
    point_ids: tuple[str, ...]  # P, in the order of their first measurement
    image: IntArray  # (n,)
    point: IntArray  # (n,)
    xy_mm: Array  # (n, 2) right, up; pixels right, down where `in_pixels`
    rows: IntArray  # (n,) line numbers
    in_pixels: bool = False

    def __len__(self) -> int:
        return len(self.image)


def read_bingo(path: Path | str) -> BingoTable:
    """Reads a file of BINGO image measurements.

    Raises InputError, with the row, for text that is not of the format, values that are not numbers, images that
    occur twice, points that an image lists twice, and images that nothing ends.
    """
    return read_measurements(path, _ROW, 3)


def read_measurements(path: Path | str, described: str, columns: int, *, in_pixels: bool = False) -> BingoTable:
    """A file of image measurements, of which a row has some columns: point, x, y, and what is not read."""
    path = Path(path)
    headers, names, values, rows, image = _split(read_text(path), path, described, columns)
    index: dict[str, int] = {}
    point = np.fromiter((index.setdefault(name, len(index)) for name in names), np.int64, len(names))
    table = BingoTable(
        path=path,
        image_ids=tuple(words[0] for words, _ in headers),
        cameras=tuple(" ".join(words[1:]) for words, _ in headers),
        image_rows=np.array([row for _, row in headers], dtype=np.int64),
        point_ids=tuple(index),
        image=np.array(image, dtype=np.int64),
        point=point,
        xy_mm=_numbers(values, rows, path, described).reshape(-1, 2),
        rows=np.array(rows, dtype=np.int64),
        in_pixels=in_pixels,
    )
    _refuse_repeats(table)
    return table


def write_bingo(table: BingoTable, path: Path | str) -> None:
    """Writes image measurements, to 1e-5 mm as usual, in the order of the images."""
    order = np.argsort(table.image, kind="stable")
    starts = np.searchsorted(table.image[order], np.arange(len(table.image_ids) + 1))
    lines: list[str] = []
    for index, name in enumerate(table.image_ids):
        lines.append(f"{name} {table.cameras[index]}".rstrip())
        rows = order[starts[index] : starts[index + 1]]
        lines += [f"{table.point_ids[table.point[i]]} {table.xy_mm[i, 0]:.5f} {table.xy_mm[i, 1]:.5f}" for i in rows]
        lines.append(_END)
    write_text_atomically("\n".join(lines) + "\n", path)


def sensor_of_header(camera: str) -> tuple[float, float] | None:
    """Width and height (mm) of the sensor, where the header of an image states it as Pix4D does: H_35.0_23.3."""
    found = _SENSOR.fullmatch(camera)
    if found is None:
        return None
    width, height = (float(value) for value in found.groups())
    return (width, height) if min(width, height) > 0 else None


def pixels_from_mm(xy_mm: ArrayLike, size: tuple[int, int], sensor_mm: Sequence[float]) -> Array:
    """Pixels (n, 2) of the house from positions (n, 2) in mm from the image centre, x right and y up.

    size: width and height in pixels of the image that `sensor_mm` (width, height) of the sensor shows.
    """
    xy, (width, height) = np.asarray(xy_mm, dtype=np.float64), size
    return np.stack(
        [width / 2.0 + xy[..., 0] * (width / sensor_mm[0]), height / 2.0 - xy[..., 1] * (height / sensor_mm[1])],
        axis=-1,
    )


def mm_from_pixels(pixels: ArrayLike, size: tuple[int, int], sensor_mm: Sequence[float]) -> Array:
    """The inverse of `pixels_from_mm`."""
    px, (width, height) = np.asarray(pixels, dtype=np.float64), size
    return np.stack(
        [(px[..., 0] - width / 2.0) * (sensor_mm[0] / width), (height / 2.0 - px[..., 1]) * (sensor_mm[1] / height)],
        axis=-1,
    )


_Header = tuple[list[str], int]


def _split(
    text: str, path: Path, described: str, columns: int
) -> tuple[list[_Header], list[str], list[str], list[int], list[int]]:
    """Headers with their rows; ids, coordinates (flat), rows and image indices of the measurements."""
    headers: list[_Header] = []
    names: list[str] = []
    values: list[str] = []
    rows: list[int] = []
    image: list[int] = []
    inside = False
    for row, line in enumerate(text.split("\n"), start=1):
        words = line.split()
        if not words:
            continue
        if words[0] == _END and len(words) == 1:
            if not inside:
                raise _error("An end of an image, and no image has begun.", "Delete the row.", path, row, described)
            inside = False
        elif not inside:
            headers.append((words, row))
            inside = True
        elif len(words) == columns:
            names.append(words[0])
            values += words[1:3]
            rows.append(row)
            image.append(len(headers) - 1)
        else:
            problem = f"The row has {len(words)} values: {line.strip()[:60]!r}."
            raise _error(
                problem, f"Correct it; if a new image begins here, add the row {_END} above it.", path, row, described
            )
    if not headers:
        raise _error("The file is empty.", "Export the image measurements again.", path, None, described)
    if inside:
        name, row = headers[-1][0][0], headers[-1][1]
        raise _error(f"Nothing ends image {name!r}: the file is cut off.", "Export it again.", path, row, described)
    return headers, names, values, rows, image


def _numbers(values: list[str], rows: list[int], path: Path, described: str) -> Array:
    """All coordinates (2 n,) as finite numbers."""
    try:
        numbers = np.array(values, dtype=np.float64)
        if np.isfinite(numbers).all():
            return numbers
    except ValueError:
        pass
    for i, text in enumerate(values):
        try:
            if np.isfinite(float(text)):
                continue
        except ValueError:
            pass
        raise _error(
            f"{'xy'[i % 2]} is {text!r}, not a finite number.", "Correct the value.", path, rows[i // 2], described
        )
    raise AssertionError("each number can be read")


def _refuse_repeats(table: BingoTable) -> None:
    first: dict[str, int] = {}
    for i, name in enumerate(table.image_ids):
        if name in first:
            problem = f"Image {name!r} begins twice, in rows {table.image_rows[first[name]]} and {table.image_rows[i]}."
            raise _error(problem, "Delete one of them.", table.path, int(table.image_rows[i]))
        first[name] = i
    key = table.image * len(table.point_ids) + table.point
    order = np.argsort(key, kind="stable")
    again = np.flatnonzero(np.diff(key[order]) == 0)
    if len(again):
        a, b = order[again[0]], order[again[0] + 1]
        image, point = table.image_ids[table.image[b]], table.point_ids[table.point[b]]
        problem = f"Point {point!r} is measured twice in image {image!r}, in rows {table.rows[a]} and {table.rows[b]}."
        raise _error(problem, "Delete the wrong one.", table.path, int(table.rows[b]))


def _error(problem: str, remedy: str, path: Path, row: int | None, described: str = _ROW) -> InputError:
    return InputError(problem, expected=described, remedy=remedy, path=path, row=row)
