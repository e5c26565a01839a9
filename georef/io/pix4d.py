"""Parameters that Pix4D exports: poses and cameras as calibrated, the internal camera, ground control, the offset.

Pix4D takes the projected grid for a metric frame, and writes coordinates in it less the offset. Its cameras are those
of the house: x right, y down, z forward, pixels counted from the top-left corner of the image, distortion as in the
model `brown` (R1, R2, R3 = k1, k2, k3; T1, T2 = p1, p2). Angles are omega-phi-kappa in degrees.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from georef.errors import InputError
from georef.geometry.camera import Camera
from georef.geometry.rigid import Array
from georef.io.columns import CrsKind
from georef.io.exterior_orientation import ExteriorOrientationTable, read_exterior_orientation
from georef.io.files import read_text
from georef.io.gnss import GnssTable, read_gnss
from georef.io.tables import read_table

POSE_COLUMNS = {
    "image": "imageName",
    "camera": "cameraName",
    "easting": "X",
    "northing": "Y",
    "height": "Z",
    "omega": "Omega",
    "phi": "Phi",
    "kappa": "Kappa",
}
"""Of `*_calibrated_external_camera_parameters.txt`."""

ADJUSTED_COLUMNS = POSE_COLUMNS | {
    "easting": "X_opt",
    "northing": "Y_opt",
    "height": "Z_opt",
    "sigma_e": "X_uncertainty",
    "sigma_n": "Y_uncertainty",
    "sigma_h": "Z_uncertainty",
    **{f"sigma_{name}": f"{name.capitalize()}_uncertainty" for name in ("omega", "phi", "kappa")},
}
"""Poses as adjusted, of `*_calibrated_external_camera_parameters_error.txt`."""

GIVEN_COLUMNS = POSE_COLUMNS | {
    "easting": "X_gps",
    "northing": "Y_gps",
    "height": "Z_gps",
    "sigma_e": "X_acc",
    "sigma_n": "Y_acc",
    "sigma_h": "Z_acc",
}
"""Positions as measured, of the same file."""

_HEADER_LINES = ("fileName imageWidth imageHeight", "radial distortion [3x1]", "tangential distortion [2x1]")
_LINES, _IMAGE_LINES = 8, 10  # of the header, and of each image: name, K (3), radial, tangential, t, R (3)
_NUMBERS_OF_LINE = (3, 3, 3, 3, 2, 3, 3, 3, 3)
_CAMERA_TITLE = re.compile(r"Pix4D camera calibration file", re.IGNORECASE)
_CAMERA_KEYS = ("F", "Px", "Py", "K1", "K2", "K3", "T1", "T2")


@dataclass(frozen=True, eq=False)
class Pix4dPoses:
    """N images as Pix4D calibrated them, in the grid less its offset."""

    path: Path
    image_ids: tuple[str, ...]
    cameras: tuple[Camera, ...]  # N, of model brown; equal ones are one object
    positions: Array  # (N, 3) m
    cam_from_grid: Array  # (N, 3, 3)


def read_pix4d_poses(path: Path | str) -> Pix4dPoses:
    """Reads `*_calibrated_camera_parameters.txt`. Raises InputError with the row."""
    path = Path(path)
    lines = [line.strip() for line in read_text(path).split("\n")]
    head, start = lines[: _LINES + 1], _first_image(lines)
    if not set(_HEADER_LINES) <= set(head):
        raise InputError(
            "The file does not begin as Pix4D's calibrated parameters of perspective cameras do.",
            expected=f"the header lines {', '.join(repr(line) for line in _HEADER_LINES)}.",
            remedy="Name the file *_calibrated_camera_parameters.txt; fisheye cameras of Pix4D are not read.",
            path=path,
        )
    rows = [i for i in range(start, len(lines)) if lines[i]]
    blocks = [rows[i : i + _IMAGE_LINES] for i in range(0, len(rows), _IMAGE_LINES)]
    known: dict[Camera, Camera] = {}
    names, cameras, positions, rotations = [], [], [], []
    for block in blocks:
        name, size, values = _image(lines, block, path)
        k, radial, tangential = values[:9], values[9:12], values[12:14]
        fx, cx, fy, cy = (float(k[i]) for i in (0, 2, 4, 5))
        distortion = tuple(float(v) for v in (*radial[:2], *tangential, radial[2]))
        camera = Camera("pix4d", *size, fx, fy, cx, cy, distortion, "brown")
        names.append(name)
        cameras.append(known.setdefault(camera, camera))
        positions.append(values[14:17])
        rotations.append(values[17:26].reshape(3, 3))
    return Pix4dPoses(
        path, tuple(names), tuple(cameras), np.array(positions).reshape(-1, 3), np.array(rotations).reshape(-1, 3, 3)
    )


def read_pix4d_adjusted(path: Path | str, *, crs_kind: CrsKind = "projected") -> ExteriorOrientationTable:
    """Poses with their sigmas of `*_calibrated_external_camera_parameters_error.txt`. Raises InputError."""
    return read_exterior_orientation(
        path, crs_kind=crs_kind, angles="omega-phi-kappa", angle_unit="deg", columns=ADJUSTED_COLUMNS
    )


def read_pix4d_given(path: Path | str, *, crs_kind: CrsKind = "projected") -> GnssTable:
    """Positions as measured, of the same file. Raises InputError."""
    return read_gnss(path, crs_kind=crs_kind, columns=GIVEN_COLUMNS)


def read_pix4d_camera(path: Path | str, size: tuple[int, int]) -> Camera:
    """The only camera of `*_pix4d_calibrated_internal_camera_parameters.cam`, whose millimetres a size (px) turns to
    pixels. Raises InputError, also where the file holds several cameras."""
    cameras = read_pix4d_cameras(path, [size])
    return cameras[0]


def read_pix4d_cameras(path: Path | str, sizes: Sequence[tuple[int, int]]) -> tuple[Camera, ...]:
    """The cameras of `*_pix4d_calibrated_internal_camera_parameters.cam`, in its order; sizes (px) of their images.

    Each begins with a line `Pix4D camera calibration file`. Raises InputError, also where their number is another.
    """
    path = Path(path)
    lines = read_text(path).split("\n")
    starts = [i for i, line in enumerate(lines) if _CAMERA_TITLE.match(line.strip())] or [0]
    if len(starts) != len(sizes):
        raise InputError(
            f"The camera file holds {len(starts)} cameras where {len(sizes)} are expected.",
            expected="one section `Pix4D camera calibration file` for each camera that is compared.",
            remedy="Name the cameras in the order of the file, or a file of one camera for each.",
            path=path,
        )
    ends = [*starts[1:], len(lines)]
    return tuple(_camera(lines, *span, path) for span in zip(starts, ends, sizes, strict=True))


def _camera(lines: list[str], start: int, end: int, size: tuple[int, int], path: Path) -> Camera:
    """The camera of the lines from start to end."""
    width = re.search(r"sensor width of\s+([\d.]+)\s*x", "\n".join(lines[start:end]))
    values: dict[str, float] = {}
    for row, line in enumerate(lines[start:end], start=start + 1):
        words = line.split()
        if len(words) == 2 and words[0] in _CAMERA_KEYS:
            values[words[0]] = _number(words[1], path, row)
    missing = [key for key in _CAMERA_KEYS if key not in values]
    if width is None or missing:
        what = f"no value of {missing[0]}" if missing else "no width of the sensor"
        raise InputError(
            f"The camera file has {what}.",
            expected=f"a comment 'Focal Length mm assuming a sensor width of ...', and {', '.join(_CAMERA_KEYS)}.",
            remedy="Name the file *_pix4d_calibrated_internal_camera_parameters.cam.",
            path=path,
        )
    to_px = size[0] / float(width[1])
    focal, cx, cy = (values[key] * to_px for key in ("F", "Px", "Py"))
    distortion = tuple(values[key] for key in ("K1", "K2", "T1", "T2", "K3"))
    return Camera("pix4d", *size, focal, focal, cx, cy, distortion, "brown")


def read_pix4d_offset(path: Path | str) -> Array:
    """The offset (3,) in metres of `*_offset.xyz`. Raises InputError."""
    path = Path(path)
    words = read_text(path).split()
    if len(words) != 3:
        raise InputError(f"The file holds {len(words)} values.", expected="the three of an offset, in m.", path=path)
    return np.array([_number(word, path, 1) for word in words])


@dataclass(frozen=True, eq=False)
class Pix4dGcps:
    """N ground control points, in the CRS."""

    path: Path
    point_ids: tuple[str, ...]
    measured: Array  # (N, 3) as surveyed; NaN where Pix4D writes zeros, for points without coordinates
    estimated: Array  # (N, 3) as adjusted
    images: Array  # (N,) that show it


def read_pix4d_gcps(path: Path | str) -> Pix4dGcps:
    """Reads `*_measured_estimated_gcps_position.txt`. Raises InputError."""
    table = read_table(path)
    measured, estimated = (table.stack([f"GCP {what} {axis}" for axis in "XYZ"]) for what in ("measured", "estimated"))
    measured[(measured == 0).all(axis=1)] = np.nan
    return Pix4dGcps(
        table.path, table.unique_ids("GCP label"), measured, estimated, table.numbers("GCP visible in # images")
    )


def read_pix4d_correlations(path: Path | str) -> tuple[tuple[str, ...], Array]:
    """Names of the parameters of a camera and their correlations (q, q), of `*_result_correlations_internals.csv`."""
    path = Path(path)
    lines = [line for line in read_text(path).split("\n") if line.strip()]
    names = tuple(word.strip() for word in lines[2].split(",")) if len(lines) > 2 else ()
    rows = [[_number(word, path, row) for word in line.split(",")] for row, line in enumerate(lines[3:], start=4)]
    if not names or [len(row) for row in rows] != [len(names)] * len(names):
        raise InputError(
            f"The matrix has {len(rows)} rows for {len(names)} parameters.",
            expected="the name of the camera, its model, the names of its parameters, then a square matrix.",
            remedy="Name the file *_result_correlations_internals.csv, of one camera.",
            path=path,
        )
    return names, np.array(rows)


def _first_image(lines: list[str]) -> int:
    """Index of the line after the header, which ends with an empty one."""
    return next((i + 1 for i, line in enumerate(lines[: _LINES + 2]) if not line), 0)


def _image(lines: list[str], block: list[int], path: Path) -> tuple[str, tuple[int, int], Array]:
    """Name, size and the 26 numbers of an image."""
    words = lines[block[0]].rsplit(maxsplit=2)
    if len(words) != 3 or not (words[1].isdigit() and words[2].isdigit()):
        raise InputError(
            f"Expected the name of an image with its width and height, found {lines[block[0]]!r}.",
            remedy="Export the parameters again.",
            path=path,
            row=block[0] + 1,
        )
    values: list[float] = []
    for k, count in enumerate(_NUMBERS_OF_LINE):
        row = block[1 + k] if 1 + k < len(block) else block[-1]
        found = lines[row].split() if 1 + k < len(block) else []
        if len(found) != count:
            raise InputError(
                f"Image {words[0]!r} has {len(found)} values where {count} belong.",
                expected="K (3 rows), radial (3), tangential (2), position (3) and rotation (3 rows).",
                remedy="The file is cut off or edited: export the parameters again.",
                path=path,
                row=row + 1,
            )
        values += [_number(word, path, row + 1) for word in found]
    return words[0], (int(words[1]), int(words[2])), np.array(values)


def _number(word: str, path: Path, row: int) -> float:
    try:
        value = float(word)
    except ValueError:
        value = float("nan")
    if not np.isfinite(value):
        raise InputError(f"{word!r} is not a finite number.", remedy="Export the file again.", path=path, row=row)
    return value
