"""Surveyed points of a block and their marks: control and check, whole, horizontal or heights alone; distances."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from georef.crs import CrsDefinition, WorldFrame
from georef.errors import InputError
from georef.estimation.adjustment.block import Block, Distances
from georef.evaluation.forward_intersection import Intersection, PosedImages, intersect
from georef.geometry.covariance import information_of_rank
from georef.geometry.rigid import Array
from georef.io.columns import CrsKind
from georef.io.points import PointTable, read_points
from georef.project import Project
from georef.sections import BlockSection
from georef.stages.reference import table_format
from georef.stages.survey import check_frame
from georef.types.constraints import CheckKind, CheckPoint, ControlPoint, Mark
from georef.types.scene import Observations

logger = logging.getLogger(__name__)
_NEXT_TO_NOTHING_M = 1e4  # 1-sigma of a coordinate that is not given


def read_surveyed(project: Project, kind: CrsKind, *, with_roles: bool) -> PointTable | None:
    """The table of points, if the project has one; with_roles: it must have a column that says who is control. Raises
    InputError or CrsError."""
    section = project.file.points
    if section is None:
        return None
    table = read_points(
        project.data(section.coordinates),
        crs_kind=kind,
        columns=section.table.columns or None,
        table_format=table_format(section.table),
        role=None if with_roles else "control",
        partial=True,
    )
    check_frame(_placed(table), CrsDefinition(project.file.crs.horizontal, project.file.crs.height))
    return table


def _placed(table: PointTable) -> PointTable:
    """The rows that have all coordinates, for checks of where they are."""
    whole = np.isfinite(table.positions_in_crs).all(axis=1)
    return replace(table, positions_in_crs=table.positions_in_crs[whole], rows=table.rows[whole])


def surveyed_points(
    table: PointTable,
    marks: Sequence[tuple[Mark, ...]],
    started: Block,
    world: WorldFrame,
) -> tuple[ControlPoint, ...]:
    """The points (N) with their marks. Coordinates that are not given are filled in from the marks in the images of the
    started block, to place the others; a point that lacks them and two marks as well is left out, with a warning."""
    positions = _filled(table, marks, started, world)
    there = np.flatnonzero(np.isfinite(positions).all(axis=1))
    for i in np.flatnonzero(~np.isfinite(positions).all(axis=1)).tolist():
        logger.warning("%s: nothing tells where point %s is: it is left out", table.path, table.point_ids[i])
    known = np.ones((len(table), 3), bool) if table.known is None else table.known
    in_world = world.world_from_crs(positions[there])
    sigmas = np.where(known, table.sigmas_m, _NEXT_TO_NOTHING_M)[there]
    covs = np.zeros((len(there), 3, 3))
    covs[:, range(3), range(3)] = np.square(sigmas)
    covs = world.world_cov_from_crs(positions[there], covs)
    points: list[ControlPoint] = []
    for k, i in enumerate(there.tolist()):
        if not marks[i]:
            logger.warning("%s: point %s is marked in no image", table.path, table.point_ids[i])
        partial = None if known[i].all() else information_of_rank(covs[k], int(known[i].sum()))
        points.append(ControlPoint(table.point_ids[i], in_world[k], covs[k], marks[i], partial))
    return tuple(points)


def _filled(table: PointTable, marks: Sequence[tuple[Mark, ...]], started: Block, world: WorldFrame) -> Array:
    """Coordinates (N, 3) in the CRS; rows of NaN where nothing tells them."""
    positions = table.positions_in_crs.copy()
    missing = np.flatnonzero(~np.isfinite(positions).all(axis=1))
    if not len(missing):
        return positions
    cameras = tuple(started.calibrations[c].camera for c in started.calibration)
    images = PosedImages(started.image_ids, cameras, tuple(started.world_from_cam(started.start()).to_list()))
    for i in missing.tolist():
        point = CheckPoint(table.point_ids[i], CheckKind.ABSOLUTE, np.zeros(3), np.eye(3), marks[i])
        found = intersect(point, images)
        near = world.crs_from_world(found.point[None])[0] if isinstance(found, Intersection) else np.full(3, np.nan)
        positions[i] = np.where(np.isfinite(positions[i]), positions[i], near)
    return positions


def marks_of(
    table: PointTable, prefix: str | None, point_ids: Sequence[str], image_ids: Sequence[str], observed: Observations
) -> list[tuple[Mark, ...]]:
    """The marks of each point of the table; `observed` are of measured points (ids P) in images (ids M)."""
    index = {point: i for i, point in enumerate(point_ids)}
    out: list[tuple[Mark, ...]] = []
    for name in table.point_ids:
        at = index.get(f"{prefix}{name}") if prefix is not None else None
        rows = [] if at is None else np.flatnonzero(observed.point == at).tolist()
        out.append(
            tuple(Mark(image_ids[int(observed.view[r])], observed.pixel[r], float(observed.sigma_px[r])) for r in rows)
        )
    return out


def roles(
    name: str, section: BlockSection, table: PointTable | None, surveyed: Sequence[ControlPoint]
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Ids of control and of check points, as the project and its table declare them. Raises InputError."""
    known = tuple(point.point_id for point in surveyed)
    if section.control == "table":
        given = {} if table is None else dict(zip(table.point_ids, table.roles, strict=True))
        control = tuple(point for point in known if given.get(point) == "control")
    elif isinstance(section.control, str):
        control = known if section.control == "all" else ()
    else:
        control = _known_ids(f"blocks.{name}.control", section.control, known, table)
    if isinstance(section.check, str):
        return control, tuple(point for point in known if point not in set(control))
    check = _known_ids(f"blocks.{name}.check", section.check, known, table)
    return tuple(point for point in control if point not in set(check)), check


def _known_ids(key: str, ids: tuple[str, ...], known: tuple[str, ...], table: PointTable | None) -> tuple[str, ...]:
    unknown = [point for point in ids if point not in known]
    if unknown:
        raise InputError(
            f"{key} names '{unknown[0]}', which has no coordinates.",
            expected=f"some of {', '.join(known) or 'the points of a table (there is none)'}.",
            remedy="Correct the list in project.toml, or the table of points.",
            path=None if table is None else table.path,
        )
    return ids


def distances_of(
    name: str, section: BlockSection, tie_ids: Sequence[str], surveyed: Sequence[ControlPoint]
) -> Distances:
    """The measured distances between tie points (ids P), which may be named without the prefix of marks.

    Raises InputError for ends that have coordinates, which would bring check points in, and for ends that are unknown.
    """
    index = {point: i for i, point in enumerate(tie_ids)}
    prefix, coordinates = section.observations.mark_prefix or "", {point.point_id for point in surveyed}
    ends: list[int] = []
    for entry in section.distances:
        for end in (entry.a, entry.b):
            if end in coordinates or end.removeprefix(prefix) in coordinates:
                raise InputError(
                    f"blocks.{name}.distances ends at '{end}', which has coordinates in the table of points.",
                    expected="ends that are measured in images and not surveyed: a check point must not take part.",
                    remedy="Delete the point from that table, or the distance from project.toml.",
                )
            at = index.get(end, index.get(f"{prefix}{end}"))
            if at is None:
                raise InputError(
                    f"blocks.{name}.distances ends at '{end}', which fewer than two images measure.",
                    expected="the id of a point as the image measurements have it.",
                    remedy="Correct the id in project.toml, or measure the point.",
                )
            ends.append(at)
    pairs = np.array(ends, dtype=np.int64).reshape(-1, 2)
    return Distances(
        *(pairs[:, 0], pairs[:, 1]),
        np.array([entry.distance_m for entry in section.distances], dtype=np.float64),
        np.array([entry.sigma_m for entry in section.distances], dtype=np.float64),
    )
