"""Tables of the pinhole heads that are cut from panoramas."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from georef.geometry.camera import Camera
from georef.geometry.panorama import PanoramaHead, head_pose
from georef.io.tables import Table, TableFormat, read_table

_SIZE, _INTERIOR = ("width", "height"), ("fx", "fy", "cx", "cy")
_ANGLES, _POSITION = ("yaw", "pitch", "roll"), ("x", "y", "z")
_FARTHEST_SHARE = 0.5  # of the radius of stitching: heads beyond it are no part of the panorama


def read_heads(
    path: Path | str,
    *,
    stitching_radius_m: float | None = None,
    columns: Mapping[str, str] | None = None,
    table_format: TableFormat | None = None,
) -> tuple[PanoramaHead, ...]:
    """Read head, width, height, fx (px), yaw, and optionally fy, cx, cy (px), pitch, roll (deg), x, y, z (m).

    Angles and positions are against the middle of the panorama: yaw clockwise, pitch up, roll clockwise; x right, y
    down, z forward. fy is fx, cx and cy the middle of the head, the rest zero where there is no such column. Raises
    InputError for columns that are missing, values that cannot be, heads listed twice, and positions without the
    radius of the sphere onto which the panorama was stitched.
    """
    table = read_table(path, columns=columns, table_format=table_format)
    table.require(("head", *_SIZE, "fx", "yaw"))
    names = table.unique_ids("head")
    _check_names(table, names)
    sizes = np.stack([table.integers(name) for name in _SIZE], axis=1)
    interior = _interior(table, sizes)
    angles = np.radians(np.stack([_optional(table, name) for name in _ANGLES], axis=1))
    positions = np.stack([_optional(table, name) for name in _POSITION], axis=1)
    _check(table, names, sizes, interior)
    _check_positions(table, names, positions, stitching_radius_m)
    return tuple(
        PanoramaHead(
            name,
            _pinhole(name, sizes[i], interior[i]),
            head_pose(angles[i], positions[i]),
            np.inf if stitching_radius_m is None else stitching_radius_m,
        )
        for i, name in enumerate(names)
    )


def _pinhole(name: str, size: np.ndarray, interior: np.ndarray) -> Camera:
    fx, fy, cx, cy = (float(v) for v in interior)
    return Camera(name, int(size[0]), int(size[1]), fx, fy, cx, cy)


def _optional(table: Table, name: str) -> np.ndarray:
    return table.numbers(name) if table.has(name) else np.zeros(len(table))


def _interior(table: Table, sizes: np.ndarray) -> np.ndarray:
    defaults = {"fy": table.numbers("fx"), "cx": sizes[:, 0] / 2.0, "cy": sizes[:, 1] / 2.0}
    return np.stack([table.numbers(name) if table.has(name) else defaults[name] for name in _INTERIOR], axis=1)


def _check_names(table: Table, names: tuple[str, ...]) -> None:
    for i, name in enumerate(names):
        if "/" in name or "\\" in name or name.startswith("."):
            raise table.error(
                i,
                f"The head {name!r} cannot be part of an image's name.",
                expected="letters, digits and the like.",
                remedy="Rename it.",
            )


def _check(table: Table, names: tuple[str, ...], sizes: np.ndarray, interior: np.ndarray) -> None:
    for i, k in np.argwhere(sizes <= 0)[:1]:
        raise table.error(
            int(i),
            f"Head {names[i]!r} has {_SIZE[k]} = {sizes[i, k]}.",
            expected="the size in pixels of the picture that is to be cut.",
            remedy="Correct the value.",
        )
    for i, k in np.argwhere(interior[:, :2] < 0.1 * sizes.max(axis=1, keepdims=True))[:1]:
        raise table.error(
            int(i),
            f"Head {names[i]!r} has {_INTERIOR[k]} = {interior[i, k]} for a picture of {sizes[i, 0]} x {sizes[i, 1]}.",
            expected="a focal length in pixels; half the width is a view of 90 degrees.",
            remedy="Correct the value.",
        )


def _check_positions(table: Table, names: tuple[str, ...], positions: np.ndarray, radius_m: float | None) -> None:
    distances = np.linalg.norm(positions, axis=1)
    for i in np.flatnonzero(distances > 0)[:1]:
        if radius_m is None:
            raise table.error(
                int(i),
                f"Head {names[i]!r} stands {distances[i]:.3f} m from the panorama's origin, and nothing says how the "
                "panorama was stitched.",
                expected="the radius of the sphere that the pictures were projected to, as the stitching software "
                "states it.",
                remedy="Set panorama.stitching_radius_m in the epoch's section of project.toml, or leave x, y, z out.",
            )
    for i in np.flatnonzero(distances > _FARTHEST_SHARE * (radius_m or np.inf))[:1]:
        raise table.error(
            int(i),
            f"Head {names[i]!r} stands {distances[i]:g} m from the origin of a sphere of {radius_m:g} m.",
            expected="positions in metres, well inside the sphere.",
            remedy="Correct x, y, z, or panorama.stitching_radius_m.",
        )
