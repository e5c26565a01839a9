"""Tables of cameras: size, focal lengths, principal point and distortion, all in pixels."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import cast

import numpy as np

from georef.geometry.camera import ESTIMABLE, PLAIN, Camera, CameraModel
from georef.geometry.lenses import MODELS
from georef.geometry.rigid import Array
from georef.io.tables import Table, TableFormat, read_table

CAMERA_COLUMNS = ("camera", "width", "height", "fx", "fy", "cx", "cy")
COEFFICIENT_COLUMNS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
DEFAULT_FOCAL = 1.2
"""Of the longer side: where an unknown focal length starts, a view of 45 degrees."""
_UNSUPPORTED = ("p3", "p4", "b1", "b2", "skew")
_MODELS = "pinhole: no distortion; brown: k1, k2, p1, p2, k3; fisheye: k1, k2, k3, k4; rational: k1 to k6, p1, p2."
_SHORTEST_FOCAL = 0.1  # of the longer side: a fisheye of more than 360 degrees


def read_cameras(
    path: Path | str, *, columns: Mapping[str, str] | None = None, table_format: TableFormat | None = None
) -> dict[str, Camera]:
    """Read camera, width, height, fx, fy, cx, cy and optionally model, k1 to k6, p1, p2, estimate -> id: Camera.

    Pixels; the centre of the top-left pixel is (0.5, 0.5). model: pinhole, brown (k1, k2, p1, p2, k3), fisheye
    (equidistant, k1 to k4) or rational (k1 to k6, p1, p2); without it brown where a coefficient is not zero, pinhole
    elsewhere. estimate: which of focal, cx, cy, aspect (fy / fx) and the model's coefficients are not known, "focal
    k1"; their values are then where the estimation starts. Of a camera of unknown focal length fx, fy (they start at
    1.2 of the longer side) and the principal point may be left out: what is, is estimated. Raises InputError for
    columns that are missing, values that cannot be (sizes, focal lengths, a principal point outside the image),
    coefficients that the model does not have, and cameras that are listed twice.
    """
    table = read_table(path, columns=columns, table_format=table_format)
    unknown = _unknown(table)
    table.require(CAMERA_COLUMNS if not all("focal" in names for names in unknown) else CAMERA_COLUMNS[:3])
    ids = table.unique_ids("camera")
    sizes = np.stack([table.integers("width"), table.integers("height")], axis=1)
    _check_sizes(table, ids, sizes)
    focal = _or_start(table, ("fx", "fy"), unknown, np.repeat(DEFAULT_FOCAL * sizes.max(axis=1, keepdims=True), 2, 1))
    principal = _or_start(table, ("cx", "cy"), unknown, sizes / 2.0)
    models, coefficients = _models(table), _coefficients(table)
    _refuse_unsupported(table, models, coefficients)
    _refuse_unknown_of_others(table, models, unknown)
    _check_focal_lengths(table, ids, sizes, focal)
    _check_principal_points(table, ids, sizes, principal)
    return {
        camera_id: Camera(
            camera_id,
            int(sizes[i, 0]),
            int(sizes[i, 1]),
            *map(float, (*focal[i], *principal[i])),
            distortion=_distortion(models[i], {name: float(values[i]) for name, values in coefficients.items()}),
            model=models[i],
            estimate=unknown[i],
        )
        for i, camera_id in enumerate(ids)
    }


def _models(table: Table) -> list[CameraModel]:
    """The model of each camera: as it is named, else as its coefficients and unknowns ask for."""
    named = table.choices("model", MODELS, allow_empty=True) if table.has("model") else ("",) * len(table)
    values = _coefficients(table)
    unknown = _unknown(table)
    return [
        cast(CameraModel, name)
        or ("brown" if any(v[i] for v in values.values()) or set(unknown[i]) - set(PLAIN) else "pinhole")
        for i, name in enumerate(named)
    ]


def _coefficients(table: Table) -> dict[str, Array]:
    return {
        name: np.nan_to_num(table.numbers(name, allow_empty=True)) for name in COEFFICIENT_COLUMNS if table.has(name)
    }


def _distortion(model: CameraModel, values: Mapping[str, float]) -> tuple[float, ...]:
    distortion = tuple(values.get(name, 0.0) for name in MODELS[model].parameters)
    if model == "brown" and distortion[4] == 0.0:
        return distortion[:4]
    return distortion


def _unknown(table: Table) -> list[tuple[str, ...]]:
    """What is to be estimated of each camera."""
    if not table.has("estimate"):
        return [()] * len(table)
    out = []
    for i, cell in enumerate(table.text("estimate")):
        names = tuple(cell.lower().replace("+", " ").replace(";", " ").split())
        wrong = [name for name in names if name not in ESTIMABLE]
        if "focal" in names:  # nothing is known of what is left out
            blank = [n for n in ("cx", "cy", "fy") if not table.has(n) or not table.text(n)[i]]
            names += tuple(n for n in ("aspect" if n == "fy" else n for n in blank) if n not in names)
        if wrong or len(set(names)) < len(names) or ("k2" in names and "k1" not in names):
            raise table.error(
                i,
                f"Column 'estimate' has {cell!r}.",
                expected='what is not known: "focal", "focal k1", "focal k1 k2", "focal cx cy", or nothing.',
                remedy="Correct the value; leave it empty for a camera that is calibrated.",
            )
        out.append(names)
    return out


def _or_start(table: Table, names: tuple[str, str], unknown: list[tuple[str, ...]], start: Array) -> Array:
    """Two columns (N, 2); `start` where a camera of unknown focal length leaves them empty."""
    if not table.has(*names):
        return start
    given = table.stack(names, allow_empty=True)
    free = np.array(["focal" in names for names in unknown], bool)[:, None] & np.isnan(given)
    table.take(np.flatnonzero((np.isnan(given) & ~free).any(axis=1))).stack(names)  # raises: not declared unknown
    return np.where(free, start, given)


def _refuse_unsupported(table: Table, models: list[CameraModel], coefficients: Mapping[str, Array]) -> None:
    others = {n: np.nan_to_num(table.numbers(n, allow_empty=True)) for n in _UNSUPPORTED if table.has(n)}
    for name, values in {**coefficients, **others}.items():
        for i in np.flatnonzero(values):
            if name in MODELS[models[i]].parameters:
                continue
            raise table.error(
                int(i),
                f"Column {name!r} has {values[i]}, which the camera model {models[i]!r} does not have.",
                expected=_MODELS,
                remedy=f"Calibrate with {name} fixed at 0, or name the right model in a column 'model'.",
            )


def _refuse_unknown_of_others(table: Table, models: list[CameraModel], unknown: list[tuple[str, ...]]) -> None:
    """Coefficients that are to be estimated and that the model does not have."""
    for i, names in enumerate(unknown):
        for name in names:
            model = "brown" if models[i] == "pinhole" else models[i]  # which an unknown distortion makes of it
            if name in PLAIN or name in MODELS[model].parameters:
                continue
            raise table.error(
                i,
                f"Column 'estimate' has {name!r}, which the camera model {model!r} does not have.",
                expected=_MODELS,
                remedy=f"Leave {name} out, or name the right model in a column 'model'.",
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
