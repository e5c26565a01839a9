"""Image measurements in Pix4D's own format (`*_tp_pix4d.txt`).

Each image is its name, then one row a point, `point x y scale`, and a row `-99`. x (right) and y (down) are pixels of
the photograph from its top-left corner, lens distortion included; scale is the size at which the keypoint was found.
"""

from __future__ import annotations

from pathlib import Path

from georef.io.bingo import BingoTable, read_measurements
from georef.io.files import write_text_atomically

_ROW = "the name of an image, rows `point x y scale` in pixels, and a row -99 after each image."


def read_pix4d_ties(path: Path | str) -> BingoTable:
    """Reads a file of image measurements by Pix4D. Raises InputError with the row, as `read_bingo` does."""
    return read_measurements(path, _ROW, 4, in_pixels=True)


def write_pix4d_ties(table: BingoTable, path: Path | str) -> None:
    """Writes image measurements that are in pixels, in the order of the images, with a scale of 1."""
    lines: list[str] = []
    for index, name in enumerate(table.image_ids):
        lines.append(name)
        lines += [
            f"{table.point_ids[table.point[i]]} {table.xy_mm[i, 0]:.4f} {table.xy_mm[i, 1]:.4f} 1.0"
            for i in range(len(table))
            if table.image[i] == index
        ]
        lines.append("-99")
    write_text_atomically("\n".join(lines) + "\n", path)
