"""Tables of what is measured between stations and between points: relative poses, and distances."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from georef.geometry.panorama import head_pose
from georef.geometry.rigid import Array, Rigid3
from georef.io.columns import read_sigmas
from georef.io.table import IntArray, Table
from georef.io.tables import TableFormat, read_table

_POSITION, _ANGLES, _SIGMAS = ("x", "y", "z"), ("yaw", "pitch", "roll"), ("sigma_m", "sigma_deg")


@dataclass(frozen=True, eq=False)
class MotionTable:
    """K motions: a_from_b of the rigs of two exposures each, their covariances (K, 6, 6), right perturbations."""

    path: Path
    rows: IntArray  # (K,) line numbers
    a: tuple[str, ...]
    b: tuple[str, ...]
    a_from_b: tuple[Rigid3, ...]
    cov: Array


@dataclass(frozen=True, eq=False)
class DistanceTable:
    """K distances between named points."""

    path: Path
    rows: IntArray
    a: tuple[str, ...]
    b: tuple[str, ...]
    distance_m: Array  # (K,)
    sigma_m: Array  # (K,)


def read_motions(
    path: Path | str, *, columns: Mapping[str, str] | None = None, table_format: TableFormat | None = None
) -> MotionTable:
    """Read from, to, x, y, z (m), yaw, pitch, roll (deg), sigma_m, sigma_deg.

    from and to are stations, or images that belong to none. Position and angles are those of `to` in the frame of
    `from`, as cameras of a rig: x right, y down, z forward; yaw clockwise, pitch up, roll clockwise. Raises InputError.
    """
    table = read_table(path, columns=columns, table_format=table_format)
    table.require(("from", "to", *_POSITION, *_ANGLES, *_SIGMAS))
    a, b = _ends(table)
    angles, positions = np.radians(table.stack(_ANGLES)), table.stack(_POSITION)
    sigmas = read_sigmas(
        table,
        _SIGMAS,
        lambda i: f"The motion from {a[i]!r} to {b[i]!r}",
        expected="positive standard deviations, metres and degrees (an IMU over a metre: 0.005 m, 0.01 deg).",
    )
    covs = np.zeros((len(table), 6, 6))
    covs[:, range(3), range(3)] = np.square(np.radians(sigmas[:, 1:]))
    covs[:, range(3, 6), range(3, 6)] = np.square(sigmas[:, :1])
    poses = tuple(head_pose(angle, position) for angle, position in zip(angles, positions, strict=True))
    return MotionTable(table.path, table.rows, a, b, poses, covs)


def read_distances(
    path: Path | str, *, columns: Mapping[str, str] | None = None, table_format: TableFormat | None = None
) -> DistanceTable:
    """Read from, to (points), distance_m, sigma_m. Raises InputError for what cannot be."""
    table = read_table(path, columns=columns, table_format=table_format)
    table.require(("from", "to", "distance_m", "sigma_m"))
    a, b = _ends(table)
    distance = table.numbers("distance_m")
    for i in np.flatnonzero(distance <= 0)[:1]:
        raise table.error(
            int(i),
            f"The distance from {a[i]!r} to {b[i]!r} is {distance[i]} m.",
            expected="a positive length in metres.",
            remedy="Correct the value.",
        )
    sigma = read_sigmas(
        table,
        ("sigma_m",),
        lambda i: f"The distance from {a[i]!r} to {b[i]!r}",
        expected="a positive standard deviation in metres (a scale bar: 0.0001 to 0.001; a tape: 0.005).",
    )
    return DistanceTable(table.path, table.rows, a, b, distance, sigma[:, 0])


def _ends(table: Table) -> tuple[tuple[str, ...], tuple[str, ...]]:
    a, b = table.ids("from"), table.ids("to")
    for i in (k for k in range(len(a)) if a[k] == b[k]):
        raise table.error(
            i,
            f"Row begins and ends at {a[i]!r}.",
            expected="two different names in `from` and `to`.",
            remedy="Correct one of them.",
        )
    return a, b
