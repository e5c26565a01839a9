"""A block of given image measurements: reads what a project declares of it, and makes the Block to be adjusted."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import cast

import numpy as np
from numpy.typing import NDArray

from georef.crs import CrsDefinition, WorldFrame, choose_origin, crs_kind
from georef.errors import InputError
from georef.estimation.adjustment.block import Block
from georef.geometry.camera import Camera
from georef.geometry.projection import Views
from georef.geometry.rigid import Array
from georef.geometry.triangulation import triangulate
from georef.io.bingo import BingoTable, pixels_from_mm, read_bingo
from georef.io.columns import CrsKind
from georef.io.points import PointTable, read_points
from georef.io.table import IntArray
from georef.project import Project
from georef.sections import BlockObservations
from georef.stages.block_images import BlockImages, images_of_block
from georef.stages.block_tables import read_tables
from georef.stages.reference import table_format
from georef.stages.survey import check_frame
from georef.types.constraints import CheckKind, CheckPoint, ControlPoint, Mark
from georef.types.scene import Observations

logger = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class BlockSurvey:
    """Everything that a project declares of a block, in the world frame.

    block: with tie points alone; tie_ids: their ids. surveyed: all points that have coordinates, with their marks.
    dropped: tie points that fewer than two images see, or whose rays do not intersect.
    """

    world: WorldFrame
    images: BlockImages
    block: Block
    tie_ids: tuple[str, ...]
    surveyed: tuple[ControlPoint, ...]
    declared_control: tuple[str, ...]
    check_kind: CheckKind
    dropped: int

    @property
    def has_gnss(self) -> bool:
        return len(self.block.position_priors) > 0

    def control(self, ids: Sequence[str]) -> tuple[ControlPoint, ...]:
        return tuple(point for point in self.surveyed if point.point_id in set(ids))

    def check(self, control_ids: Sequence[str]) -> tuple[CheckPoint, ...]:
        """All surveyed points that are not control."""
        return tuple(
            CheckPoint(p.point_id, self.check_kind, p.point_in_world, p.cov, p.marks)
            for p in self.surveyed
            if p.point_id not in set(control_ids)
        )


def load_block(project: Project, name: str) -> BlockSurvey:
    """Reads and cross-checks all tables of a block. Raises InputError or CrsError with file, row, value, remedy."""
    section = project.file.blocks[name]
    definition = CrsDefinition(project.file.crs.horizontal, project.file.crs.height)
    kind = cast(CrsKind, crs_kind(definition))
    measured = read_bingo(project.data(section.observations.file))
    tables = read_tables(project, section, kind, definition)
    origin = project.file.crs.origin
    origin = choose_origin(definition, tables.positions_in_crs) if origin is None else np.array(origin)
    world = WorldFrame.create(definition, origin)
    images = images_of_block(project, section, tables, measured, world)
    observations = _observations(measured, images, section.observations)
    points = _points(project, kind)
    surveyed, ties, tie_ids = _surveyed(project, name, measured, images, observations, points, world)
    block, tie_ids, dropped = _block(images.started(ties), ties, tie_ids)
    return BlockSurvey(
        *(world, images, block, tie_ids, surveyed),
        declared_control=_declared_control(project, name, surveyed),
        check_kind=CheckKind.ABSOLUTE if project.file.points is None else CheckKind(project.file.points.check_kind),
        dropped=dropped,
    )


def _observations(measured: BingoTable, images: BlockImages, section: BlockObservations) -> Observations:
    """All measurements in pixels of the house."""
    pixel = np.empty((len(measured), 2))
    order = np.argsort(measured.image, kind="stable")
    starts = np.searchsorted(measured.image[order], np.arange(len(measured.image_ids) + 1))
    for index, camera in enumerate(images.cameras):
        here = order[starts[index] : starts[index + 1]]
        pixel[here] = pixels_from_mm(measured.xy_mm[here], (camera.width, camera.height), _sensor(section, camera))
        _refuse_outside(measured, here, pixel[here], camera)
    is_mark = _is_mark(measured.point_ids, section.mark_prefix)[measured.point]
    sigma = np.where(is_mark, section.mark_sigma_px, section.sigma_px)
    return Observations(measured.point, measured.image, pixel, sigma, np.where(is_mark, -1, measured.point))


def _sensor(section: BlockObservations, camera: Camera) -> tuple[float, float]:
    if not isinstance(section.sensor_mm, dict):
        return section.sensor_mm
    if camera.camera_id not in section.sensor_mm:
        raise InputError(
            f"Nothing says the size of the sensor of camera '{camera.camera_id}'.",
            remedy=f'Add it in project.toml: sensor_mm = {{ "{camera.camera_id}" = [36.0, 24.0] }}.',
        )
    return section.sensor_mm[camera.camera_id]


def _refuse_outside(measured: BingoTable, here: IntArray, pixel: Array, camera: Camera) -> None:
    margin = 1.0
    outside = np.flatnonzero(
        ((pixel < -margin) | (pixel > np.array([camera.width, camera.height]) + margin)).any(axis=1)
    )
    if len(outside):
        i = int(here[outside[0]])
        x, y = measured.xy_mm[i]
        raise InputError(
            f"The measurement ({x}, {y}) mm lies outside image '{measured.image_ids[measured.image[i]]}'.",
            expected="millimetres from the image centre, x right and y up, on the sensor that sensor_mm tells.",
            remedy="Correct observations.sensor_mm in project.toml, or the size of the camera.",
            path=measured.path,
            row=int(measured.rows[i]),
        )


def _is_mark(point_ids: Sequence[str], prefix: str | None) -> NDArray[np.bool_]:
    return np.array([prefix is not None and name.startswith(prefix) for name in point_ids], dtype=bool)


def _points(project: Project, kind: CrsKind) -> PointTable | None:
    section = project.file.points
    if section is None:
        return None
    table = read_points(
        project.data(section.coordinates),
        crs_kind=kind,
        columns=section.table.columns or None,
        table_format=table_format(section.table),
        role="control",
    )
    check_frame(table, CrsDefinition(project.file.crs.horizontal, project.file.crs.height))
    return table


def _surveyed(
    project: Project,
    name: str,
    measured: BingoTable,
    images: BlockImages,
    observations: Observations,
    table: PointTable | None,
    world: WorldFrame,
) -> tuple[tuple[ControlPoint, ...], Observations, tuple[str, ...]]:
    """The points that have coordinates, with their marks; the other measurements, renumbered, and their point ids."""
    prefix = project.file.blocks[name].observations.mark_prefix
    given = {} if table is None else {f"{prefix or ''}{point}": k for k, point in enumerate(table.point_ids)}
    is_given = np.array([point in given and prefix is not None for point in measured.point_ids], dtype=bool)
    points: list[ControlPoint] = []
    if table is not None and prefix is not None:
        positions, covs = _in_world(table, world)
        index = {point: i for i, point in enumerate(measured.point_ids)}
        for mark_id, k in given.items():
            rows = np.flatnonzero(observations.point == index[mark_id]) if mark_id in index else np.zeros(0, np.int64)
            marks = tuple(
                Mark(images.image_ids[observations.view[r]], observations.pixel[r], float(observations.sigma_px[r]))
                for r in rows
            )
            if not marks:
                logger.warning("%s: point %s is marked in no image", table.path, table.point_ids[k])
            points.append(ControlPoint(table.point_ids[k], positions[k], covs[k], marks))
    number = np.cumsum(~is_given) - 1
    ties = observations.take(~is_given[observations.point])
    ids = tuple(point for point, taken in zip(measured.point_ids, is_given, strict=True) if not taken)
    return tuple(points), ties.with_points(number[ties.point]), ids


def _in_world(table: PointTable, world: WorldFrame) -> tuple[Array, Array]:
    covs = np.zeros((len(table), 3, 3))
    covs[:, range(3), range(3)] = np.square(table.sigmas_m)
    return world.world_from_crs(table.positions_in_crs), world.world_cov_from_crs(table.positions_in_crs, covs)


def _declared_control(project: Project, name: str, surveyed: Sequence[ControlPoint]) -> tuple[str, ...]:
    declared, known = project.file.blocks[name].control, [point.point_id for point in surveyed]
    if isinstance(declared, str):
        return tuple(known) if declared == "all" else ()
    unknown = [point for point in declared if point not in known]
    if unknown:
        raise InputError(
            f"blocks.{name}.control names '{unknown[0]}', which has no coordinates.",
            expected=f"some of {', '.join(known)}.",
            remedy="Correct the list in project.toml, or the table of points.",
        )
    return declared


def _block(started: Block, ties: Observations, tie_ids: tuple[str, ...]) -> tuple[Block, tuple[str, ...], int]:
    """The block with tie points that at least two images see, triangulated from the approximate poses."""
    world_from_cam = started.world_from_cam(started.start())
    cameras = [started.calibrations[c].camera for c in started.calibration]
    views = Views.of(world_from_cam.to_list(), cameras)
    found = triangulate(views, ties.point, ties.view, ties.pixel, ties.sigma_px, len(tie_ids))
    good = np.isfinite(found.points[:, 0])
    number = np.cumsum(good) - 1
    kept = ties.take(good[ties.point])
    block = replace(started, points=found.points[good], observations=kept.with_points(number[kept.point]))
    ids = tuple(point for point, taken in zip(tie_ids, good, strict=True) if taken)
    return block, ids, len(tie_ids) - len(ids)
