"""Writes a simulated survey as the files of an ordinary project, and the truth in a folder that no project names.

Images are written one by one, each complete or absent: an interrupted write goes on where it stopped. A folder
belongs to one world; what is there of it is kept.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol

import cv2

from georef.errors import InputError
from georef.geometry.camera import Camera
from georef.io.files import write_bytes_atomically, write_text_atomically
from georef.simulate import tables
from georef.simulate.street import Change
from georef.simulate.survey import PointSurvey, SurveyQuality, survey_points
from georef.simulate.world import REFERENCE, StreetWorld, WorldImage, WorldOptions

PROJECT, TRUTH, WORLD = "project.toml", "truth", "world.json"
IMAGES, ORIENTATION, POINTS = "reference", "reference_eo.csv", "points.csv"
_JPEG_QUALITY = 95


class Runner(Protocol):
    """Runs a task over items in order, in this process or in several, and shows it; georef.executor.Executor is one."""

    def map_items(self, task: Callable[[str], str], items: Sequence[str], label: str) -> Iterable[str]: ...


class InOrder:
    """In this process, silently."""

    def map_items(self, task: Callable[[str], str], items: Sequence[str], label: str) -> Iterable[str]:
        return map(task, items)


@dataclass(frozen=True)
class NewEpoch:
    """Images of one camera, as a project wants them: an epoch with its folder and tables."""

    name: str
    campaign: str
    images: tuple[WorldImage, ...]

    @property
    def camera(self) -> Camera:
        camera = self.images[0].lens.camera
        assert camera is not None
        return camera

    @property
    def camera_file(self) -> str:
        return f"camera_{self.name}.csv"

    @property
    def gnss_file(self) -> str:
        return f"{self.name}_gnss.csv"

    @property
    def mark_file(self) -> str:
        return f"marks_{self.name}.csv"


@dataclass(frozen=True)
class RenderTask:
    """Renders an image of a world into a folder; made from the options alone, so that it can travel to a process."""

    options: WorldOptions
    folder: Path

    @cached_property
    def world(self) -> StreetWorld:
        return StreetWorld(self.options)

    def __call__(self, image_id: str) -> str:
        write_image(self.world, image_id, self.folder)
        return image_id

    def __getstate__(self) -> dict[str, Any]:
        return {"options": self.options, "folder": self.folder}


def write_project(
    world: StreetWorld, folder: Path, *, runner: Runner | None = None, quality: SurveyQuality | None = None
) -> list[str]:
    """Writes everything: project.toml, tables, truth, images. Returns the ids of the images rendered now.

    Raises InputError where the folder holds another world.
    """
    write_tables(world, folder, quality)
    return write_images(world, folder, runner)


def write_tables(world: StreetWorld, folder: Path, quality: SurveyQuality | None = None) -> None:
    """All files but the images; nothing is computed where they are there already."""
    claim(world, folder)
    done = folder / TRUTH / "complete.json"
    if done.is_file():
        return
    survey = survey_points(world, quality)
    epochs = new_epochs(world)
    _write_reference(world, folder)
    for epoch in epochs:
        _write_epoch(world, epoch, survey, folder)
    write_text_atomically(tables.point_table(survey.points, world.frame), folder / POINTS)
    write_text_atomically(project_toml(world), folder / PROJECT)
    _write_truth(world, survey, folder / TRUTH)
    write_text_atomically(json.dumps({"fingerprint": world.options.fingerprint}) + "\n", done)


def write_images(world: StreetWorld, folder: Path, runner: Runner | None = None) -> list[str]:
    """Renders the images that are not there yet; returns their ids."""
    claim(world, folder)
    missing = [name for name in image_files(world) if not image_path(world, name, folder).is_file()]
    if not missing:
        return []
    return list((runner or InOrder()).map_items(RenderTask(world.options, folder), missing, "images"))


def claim(world: StreetWorld, folder: Path) -> None:
    """Marks a folder as this world's. Raises InputError where it is another's."""
    path = folder / TRUTH / WORLD
    text = json.dumps({"fingerprint": world.options.fingerprint, "seed": world.options.seed}) + "\n"
    if path.is_file():
        if path.read_text(encoding="utf-8") != text:
            raise InputError(
                "The folder holds a simulated world of other options.",
                expected="an empty folder, or one that was written with the same options.",
                remedy="Choose another folder, or delete this one.",
                path=folder,
            )
        return
    write_text_atomically(text, path)


def image_files(world: StreetWorld) -> list[str]:
    """Ids of the images that a project can use: fisheye ones have no camera model there yet."""
    return [name for name, image in world.images.items() if image.lens.camera is not None]


def image_path(world: StreetWorld, image_id: str, folder: Path) -> Path:
    return folder / image_folder(world, world.images[image_id]) / image_id


def image_folder(world: StreetWorld, image: WorldImage) -> str:
    """The reference lies together; of a new campaign each camera is an epoch with a folder of its own."""
    if image.campaign == REFERENCE:
        return IMAGES
    lenses = set(world.rigs[image.campaign].lenses.values())
    return image.campaign if len(lenses) == 1 else f"{image.campaign}_{image.head.name}"


def new_epochs(world: StreetWorld) -> list[NewEpoch]:
    """The epochs that project.toml declares."""
    grouped: dict[str, list[WorldImage]] = {}
    for name in image_files(world):
        image = world.images[name]
        if image.campaign != REFERENCE:
            grouped.setdefault(image_folder(world, image), []).append(image)
    return [NewEpoch(name, images[0].campaign, tuple(images)) for name, images in grouped.items()]


def write_image(world: StreetWorld, image_id: str, folder: Path) -> None:
    """One photograph as a JPEG file, under a temporary name until it is complete."""
    path = image_path(world, image_id, folder)
    bgr = cv2.cvtColor(world.render_image(image_id), cv2.COLOR_RGB2BGR)
    _, data = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    write_bytes_atomically(data.tobytes(), path)


def _write_reference(world: StreetWorld, folder: Path) -> None:
    lenses = {image.image_id: image.lens for image in world.images_of(REFERENCE)}
    text = tables.orientation_table(world.published_poses, lenses, world.frame)
    write_text_atomically(text, folder / ORIENTATION)


def _write_epoch(world: StreetWorld, epoch: NewEpoch, survey: PointSurvey, folder: Path) -> None:
    write_text_atomically(tables.camera_table([epoch.camera]), folder / epoch.camera_file)
    measured = world.measured[epoch.campaign]
    write_text_atomically(tables.gnss_table(epoch.images, measured, world.frame), folder / epoch.gnss_file)
    own = {image.image_id for image in epoch.images}
    if marks := [mark for mark in survey.marks if mark.image_id in own]:
        write_text_atomically(tables.mark_table(marks), folder / epoch.mark_file)


def _write_truth(world: StreetWorld, survey: PointSurvey, folder: Path) -> None:
    """Poses of drives and epochs, exact and as the reference would have them; points, tie points, changes."""
    frame = world.frame
    drives = {campaign: world.images_of(campaign) for campaign in world.rigs}
    for name, images in (drives | {epoch.name: list(epoch.images) for epoch in new_epochs(world)}).items():
        poses = {image.image_id: image.world_from_cam for image in images}
        write_text_atomically(tables.orientation_table(poses, {}, frame), folder / f"{name}_eo.csv")
        moved = {key: world.deformation.moved_pose(pose) for key, pose in poses.items()}
        write_text_atomically(tables.orientation_table(moved, {}, frame), folder / f"{name}_eo_relative.csv")
    exact = {point.point_id: point.exact for point in survey.points}
    write_text_atomically(tables.exact_table(exact, frame), folder / "points.csv")
    ties = {tie.point_id: tie.point_in_world for tie in survey.ties}
    write_text_atomically(tables.exact_table(ties, frame), folder / "tie_points.csv")
    write_text_atomically(tables.tie_table(survey.ties), folder / "tie_marks.csv")
    changes = [_change(change) for change in world.street.changes]
    write_text_atomically(json.dumps(changes, indent=1) + "\n", folder / "changes.json")


def _change(change: Change) -> dict[str, Any]:
    return {
        "kind": change.kind,
        "what": change.what,
        "low_in_world_m": change.low_in_world.tolist(),
        "high_in_world_m": change.high_in_world.tolist(),
    }


def project_toml(world: StreetWorld) -> str:
    """The declarations of an ordinary project of this world's files."""
    quality = world.options.reference
    sections = [_HEADER.format(position=[quality.relative_m] * 3, rotation=[quality.relative_deg] * 3)]
    epochs = new_epochs(world)
    sections += [
        f'[epochs.{epoch.name}]\nimages = "{epoch.name}"\ncameras = "{epoch.camera_file}"\ngnss = "{epoch.gnss_file}"\n'
        for epoch in epochs
    ]
    marked = [epoch for epoch in epochs if epoch.campaign == "second"]
    marks = ", ".join(f'{epoch.name} = "{epoch.mark_file}"' for epoch in marked)
    sections.append(_POINTS.format(marks=marks))
    return "\n".join(sections)


_HEADER = """\
# A simulated street: a reference survey with exterior orientation, and new images of a later epoch with GNSS.
# File names are relative to the data root: --data DIR or GEOREF_DATA.
name = "demo"

[crs]
horizontal = "EPSG:25832"      # ETRS89 / UTM zone 32N
height = "ellipsoidal"

[reference]
images = "reference"
exterior_orientation = "reference_eo.csv"   # with fx, fy, cx, cy of each image
angles = "omega-phi-kappa"
angle_unit = "deg"
sigma = {{ position_m = {position}, rotation_deg = {rotation} }}   # within the reference
"""
_POINTS = """\
[points]
coordinates = "points.csv"
marks = {{ {marks} }}
check_kind = "absolute"        # where the table's column `kind` says nothing
"""
