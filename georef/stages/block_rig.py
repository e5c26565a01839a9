"""Which images of a block were exposed together, how their cameras are mounted, and where each exposure starts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from georef.errors import InputError
from georef.estimation.adjustment.block import RigCamera
from georef.geometry.camera import Camera
from georef.geometry.poses import Poses
from georef.geometry.rigid import Rigid3
from georef.io.exterior_orientation import ExteriorOrientationTable
from georef.io.gnss import GnssTable
from georef.io.mounting_table import StatedMounting, read_mountings
from georef.io.table import IntArray
from georef.project import Project
from georef.sections import BlockRig
from georef.stages.block_tables import BlockTables, by_pattern, rows_of

_SAME_PLACE_M = 1e-3


def stations_of(rig: BlockRig | None, tables: BlockTables, image_ids: Sequence[str]) -> tuple[str, ...]:
    """The exposure of each image (M), an image of its own where there is no rig. Raises InputError."""
    if rig is None:
        return tuple(image_ids)
    if rig.station_pattern is not None:
        return by_pattern(rig.station_pattern, image_ids, "exposure")
    table = tables.gnss
    if table is None:
        raise InputError(
            "Nothing says which images were exposed together.",
            expected="a table of positions (gnss) with a column `station` or `time`, or a pattern of names.",
            remedy="Name it, or state rig.station_pattern in project.toml.",
        )
    rows = rows_of(table, image_ids)
    if rig.station_within_s is not None:
        return _at_one_time(tables, rows, image_ids, rig.station_within_s)
    if rig.station == "position":
        return _at_one_place(table, rows, image_ids)
    named = [table.stations[row] if row >= 0 else "" for row in rows]
    if not any(named):
        raise InputError(
            "No image has an exposure in the column `station`.",
            expected="the same name for all images of one exposure.",
            remedy='Add the column, or state rig.station_pattern, rig.station_within_s or rig.station = "position".',
            path=table.path,
        )
    return tuple(name or image for name, image in zip(named, image_ids, strict=True))


def _at_one_time(tables: BlockTables, rows: IntArray, image_ids: Sequence[str], within_s: float) -> tuple[str, ...]:
    """Exposures are named by their first image in time; gaps between them are longer than within_s."""
    if tables.times_s is None or (rows < 0).any():
        raise InputError(
            "Not every image has a time of exposure.",
            expected="a column `time` in the table of positions, and a row for each image, for rig.station_within_s.",
            remedy='Add it, or map it: table.columns = { time = "..." }.',
            path=None if tables.gnss is None else tables.gnss.path,
        )
    times = tables.times_s[rows]
    order = np.argsort(times, kind="stable")
    fresh = np.concatenate([[True], np.diff(times[order]) > within_s])
    first = order[np.flatnonzero(fresh)[np.cumsum(fresh) - 1]]
    names = [""] * len(image_ids)
    for image, leader in zip(order, first, strict=True):
        names[int(image)] = image_ids[int(leader)]
    return tuple(names)


def _at_one_place(table: GnssTable, rows: IntArray, image_ids: Sequence[str]) -> tuple[str, ...]:
    """Exposures are named by their first image; images without a row stand alone."""
    leaders: dict[tuple[float | str, ...], str] = {}
    names: list[str] = []
    for row, image in zip(rows, image_ids, strict=True):
        place = tuple(np.round(table.positions_in_crs[row] / _SAME_PLACE_M).tolist()) if row >= 0 else (image,)
        names.append(leaders.setdefault(place, image))
    return tuple(names)


def mountings_of(
    project: Project,
    rig: BlockRig | None,
    cameras: Sequence[Camera],
    image_ids: Sequence[str],
    station: IntArray,
    attitude: Poses | None,
    oriented: NDArray[np.bool_],
) -> tuple[tuple[RigCamera, ...], IntArray]:
    """How the cameras are mounted, and which mounting each image has (M,). Without a rig a camera is one by itself.

    attitude: poses (M) to start from, of the images that are oriented (M,). Raises InputError.
    """
    if rig is None:
        return (RigCamera("camera", Rigid3.identity()),), np.zeros(len(image_ids), np.int64)
    names = [camera.camera_id for camera in cameras]
    _refuse_twice(names, image_ids, station)
    if rig.file is not None:
        path = project.data(rig.file)
        given = read_mountings(path)
        _require_mounted(given, names, image_ids, str(path))
        if rig.reference is not None and rig.reference not in given:
            raise _unknown_reference(rig.reference, tuple(given), str(path))
        used = {name: mounting for name, mounting in given.items() if name in set(names)}
        mountings = tuple(_weighted(name, mounting, rig.reference) for name, mounting in used.items())
    else:
        assert attitude is not None, "validated: a rig without a table has attitudes"
        mountings = _from_attitudes(rig, names, station, attitude, oriented)
    if len(mountings) > 1 and not _defined(mountings):
        raise InputError(
            "No camera defines the rig: the mountings of all are to be estimated freely.",
            expected="one camera with sigmas of 0 in the table of the rig, or rig.reference in project.toml.",
            remedy="Name the camera that the others are mounted relative to.",
        )
    index = {mounting.name: i for i, mounting in enumerate(mountings)}
    return mountings, np.array([index[name] for name in names], dtype=np.int64)


def _weighted(name: str, mounting: StatedMounting, reference: str | None) -> RigCamera:
    return RigCamera(name, mounting.rig_from_cam, None if name == reference else mounting.information)


def _defined(mountings: tuple[RigCamera, ...]) -> bool:
    return any(m.information is None or m.information.any() for m in mountings)


def _from_attitudes(
    rig: BlockRig, names: Sequence[str], station: IntArray, attitude: Poses, oriented: NDArray[np.bool_]
) -> tuple[RigCamera, ...]:
    """Mountings as the attitudes of exposures have them in the middle, that of the reference being identity."""
    if rig.reference not in names:
        raise _unknown_reference(str(rig.reference), tuple(dict.fromkeys(names)), None)
    reference = {int(station[i]): i for i, name in enumerate(names) if name == rig.reference and oriented[i]}
    information = np.zeros((6, 6))
    if rig.sigma_m is not None and rig.sigma_deg is not None:
        information = np.diag([np.radians(rig.sigma_deg) ** -2] * 3 + [rig.sigma_m**-2] * 3)
    out: list[RigCamera] = []
    for name in dict.fromkeys(names):
        if name == rig.reference:
            out.append(RigCamera(name, Rigid3.identity()))
            continue
        own = [i for i in np.flatnonzero(oriented).tolist() if names[i] == name]
        pairs = [(reference[int(station[i])], i) for i in own if int(station[i]) in reference]
        if not pairs:
            raise InputError(
                f"Camera '{name}' was never exposed together with '{rig.reference}', as far as attitudes are given.",
                expected="exposures with images of both, to start its mounting from.",
                remedy="Name a table of mountings (rig.file), or correct what says the exposures.",
            )
        first, second = (np.array(column) for column in zip(*pairs, strict=True))
        out.append(RigCamera(name, _middle(attitude.take(first).inverse() @ attitude.take(second)), information))
    return tuple(out)


def _middle(poses: Poses) -> Rigid3:
    """Median position, and the rotation nearest to the median of the matrices."""
    u, _, vt = np.linalg.svd(np.median(poses.rotation, axis=0))
    turn = u @ np.diag([1.0, 1.0, float(np.linalg.det(u @ vt))]) @ vt
    return Rigid3(turn, np.median(poses.translation, axis=0))


def _refuse_twice(names: Sequence[str], image_ids: Sequence[str], station: IntArray) -> None:
    seen: dict[tuple[int, str], str] = {}
    for place, name, image in zip(station.tolist(), names, image_ids, strict=True):
        other = seen.setdefault((place, name), image)
        if other != image:
            raise InputError(
                f"Images '{other}' and '{image}' are both of camera '{name}' and of one exposure.",
                expected="one image of each camera in an exposure.",
                remedy="Correct what says the exposures (rig.station) or the cameras (camera_pattern).",
            )


def _require_mounted(given: Mapping[str, StatedMounting], names: Sequence[str], ids: Sequence[str], path: str) -> None:
    for image, name in zip(ids, names, strict=True):
        if name not in given:
            raise InputError(
                f"The camera '{name}' of image '{image}' is not mounted.",
                expected=f"one of {', '.join(list(given)[:5])}.",
                remedy="Add the camera to the table of the rig.",
                path=path,
            )


def _unknown_reference(name: str, known: tuple[str, ...], path: str | None) -> InputError:
    return InputError(
        f"rig.reference names the camera '{name}', which is not there.",
        expected=f"one of {', '.join(known)}.",
        remedy="Correct it in project.toml.",
        path=path,
    )


def posed_stations(
    world_from_cam: Poses,
    oriented: NDArray[np.bool_],
    station: IntArray,
    mountings: Sequence[RigCamera],
    mounting: IntArray,
) -> Poses:
    """world_from_rig of each exposure, from its first oriented image whose camera is held, else from its first.

    Every exposure must have an image that is oriented.
    """
    held = np.array([m.information is None for m in mountings])[mounting]
    out: list[Rigid3] = []
    for own in np.split(np.argsort(station, kind="stable"), np.flatnonzero(np.diff(np.sort(station))) + 1):
        usable = own[oriented[own]]
        image = int(usable[np.argmax(held[usable])])
        out.append(world_from_cam[image] @ mountings[mounting[image]].rig_from_cam.inverse())
    return Poses.of(out)


def orientation_rows(table: ExteriorOrientationTable | None, image_ids: Sequence[str]) -> IntArray:
    """The row of each image (M,) in the table of attitudes; -1 where it has none."""
    return np.full(len(image_ids), -1) if table is None else rows_of(table, image_ids)
