"""The survey in the world frame: reads the tables that a project declares and checks them against each other."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, cast

import numpy as np

from georef.crs import CrsDefinition, WorldFrame, check_area_of_use, choose_origin, crs_kind
from georef.errors import CrsError
from georef.geometry.camera import Camera
from georef.io.columns import CrsKind, PositionTable
from georef.io.gnss import GnssTable, read_gnss
from georef.io.marks import check_marks, read_marks
from georef.io.points import read_points
from georef.io.rig_table import read_rig
from georef.io.tables import check_declared_crs, check_declared_height
from georef.project import Project
from georef.stages.cameras import CameraTable, Stated, unknown_camera, with_unknown
from georef.stages.mountings import with_fixes, with_rig
from georef.stages.panoramas import CutOut, placeholder, with_heads
from georef.stages.reference import image_files, read_orientations, reference_campaign, table_format, world_poses
from georef.types.campaign import Campaign, Image, PositionPrior
from georef.types.constraints import CheckKind, CheckPoint, ControlPoint, Mark

__all__ = ["Survey", "load_survey", "world_poses"]
logger = logging.getLogger(__name__)
_APPROXIMATE_M = 1000.0  # sigma of a coordinate of control that is approximate only


@dataclass(frozen=True, eq=False)
class Survey:
    """Everything that a project declares for one epoch, in the world frame."""

    world: WorldFrame
    reference: Campaign
    epoch: Campaign
    control: tuple[ControlPoint, ...]
    check: tuple[CheckPoint, ...]
    cutouts: tuple[CutOut, ...] = ()  # of panoramas: images that are made from others when they are first needed

    def source_of(self, image: Image) -> Path:
        """The file that an image comes from: its own, or that of the panorama which it is cut from."""
        return self._sources.get(image.path, image.path)

    @cached_property
    def _sources(self) -> dict[Path, Path]:
        return {cutout.path: cutout.source for cutout in self.cutouts}


def load_survey(project: Project, epoch: str) -> Survey:
    """Reads and cross-checks all tables of an epoch. Raises InputError or CrsError with file, row, value, remedy."""
    definition = CrsDefinition(project.file.crs.horizontal, project.file.crs.height)
    kind = cast(CrsKind, crs_kind(definition))
    orientations = read_orientations(project, definition, kind)
    for orientation in orientations.values():
        check_frame(orientation, definition)
    origin = project.file.crs.origin
    if origin is None:
        everything = np.concatenate([orientation.positions_in_crs for orientation in orientations.values()])
        world = WorldFrame.create(definition, choose_origin(definition, everything))
    else:
        world = WorldFrame.create(definition, np.array(origin))
    reference, reference_cutouts = reference_campaign(project, orientations, world)
    new, new_cutouts = _epoch(project, epoch, definition, kind, world)
    control, check = _points(project, epoch, definition, kind, world, new)
    return Survey(world, reference, new, control, check, (*reference_cutouts, *new_cutouts))


def check_frame(table: PositionTable, definition: CrsDefinition) -> None:
    """The file's declared CRS against the project's, and the coordinates against the area of use."""
    check_declared_crs(table, definition.horizontal)
    if definition.height is not None:
        check_declared_height(table, definition.height)
    try:
        check_area_of_use(definition, table.positions_in_crs)
    except CrsError as error:
        raise CrsError(str(error), f"In {table.path}.") from None


def _epoch(
    project: Project, epoch: str, definition: CrsDefinition, kind: CrsKind, world: WorldFrame
) -> tuple[Campaign, list[CutOut]]:
    """All images of the folder and all rows of the GNSS table: each will have an outcome."""
    section = project.file.epochs[epoch]
    folder = project.data(section.images)
    files, stated, priors, gnss = image_files(folder), Stated(), {}, None
    if section.gnss is not None:
        gnss = read_gnss(
            project.data(section.gnss),
            crs_kind=kind,
            columns=section.table.columns or None,
            table_format=table_format(section.table),
        )
        check_frame(gnss, definition)
        stated = Stated.of(gnss.path, gnss.image_ids, gnss.cameras, gnss.rows.tolist())
        priors = dict(zip(gnss.image_ids, _measured(gnss, world), strict=True))
        if gnss.unstated:
            message = "%s states no sigmas: its positions are searched about, and are no observations"
            logger.warning(message, gnss.path)
        files |= {name: folder / name for name in gnss.image_ids if name not in files}
        without = [name for name in files if name not in priors]
        if without:
            message = "%d images of epoch %s have no GNSS position, the first is %s"
            logger.warning(message, len(without), epoch, without[0])
    table = None if section.cameras is None else CameraTable.read(project.data(section.cameras))
    images = []
    for name, path in sorted(files.items()):
        image = placeholder(name, path, epoch)
        if section.panorama is None:
            image = replace(image, camera=_new_camera(name, path, table, stated, section.unknown))
        images.append(replace(image, **priors.get(name, {})))
    campaign, cutouts = with_heads(project, epoch, images, section.panorama)
    if gnss is not None:
        campaign = with_fixes(campaign, gnss, section)
    if section.rig is None or gnss is None:
        return campaign, cutouts
    return with_rig(campaign, read_rig(project.data(section.rig)), gnss.path, project.data(section.rig)), cutouts


def _new_camera(name: str, path: Path, table: CameraTable | None, stated: Stated, unknown: tuple[str, ...]) -> Camera:
    """The camera of a new image: of the table, or unknown, or both."""
    if table is None:
        return unknown_camera(path, unknown)
    return with_unknown(table.camera_of(name, stated), unknown, path)


def _measured(gnss: GnssTable, world: WorldFrame) -> list[dict[str, Any]]:
    """What each row says of its image: a position with covariance, or one to search about; heading (rad), station."""
    positions = world.world_from_crs(gnss.positions_in_crs)
    said: list[dict[str, Any]] = [
        {"heading_rad": None if np.isnan(heading) else float(np.radians(heading)), "station": station or None}
        for heading, station in zip(gnss.heading_deg, gnss.stations, strict=True)
    ]
    if gnss.unstated:
        return [row | {"near": position} for row, position in zip(said, positions, strict=True)]
    covs = np.zeros((len(gnss), 3, 3))
    covs[:, range(3), range(3)] = np.square(gnss.sigmas_m)
    covs = world.world_cov_from_crs(gnss.positions_in_crs, covs)
    return [row | {"gnss": PositionPrior(p, c)} for row, p, c in zip(said, positions, covs, strict=True)]


def _points(
    project: Project, epoch: str, definition: CrsDefinition, kind: CrsKind, world: WorldFrame, new: Campaign
) -> tuple[tuple[ControlPoint, ...], tuple[CheckPoint, ...]]:
    section = project.file.points
    if section is None or epoch not in section.marks:
        return (), ()
    table = read_points(
        project.data(section.coordinates),
        crs_kind=kind,
        columns=section.table.columns or None,
        table_format=table_format(section.table),
        allow_partial=True,
    )
    check_frame(table, definition)
    marks = read_marks(project.data(section.marks[epoch]), repeats="mean", table_format=table_format(section.table))
    check_marks(marks, table.point_ids, {i.image_id: (i.camera.width, i.camera.height) for i in new.images})
    by_point: dict[str, list[Mark]] = {}
    for point, image, pixel, sigma in zip(marks.point_ids, marks.image_ids, marks.pixels, marks.sigmas_px, strict=True):
        by_point.setdefault(point, []).append(Mark(image, pixel, float(sigma)))
    positions = world.world_from_crs(table.positions_in_crs)
    known = np.isfinite(table.sigmas_m)
    covs, information = np.zeros((len(table), 3, 3)), np.zeros((len(table), 3, 3))
    covs[:, range(3), range(3)] = np.square(np.where(known, table.sigmas_m, _APPROXIMATE_M))
    information[:, range(3), range(3)] = np.where(known, np.where(known, table.sigmas_m, 1.0) ** -2.0, 0.0)
    covs = world.world_cov_from_crs(table.positions_in_crs, covs)
    information = world.world_cov_from_crs(table.positions_in_crs, information)
    control, check = [], []
    for index, name in enumerate(table.point_ids):
        own = tuple(by_point.get(name, ()))
        if table.roles[index] == "control":
            partial = None if known[index].all() else information[index]
            control.append(ControlPoint(name, positions[index], covs[index], own, partial))
        else:
            point_kind = table.kinds[index] or CheckKind(section.check_kind)
            check.append(CheckPoint(name, point_kind, positions[index], covs[index], own))
    return tuple(control), tuple(check)
