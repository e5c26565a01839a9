"""Tables of cameras: size, focal lengths, principal point and distortion, all in pixels."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from georef.geometry.camera import Camera
from georef.geometry.rigid import Array
from georef.io.tables import Table, TableFormat, read_table

CAMERA_COLUMNS = ("camera", "width", "height", "fx", "fy", "cx", "cy")
DISTORTION_COLUMNS = ("k1", "k2", "p1", "p2")
_UNSUPPORTED = ("k3", "k4", "k5", "k6", "p3", "p4", "b1", "b2", "skew")
_SHORTEST_FOCAL = 0.1  # of the longer side: a view of 157 degrees, beyond what these camera models describe


def read_cameras(
    path: Path | str, *, columns: Mapping[str, str] | None = None, table_format: TableFormat | None = None
) -> dict[str, Camera]:
    """Read camera, width, height, fx, fy, cx, cy and optionally k1, k2, p1, p2 -> camera id: Camera.

    Pixels; the centre of the top-left pixel is (0.5, 0.5). Raises InputError for columns that are missing, values
    that cannot be (sizes, focal lengths, a principal point outside the image), distortion terms that the model does
    not have, and cameras that are listed twice.
    """
    table = read_table(path, columns=columns, table_format=table_format)
    table.require(CAMERA_COLUMNS)
    ids = table.unique_ids("camera")
    sizes = np.stack([table.integers("width"), table.integers("height")], axis=1)
    focal, principal = table.stack(("fx", "fy")), table.stack(("cx", "cy"))
    _refuse_unsupported(table)
    _check_sizes(table, ids, sizes)
    _check_focal_lengths(table, ids, sizes, focal)
    _check_principal_points(table, ids, sizes, principal)
    distortion = _distortion(table)
    return {
        camera_id: Camera(
            camera_id,
            int(sizes[i, 0]),
            int(sizes[i, 1]),
            *map(float, (*focal[i], *principal[i])),
            distortion=tuple(map(float, distortion[i])) if np.any(distortion[i]) else (),
        )
        for i, camera_id in enumerate(ids)
    }


def _distortion(table: Table) -> Array:
    zeros = np.zeros(len(table))
    return np.stack([table.numbers(name) if table.has(name) else zeros for name in DISTORTION_COLUMNS], axis=1)


def _refuse_unsupported(table: Table) -> None:
    for name in _UNSUPPORTED:
        values = np.nan_to_num(table.numbers(name, allow_empty=True)) if table.has(name) else np.zeros(0)
        for i in np.flatnonzero(values)[:1]:
            raise table.error(
                int(i),
                f"Column {name!r} has {values[i]}, which the camera model here does not have.",
                expected="no distortion, or the brown model with k1, k2, p1, p2.",
                remedy=f"Calibrate with {name} fixed at 0, or undistort the images and leave distortion out.",
            )


def _check_sizes(table: Table, ids: tuple[str, ...], sizes: np.ndarray) -> None:
    for i, k in np.argwhere(sizes <= 0)[:1]:
        raise table.error(
            int(i),
            f"Camera {ids[i]!r} has {('width', 'height')[k]} = {sizes[i, k]}.",
            expected="the size of the full image in pixels.",
            remedy="Correct the value.",
        )


def _check_focal_lengths(table: Table, ids: tuple[str, ...], sizes: np.ndarray, focal: Array) -> None:
    shortest = _SHORTEST_FOCAL * sizes.max(axis=1, keepdims=True)
    for i, k in np.argwhere(focal < shortest)[:1]:
        value = float(focal[i, k])
        remedy = "Correct the value."
        if value > 0:
            remedy = "If it is in millimetres, multiply it by width / sensor width in millimetres."
        raise table.error(
            int(i),
            f"Camera {ids[i]!r} has {('fx', 'fy')[k]} = {value} for an image of {sizes[i, 0]} x {sizes[i, 1]}.",
            expected=f"a focal length in pixels, at least {float(shortest[i, 0]):g}.",
            remedy=remedy,
        )


def _check_principal_points(table: Table, ids: tuple[str, ...], sizes: np.ndarray, principal: Array) -> None:
    for i, k in np.argwhere((principal < 0) | (principal > sizes))[:1]:
        raise table.error(
            int(i),
            f"Camera {ids[i]!r} has {('cx', 'cy')[k]} = {principal[i, k]}, outside its image of "
            f"{sizes[i, 0]} x {sizes[i, 1]}.",
            expected="pixels from the top-left corner of the image, near its centre.",
            remedy="Add half the size if the value counts from the image centre; convert it if it is in millimetres.",
        )
