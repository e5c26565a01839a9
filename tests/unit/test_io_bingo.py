"""Image measurements in the BINGO format."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from georef.errors import InputError
from georef.io.bingo import BingoTable, mm_from_pixels, pixels_from_mm, read_bingo, write_bingo

_GOOD = """first camera A
7 1.5 -2.25
GCP_9 0 3e0
-99

second
 9   -1.0  2
7 0.25 0.5
-99
"""


def _written(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "points.txt"
    path.write_text(text, encoding="utf-8")
    return path


def test_images_points_and_rows_are_read(tmp_path: Path) -> None:
    table = read_bingo(_written(tmp_path, _GOOD))
    assert table.image_ids == ("first", "second")
    assert table.cameras == ("camera A", "")
    assert table.point_ids == ("7", "GCP_9", "9")
    assert table.image.tolist() == [0, 0, 1, 1]
    assert table.point.tolist() == [0, 1, 2, 0]
    assert table.xy_mm.tolist() == [[1.5, -2.25], [0.0, 3.0], [-1.0, 2.0], [0.25, 0.5]]
    assert table.rows.tolist() == [2, 3, 7, 8]
    assert table.image_rows.tolist() == [1, 6]


def test_what_is_written_is_read_again(tmp_path: Path) -> None:
    table = read_bingo(_written(tmp_path, _GOOD))
    mixed = replace(table, image=table.image[::-1], point=table.point[::-1], xy_mm=table.xy_mm[::-1])
    write_bingo(mixed, tmp_path / "again.txt")
    again = read_bingo(tmp_path / "again.txt")
    assert _by_name(again) == _by_name(table)
    assert again.cameras == table.cameras


def _by_name(table: BingoTable) -> dict[tuple[str, str], tuple[float, float]]:
    measured = zip(table.image, table.point, table.xy_mm.tolist(), strict=True)
    return {(table.image_ids[i], table.point_ids[p]): (x, y) for i, p, (x, y) in measured}


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("7 1.5 -2.25", "7 1.5", "The row has 2 values"),
        ("-99\n\nsecond", "\nsecond camera B", "x is 'camera', not a finite number"),
        ("-99\n\nsecond", "\nsecond", "The row has 1 values"),
        ("7 1.5", "7 1,5", "x is '1,5', not a finite number"),
        ("0 3e0", "0 nan", "y is 'nan', not a finite number"),
        ("GCP_9", "7", "Point '7' is measured twice in image 'first', in rows 2 and 3"),
        ("second", "first", "Image 'first' begins twice, in rows 1 and 6"),
        ("first camera", "-99\nfirst camera", "An end of an image, and no image has begun"),
    ],
)
def test_what_cannot_be_is_refused_with_its_row(tmp_path: Path, old: str, new: str, said: str) -> None:
    assert old in _GOOD
    path = _written(tmp_path, _GOOD.replace(old, new, 1))
    with pytest.raises(InputError, match=said) as caught:
        read_bingo(path)
    assert caught.value.row is not None
    assert str(path) in str(caught.value)


def test_a_file_that_is_cut_off_or_empty_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="Nothing ends image 'second'"):
        read_bingo(_written(tmp_path, _GOOD.rstrip().removesuffix("-99")))
    with pytest.raises(InputError, match="The file is empty"):
        read_bingo(_written(tmp_path, "\n\n"))


def test_pixels_count_from_the_top_left_corner() -> None:
    size, sensor = (8000, 4000), (40.0, 20.0)  # 5 micrometres
    corners = pixels_from_mm([[-20.0, 10.0], [20.0, -10.0], [0.0, 0.0], [-19.9975, 9.9975]], size, sensor)
    assert corners == pytest.approx(np.array([[0, 0], [8000, 4000], [4000, 2000], [0.5, 0.5]]), abs=1e-9)
    xy = np.random.default_rng(0).uniform(-10, 10, (20, 2))
    assert mm_from_pixels(pixels_from_mm(xy, size, sensor), size, sensor) == pytest.approx(xy, abs=1e-12)


def test_a_hundred_thousand_rows_take_less_than_two_seconds(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    images = []
    for i in range(500):
        points = rng.choice(20_000, 200, replace=False)
        xy = rng.uniform(-10, 10, (200, 2))
        images += [f"image{i} camera", *(f"{p} {x:.5f} {y:.5f}" for p, (x, y) in zip(points, xy, strict=True)), "-99"]
    path = _written(tmp_path, "\n".join(images))
    start = time.process_time()
    assert len(read_bingo(path)) == 100_000
    assert time.process_time() - start < 2.0
