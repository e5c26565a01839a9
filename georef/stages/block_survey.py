"""A block of given image measurements: reads what a project declares of it, and makes the Block to be adjusted."""

from __future__ import annotations

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
from georef.io.bingo import BingoTable, pixels_from_mm, read_bingo, sensor_of_header
from georef.io.columns import CrsKind
from georef.io.pix4d_ties import read_pix4d_ties
from georef.io.table import IntArray
from georef.project import Project
from georef.sections import BlockObservations
from georef.stages.block_images import BlockImages, images_of_block
from georef.stages.block_points import distances_of, marks_of, read_surveyed, roles, surveyed_points
from georef.stages.block_tables import read_tables
from georef.types.constraints import CheckKind, CheckPoint, ControlPoint
from georef.types.scene import Observations

_READERS = {"bingo": read_bingo, "pix4d": read_pix4d_ties}


@dataclass(frozen=True, eq=False)
class BlockSurvey:
    """Everything that a project declares of a block, in the world frame.

    block: with tie points alone; tie_ids: their ids. surveyed: all points that are control or check, with their marks.
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

    @property
    def whole(self) -> tuple[ControlPoint, ...]:
        """The surveyed points of which all coordinates are given."""
        return tuple(point for point in self.surveyed if point.whole)

    def control(self, ids: Sequence[str]) -> tuple[ControlPoint, ...]:
        return tuple(point for point in self.surveyed if point.point_id in set(ids))

    def partly_known(self, control_ids: Sequence[str]) -> tuple[ControlPoint, ...]:
        """The surveyed points that are not control, of which the height or the horizontal coordinates are not given."""
        return tuple(p for p in self.surveyed if not p.whole and p.point_id not in set(control_ids))

    def check(self, control_ids: Sequence[str]) -> tuple[CheckPoint, ...]:
        """All surveyed points with all coordinates that are not control."""
        control = set(control_ids)
        return tuple(
            CheckPoint(p.point_id, self.check_kind, p.point_in_world, p.cov, p.marks)
            for p in self.surveyed
            if p.point_id not in control and p.whole
        )


def load_block(project: Project, name: str) -> BlockSurvey:
    """Reads and cross-checks all tables of a block. Raises InputError or CrsError with file, row, value, remedy."""
    section = project.file.blocks[name]
    definition = CrsDefinition(project.file.crs.horizontal, project.file.crs.height)
    kind = cast(CrsKind, crs_kind(definition))
    measured = _READERS[section.observations.format](project.data(section.observations.file))
    tables = read_tables(project, section, kind, definition)
    origin = project.file.crs.origin
    origin = choose_origin(definition, tables.positions_in_crs) if origin is None else np.array(origin)
    world = WorldFrame.create(definition, origin)
    images = images_of_block(project, section, tables, measured, world)
    observations = _observations(measured, images, section.observations)
    table = read_surveyed(project, kind, with_roles=section.control == "table")
    prefix = section.observations.mark_prefix
    given = set() if table is None or prefix is None else {f"{prefix}{point}" for point in table.point_ids}
    ties, tie_ids = _ties(measured, observations, given)
    block, tie_ids, dropped = _block(images.started(ties), ties, tie_ids)
    surveyed: tuple[ControlPoint, ...] = ()
    if table is not None and prefix is not None:
        marks = marks_of(table, prefix, measured.point_ids, images.image_ids, observations)
        surveyed = surveyed_points(table, marks, block, world)
    control, check = roles(name, section, table, surveyed)
    surveyed = tuple(point for point in surveyed if point.point_id in {*control, *check})
    return BlockSurvey(
        *(world, images, replace(block, distances=distances_of(name, section, tie_ids, surveyed)), tie_ids, surveyed),
        declared_control=control,
        check_kind=CheckKind.ABSOLUTE if project.file.points is None else CheckKind(project.file.points.check_kind),
        dropped=dropped,
    )


def _ties(measured: BingoTable, observations: Observations, given: set[str]) -> tuple[Observations, tuple[str, ...]]:
    """The measurements of points without coordinates, renumbered, and the ids of these points."""
    is_given = np.array([point in given for point in measured.point_ids], dtype=bool)
    ties = observations.take(~is_given[observations.point])
    ids = tuple(point for point, taken in zip(measured.point_ids, is_given, strict=True) if not taken)
    return ties.with_points((np.cumsum(~is_given) - 1)[ties.point]), ids


def _observations(measured: BingoTable, images: BlockImages, section: BlockObservations) -> Observations:
    """All measurements in pixels of the house."""
    pixel = np.empty((len(measured), 2))
    order = np.argsort(measured.image, kind="stable")
    starts = np.searchsorted(measured.image[order], np.arange(len(measured.image_ids) + 1))
    for index, camera in enumerate(images.cameras):
        here = order[starts[index] : starts[index + 1]]
        pixel[here] = measured.xy_mm[here]
        if not measured.in_pixels:
            sensor = _sensor(section, camera, measured.cameras[index])
            pixel[here] = pixels_from_mm(measured.xy_mm[here], (camera.width, camera.height), sensor)
        _refuse_outside(measured, here, pixel[here], camera)
    is_mark = _is_mark(measured.point_ids, section.mark_prefix)[measured.point]
    sigma = np.where(is_mark, section.mark_sigma_px, section.sigma_px)
    return Observations(measured.point, measured.image, pixel, sigma, np.where(is_mark, -1, measured.point))


def _sensor(section: BlockObservations, camera: Camera, header: str) -> tuple[float, float]:
    """Width and height (mm): as the project says for all or for this camera, else as the header of the image does."""
    if isinstance(section.sensor_mm, tuple):
        return section.sensor_mm
    stated = (section.sensor_mm or {}).get(camera.camera_id) or sensor_of_header(header)
    if stated is None:
        raise InputError(
            f"Nothing says the size of the sensor of camera '{camera.camera_id}'.",
            remedy=f'Add it in project.toml: sensor_mm = {{ "{camera.camera_id}" = [36.0, 24.0] }}.',
        )
    return stated


def _refuse_outside(measured: BingoTable, here: IntArray, pixel: Array, camera: Camera) -> None:
    margin = 1.0
    outside = np.flatnonzero(
        ((pixel < -margin) | (pixel > np.array([camera.width, camera.height]) + margin)).any(axis=1)
    )
    if len(outside):
        i = int(here[outside[0]])
        x, y = measured.xy_mm[i]
        raise InputError(
            f"The measurement ({x}, {y}) {'px' if measured.in_pixels else 'mm'} lies outside image "
            f"'{measured.image_ids[measured.image[i]]}'.",
            expected="pixels from the top-left corner, x right and y down."
            if measured.in_pixels
            else "millimetres from the image centre, x right and y up, on the sensor that sensor_mm tells.",
            remedy="Correct the size of the camera in its table."
            if measured.in_pixels
            else "Correct observations.sensor_mm in project.toml, or the size of the camera.",
            path=measured.path,
            row=int(measured.rows[i]),
        )


def _is_mark(point_ids: Sequence[str], prefix: str | None) -> NDArray[np.bool_]:
    return np.array([prefix is not None and name.startswith(prefix) for name in point_ids], dtype=bool)


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
