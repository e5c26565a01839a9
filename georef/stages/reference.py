"""The reference of a survey: one epoch or several, their orientations, images and cameras."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from georef.crs import CrsDefinition, WorldFrame
from georef.errors import InputError
from georef.geometry.camera import Camera
from georef.geometry.rigid import Array, Rigid3, nearest_rotation
from georef.io.columns import CrsKind
from georef.io.exterior_orientation import ExteriorOrientationTable, read_exterior_orientation
from georef.io.tables import TableFormat
from georef.project import REFERENCE, Project, ReferenceSection, ReferenceSigma, TableSection
from georef.stages.cameras import CameraTable, Stated, pinhole_of_row, require_known
from georef.stages.panoramas import CutOut, placeholder, with_heads
from georef.types.campaign import Campaign, Image, PoseSigma

IMAGE_SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".tif", ".tiff"})
logger = logging.getLogger(__name__)


def table_format(section: TableSection) -> TableFormat:
    return TableFormat(section.delimiter, section.decimal, section.encoding)


def image_files(folder: Path) -> dict[str, Path]:
    """The images of a folder and its sub-folders by their names below it. Raises InputError where there are none."""
    if not folder.is_dir():
        raise InputError(
            "The folder of images does not exist.",
            remedy="Correct `images` in project.toml, or the folder of the data (--data or GEOREF_DATA).",
            path=folder,
        )
    files = sorted(p for p in folder.rglob("*") if p.suffix.lower() in IMAGE_SUFFIXES and p.is_file())
    if not files:
        raise InputError("The folder holds no images.", expected="JPEG, PNG or TIFF files.", path=folder)
    return {p.relative_to(folder).as_posix(): p for p in files}


def read_orientations(
    project: Project, definition: CrsDefinition, kind: CrsKind
) -> dict[str, ExteriorOrientationTable]:
    """The exterior orientation of each reference epoch. Raises InputError."""
    return {name: _read_orientation(project, section, kind) for name, section in project.file.reference_epochs.items()}


def _read_orientation(project: Project, section: ReferenceSection, kind: CrsKind) -> ExteriorOrientationTable:
    table = read_exterior_orientation(
        project.data(section.exterior_orientation),
        crs_kind=kind,
        angles=section.angles,
        angle_unit=section.angle_unit,
        columns=section.table.columns or None,
        table_format=table_format(section.table),
    )
    if len(table) < 2 and section.panorama is None:
        raise InputError(
            f"The reference has {len(table)} images.",
            expected="at least two, better ten about each place.",
            remedy="Add reference images with their exterior orientation.",
            path=table.path,
        )
    return table


def world_poses(world: WorldFrame, positions_in_crs: Array, axes_from_cam: Array) -> list[Rigid3]:
    """world_from_cam of positions (N, 3) and rotations (N, 3, 3)."""
    centres = world.world_from_crs(positions_in_crs)
    turns = world.crs_axes_from_world(positions_in_crs)
    return [Rigid3(nearest_rotation(t.T @ r), c) for t, r, c in zip(turns, axes_from_cam, centres, strict=True)]


def reference_campaign(
    project: Project, orientations: Mapping[str, ExteriorOrientationTable], world: WorldFrame
) -> tuple[Campaign, list[CutOut]]:
    """All reference images, in the order of epochs and tables, and what is to be cut from panoramas.

    An image carries the name of its epoch. Where there are several, its id begins with it (`2025/front/0001.jpg`), so
    that ids stay unique in results.
    """
    images: list[Image] = []
    cutouts: list[CutOut] = []
    for name, section in project.file.reference_epochs.items():
        own, own_cutouts = _epoch_images(project, name, section, orientations[name], world)
        if len(project.file.reference_epochs) > 1:
            own = [replace(image, image_id=f"{name}/{image.image_id}") for image in own]
        images += own
        cutouts += own_cutouts
    return Campaign(REFERENCE, tuple(images)), cutouts


def _epoch_images(
    project: Project,
    epoch: str,
    section: ReferenceSection,
    orientation: ExteriorOrientationTable,
    world: WorldFrame,
) -> tuple[list[Image], list[CutOut]]:
    folder = project.data(section.images)
    files = image_files(folder)
    _match_images(orientation, files, folder, epoch, skip=section.unmatched == "skip")
    table = None if section.cameras is None else CameraTable.read(project.data(section.cameras))
    stated = Stated.of(orientation.path, orientation.image_ids, orientation.cameras, orientation.rows.tolist())
    poses = world_poses(world, orientation.positions_in_crs, orientation.axes_from_cam)
    images = []
    for index, (name, pose) in enumerate(zip(orientation.image_ids, poses, strict=True)):
        if name not in files:
            continue
        image = replace(placeholder(name, files[name], epoch), world_from_cam=pose, given_sigma=_given(section))
        if section.panorama is None:
            image = replace(image, camera=_camera(orientation, index, table, stated, files[name], epoch))
        images.append(image)
    campaign, cutouts = with_heads(project, epoch, images, section.panorama)
    return list(campaign.images), cutouts


def _given(section: ReferenceSection) -> PoseSigma | None:
    """The declared standard deviations of an epoch's poses; None where they are to be estimated."""
    if not isinstance(section.sigma, ReferenceSigma):
        return None
    x, y, z = (float(v) for v in np.radians(section.sigma.rotation_deg))
    return PoseSigma(section.sigma.position_m, (x, y, z))


def _match_images(
    orientation: ExteriorOrientationTable, files: dict[str, Path], folder: Path, epoch: str, *, skip: bool
) -> None:
    """Poses without an image and images without a pose: refused, or skipped with a warning where that is declared."""
    where = f"[{REFERENCE}]" if epoch == REFERENCE else f"[references.{epoch}]"
    remedy = f'or set unmatched = "skip" in section {where} of project.toml.'
    for name, row in zip(orientation.image_ids, orientation.rows, strict=True):
        if name not in files:
            problem = f"Reference image '{name}' has an exterior orientation but no file in {folder}."
            if not skip:
                raise InputError(
                    problem, remedy=f"Add the image, remove the row, {remedy}", path=orientation.path, row=int(row)
                )
            logger.warning("%s", problem)
    extra = sorted(set(files) - set(orientation.image_ids))
    if extra:
        problem = f"{len(extra)} images in {folder} have no exterior orientation, the first is '{extra[0]}'."
        if not skip:
            raise InputError(problem, remedy=f"Add their rows, move them away, {remedy}", path=orientation.path)
        logger.warning("%s", problem)


def _camera(
    orientation: ExteriorOrientationTable,
    index: int,
    table: CameraTable | None,
    stated: Stated,
    path: Path,
    epoch: str,
) -> Camera:
    """The camera of an image: from its own intrinsics columns, else the one of the camera table that took it."""
    name = orientation.image_ids[index]
    if orientation.intrinsics is not None:
        return pinhole_of_row(name, orientation.intrinsics[index].tolist(), path)
    if table is None:
        where = f"[{REFERENCE}]" if epoch == REFERENCE else f"[references.{epoch}]"
        raise InputError(
            "There is no interior orientation for the reference images.",
            expected="columns fx, fy, cx, cy beside the exterior orientation, or a camera table.",
            remedy=f'Name one in project.toml: {where} cameras = "camera.csv".',
            path=orientation.path,
        )
    return require_known(table.camera_of(name, stated), table.path)
