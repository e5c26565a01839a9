"""The survey in the world frame: reads the tables that a project declares and checks them against each other."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from pathlib import Path
from typing import cast

import numpy as np

from georef.crs import CrsDefinition, WorldFrame, check_area_of_use, choose_origin, crs_kind
from georef.errors import CrsError, InputError
from georef.geometry.camera import Camera
from georef.geometry.rigid import Array, Rigid3, nearest_rotation
from georef.io.camera_table import read_cameras
from georef.io.columns import CrsKind, PositionTable
from georef.io.exterior_orientation import ExteriorOrientationTable, read_exterior_orientation
from georef.io.gnss import GnssTable, read_gnss
from georef.io.marks import check_marks, read_marks
from georef.io.points import read_points
from georef.io.tables import TableFormat, check_declared_crs, check_declared_height
from georef.project import Project, TableSection
from georef.types.campaign import Campaign, Image, PositionPrior
from georef.types.constraints import CheckKind, CheckPoint, ControlPoint, Mark

IMAGE_SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".tif", ".tiff"})
logger = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Survey:
    """Everything that a project declares for one epoch, in the world frame."""

    world: WorldFrame
    reference: Campaign
    epoch: Campaign
    control: tuple[ControlPoint, ...]
    check: tuple[CheckPoint, ...]


def load_survey(project: Project, epoch: str) -> Survey:
    """Reads and cross-checks all tables of an epoch. Raises InputError or CrsError with file, row, value, remedy."""
    definition = CrsDefinition(project.file.crs.horizontal, project.file.crs.height)
    kind = cast(CrsKind, crs_kind(definition))
    orientation = _read_orientation(project, definition, kind)
    origin = project.file.crs.origin
    world = WorldFrame.create(
        definition, choose_origin(definition, orientation.positions_in_crs) if origin is None else np.array(origin)
    )
    reference = _reference(project, orientation, world)
    new = _epoch(project, epoch, definition, kind, world)
    control, check = _points(project, epoch, definition, kind, world, new)
    return Survey(world, reference, new, control, check)


def table_format(section: TableSection) -> TableFormat:
    return TableFormat(section.delimiter, section.decimal, section.encoding)


def world_poses(world: WorldFrame, positions_in_crs: Array, axes_from_cam: Array) -> list[Rigid3]:
    """world_from_cam of positions (N, 3) and rotations (N, 3, 3)."""
    centres = world.world_from_crs(positions_in_crs)
    turns = world.crs_axes_from_world(positions_in_crs)
    return [Rigid3(nearest_rotation(t.T @ r), c) for t, r, c in zip(turns, axes_from_cam, centres, strict=True)]


def _read_orientation(project: Project, definition: CrsDefinition, kind: CrsKind) -> ExteriorOrientationTable:
    section = project.file.reference
    table = read_exterior_orientation(
        project.data(section.exterior_orientation),
        crs_kind=kind,
        angles=section.angles,
        angle_unit=section.angle_unit,
        columns=section.table.columns or None,
        table_format=table_format(section.table),
    )
    _check_frame(table, definition)
    if len(table) < 2:
        raise InputError(
            f"The reference has {len(table)} images.",
            expected="at least two, better ten about each place.",
            remedy="Add reference images with their exterior orientation.",
            path=table.path,
        )
    return table


def _check_frame(table: PositionTable, definition: CrsDefinition) -> None:
    """The file's declared CRS against the project's, and the coordinates against the area of use."""
    check_declared_crs(table, definition.horizontal)
    if definition.height is not None:
        check_declared_height(table, definition.height)
    try:
        check_area_of_use(definition, table.positions_in_crs)
    except CrsError as error:
        raise CrsError(str(error), f"In {table.path}.") from None


def _reference(project: Project, orientation: ExteriorOrientationTable, world: WorldFrame) -> Campaign:
    section = project.file.reference
    folder = project.data(section.images)
    files = _image_files(folder)
    _match_images(orientation, files, folder, skip=section.unmatched == "skip")
    cameras = None
    if section.cameras:
        cameras_path = project.data(section.cameras)
        cameras = read_cameras(cameras_path), cameras_path
    poses = world_poses(world, orientation.positions_in_crs, orientation.axes_from_cam)
    images = []
    for index, (name, pose) in enumerate(zip(orientation.image_ids, poses, strict=True)):
        if name in files:
            camera = _camera(orientation, index, cameras, files[name], name)
            images.append(Image(name, files[name], camera, "reference", world_from_cam=pose))
    return Campaign("reference", tuple(images))


def _match_images(orientation: ExteriorOrientationTable, files: dict[str, Path], folder: Path, *, skip: bool) -> None:
    """Poses without an image and images without a pose: refused, or skipped with a warning where that is declared."""
    remedy = 'or set unmatched = "skip" in section [reference] of project.toml.'
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


def _image_files(folder: Path) -> dict[str, Path]:
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


def _camera(
    orientation: ExteriorOrientationTable,
    index: int,
    cameras: tuple[dict[str, Camera], Path] | None,
    path: Path,
    name: str,
) -> Camera:
    """The camera of an image: from its own intrinsics columns, else the only or the named one of the camera table."""
    if orientation.intrinsics is not None:
        fx, fy, cx, cy = (float(v) for v in orientation.intrinsics[index])
        width, height = _image_size(path)
        return Camera(name, width, height, fx, fy, cx, cy)
    if cameras is None:
        raise InputError(
            "There is no interior orientation for the reference images.",
            expected="columns fx, fy, cx, cy beside the exterior orientation, or a camera table.",
            remedy='Name one in project.toml: [reference] cameras = "camera.csv".',
            path=orientation.path,
        )
    return single_camera(*cameras)


def single_camera(cameras: dict[str, Camera], path: Path) -> Camera:
    """The only camera of a table."""
    if len(cameras) != 1:
        raise InputError(
            f"The camera table has {len(cameras)} cameras: {', '.join(list(cameras)[:5])}.",
            expected="one camera that took all images of the epoch.",
            remedy="Give each camera's images an epoch of their own.",
            path=path,
        )
    return next(iter(cameras.values()))


def _image_size(path: Path) -> tuple[int, int]:
    from PIL import Image as PillowImage

    with PillowImage.open(path) as image:
        return image.size


def _epoch(project: Project, epoch: str, definition: CrsDefinition, kind: CrsKind, world: WorldFrame) -> Campaign:
    """All images of the folder and all rows of the GNSS table: each will have an outcome."""
    section = project.file.epochs[epoch]
    folder = project.data(section.images)
    files = _image_files(folder)
    camera = single_camera(read_cameras(project.data(section.cameras)), project.data(section.cameras))
    images = {name: Image(name, path, camera, epoch) for name, path in files.items()}
    if section.gnss is None:
        return Campaign(epoch, tuple(images.values()))
    gnss = read_gnss(
        project.data(section.gnss),
        crs_kind=kind,
        columns=section.table.columns or None,
        table_format=table_format(section.table),
    )
    _check_frame(gnss, definition)
    for name, prior, heading in zip(gnss.image_ids, _priors(gnss, world), gnss.heading_deg, strict=True):
        image = images.get(name, Image(name, folder / name, camera, epoch))
        heading_rad = None if np.isnan(heading) else float(np.radians(heading))
        images[name] = replace(image, gnss=prior, heading_rad=heading_rad)
    without = [name for name, image in images.items() if image.gnss is None]
    if without:
        logger.warning("%d images of epoch %s have no GNSS position, the first is %s", len(without), epoch, without[0])
    return Campaign(epoch, tuple(images[name] for name in sorted(images)))


def _priors(gnss: GnssTable, world: WorldFrame) -> list[PositionPrior]:
    covs = np.zeros((len(gnss), 3, 3))
    covs[:, range(3), range(3)] = np.square(gnss.sigmas_m)
    positions = world.world_from_crs(gnss.positions_in_crs)
    return [
        PositionPrior(p, c)
        for p, c in zip(positions, world.world_cov_from_crs(gnss.positions_in_crs, covs), strict=True)
    ]


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
    )
    _check_frame(table, definition)
    marks = read_marks(project.data(section.marks[epoch]), repeats="mean", table_format=table_format(section.table))
    check_marks(marks, table.point_ids, {i.image_id: (i.camera.width, i.camera.height) for i in new.images})
    by_point: dict[str, list[Mark]] = {}
    for point, image, pixel, sigma in zip(marks.point_ids, marks.image_ids, marks.pixels, marks.sigmas_px, strict=True):
        by_point.setdefault(point, []).append(Mark(image, pixel, float(sigma)))
    positions = world.world_from_crs(table.positions_in_crs)
    covs = np.zeros((len(table), 3, 3))
    covs[:, range(3), range(3)] = np.square(table.sigmas_m)
    covs = world.world_cov_from_crs(table.positions_in_crs, covs)
    control, check = [], []
    for index, name in enumerate(table.point_ids):
        own = tuple(by_point.get(name, ()))
        if table.roles[index] == "control":
            control.append(ControlPoint(name, positions[index], covs[index], own))
        else:
            point_kind = table.kinds[index] or CheckKind(section.check_kind)
            check.append(CheckPoint(name, point_kind, positions[index], covs[index], own))
    return tuple(control), tuple(check)
