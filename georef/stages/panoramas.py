"""Panoramas of a survey: each becomes the images of its heads, which are cut once and kept as files.

Files, because all that follows (extraction, reports, the viewer) reads an image from its path, some of it long after
extraction and in other processes. The name of a cut-out holds a hash of all that it depends on: of the panorama's file
by size and time, and of the head. What is there under its name is current; an interrupted cutting goes on.
"""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import quote

import numpy as np

from georef.geometry.angles import heading_of, rotation_from_yaw_pitch_roll
from georef.geometry.camera import Camera
from georef.geometry.panorama import PanoramaHead, Projection, expected_size, standard_heads
from georef.io.exif import image_size
from georef.io.files import write_bytes_atomically
from georef.io.head_table import read_heads
from georef.project import PanoramaSection, Project
from georef.stages.failures import internal_failure
from georef.types.campaign import Campaign, Image, Mounting, PositionPrior
from georef.types.results import RejectReason

if TYPE_CHECKING:
    from georef.executor import Executor

_VERSION = 1  # rises when the same panorama and head give another picture
_UNKNOWN_SIZE = (96, 48)
_PLACEHOLDER = Camera("panorama", 1, 1, 1.0, 1.0, 0.5, 0.5)
logger = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class CutOut:
    """A head's picture: where it is cut from, and where it goes."""

    source: Path
    projection: Projection
    head: PanoramaHead
    path: Path


@dataclass(frozen=True, eq=False)
class Panoramas:
    """How the panoramas of one epoch become images."""

    section: PanoramaSection
    heads: tuple[PanoramaHead, ...] | None  # None: the standard ones of each panorama's size
    folder: Path

    @staticmethod
    def of(section: PanoramaSection, heads: Path | None, folder: Path) -> Panoramas:
        known = None if heads is None else read_heads(heads, stitching_radius_m=section.stitching_radius_m)
        return Panoramas(section, known, folder)

    def images_of(self, panorama: Image) -> list[tuple[Image, CutOut]]:
        """The images of a panorama's heads: `<panorama>/<head>`, with the poses and priors that follow from its own."""
        return [self._image(panorama, head) for head in self._heads_of(panorama.path)]

    def _heads_of(self, path: Path) -> tuple[PanoramaHead, ...]:
        try:
            size = image_size(path)
        except OSError:  # it is rejected where it is read; its heads are listed all the same
            size = _UNKNOWN_SIZE
        return self.heads or standard_heads(self.section.projection, size)

    def _image(self, panorama: Image, head: PanoramaHead) -> tuple[Image, CutOut]:
        image_id = f"{panorama.image_id}/{head.name}"
        digest = _digest(panorama.path, self.section.projection, head)
        path = self.folder / quote(panorama.epoch) / quote(panorama.image_id, safe="") / f"{head.name}-{digest}.png"
        pose = None if panorama.world_from_cam is None else panorama.world_from_cam @ head.pano_from_head
        image = replace(
            panorama,
            image_id=image_id,
            station=panorama.image_id,
            path=path,
            camera=head.camera,
            world_from_cam=pose,
            gnss=_head_prior(panorama, head),
            heading_rad=_head_heading(panorama.heading_rad, head),
        )
        return image, CutOut(panorama.path, self.section.projection, head, path)


def with_heads(
    project: Project, epoch: str, images: list[Image], section: PanoramaSection | None
) -> tuple[Campaign, list[CutOut]]:
    """The campaign of an epoch, its panoramas replaced by their heads, and what is to be cut."""
    if section is None:
        return Campaign(epoch, tuple(images)), []
    heads = None if section.heads is None else project.data(section.heads)
    panoramas = Panoramas.of(section, heads, project.panorama_folder)
    pairs = [pair for image in images for pair in panoramas.images_of(image)]
    mountings = {image.image_id: Mounting(cut.head.name, cut.head.pano_from_head) for image, cut in pairs}
    return Campaign(epoch, tuple(image for image, _ in pairs), mountings), [cutout for _, cutout in pairs]


def placeholder(image_id: str, path: Path, epoch: str) -> Image:
    """A panorama before its heads are known."""
    return Image(image_id, path, _PLACEHOLDER, epoch)


def _head_heading(heading_rad: float | None, head: PanoramaHead) -> float | None:
    """The heading of a head on a level panorama; None where it looks up or down."""
    if heading_rad is None:
        return None
    level_from_pano = rotation_from_yaw_pitch_roll((heading_rad, 0.0, 0.0))
    heading = heading_of(level_from_pano @ head.pano_from_head.rotation)
    return None if np.isnan(heading) else heading % (2.0 * np.pi)


def _head_prior(panorama: Image, head: PanoramaHead) -> PositionPrior | None:
    """The head's own position: the panorama's moved by the head's offset, as far as the attitude is known.

    A level panorama is assumed; where there is no heading, the offset widens the covariance instead.
    """
    if panorama.gnss is None:
        return None
    right, down, forward = head.pano_from_head.translation
    position, cov = panorama.gnss.position_in_world, panorama.gnss.cov
    if panorama.heading_rad is None:
        spread = np.diag([0.5, 0.5, 0.0]) * (right**2 + forward**2)
        return PositionPrior(position - np.array([0.0, 0.0, down]), cov + spread)
    s, c = np.sin(panorama.heading_rad), np.cos(panorama.heading_rad)
    return PositionPrior(position + np.array([forward * s + right * c, forward * c - right * s, -down]), cov)


def _digest(path: Path, projection: Projection, head: PanoramaHead) -> str:
    try:
        status = path.stat()
        state: list[int | None] = [status.st_size, status.st_mtime_ns]
    except OSError:
        state = [None, None]
    camera, pose = head.camera, head.pano_from_head
    numbers = [camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy, head.stitching_radius_m]
    parts = [_VERSION, state, projection, numbers, pose.rotation.tolist(), pose.translation.tolist()]
    return hashlib.sha256(json.dumps(parts).encode()).hexdigest()[:12]


def is_panorama(path: Path, projection: Projection) -> bool:
    """Whether an image has the shape of its projection; a file that cannot be read is not judged."""
    try:
        return not expected_size(projection, image_size(path))
    except OSError:
        return True


def cut_missing(cutouts: Iterable[CutOut], executor: Executor) -> dict[Path, tuple[str, str]]:
    """Cuts the heads that are not there yet; those that cannot be cut, by their paths, with the reason."""
    pending: dict[Path, list[CutOut]] = {}
    for cutout in cutouts:
        if not cutout.path.is_file():
            pending.setdefault(cutout.source, []).append(cutout)
    failed: dict[Path, tuple[str, str]] = {}
    groups = list(pending.values())
    for group, failure in zip(groups, executor.map_items(cut, groups, "panoramas"), strict=True):
        if failure is not None:
            logger.warning("%s: %s", group[0].source, failure[1])
            failed.update({cutout.path: failure for cutout in group})
    return failed


def cut(group: list[CutOut]) -> tuple[str, str] | None:
    """Cuts heads of one panorama; why it could not, or None."""
    from georef.features.images import UnreadableImage

    try:
        return _cut(group)
    except UnreadableImage as error:
        return RejectReason.UNREADABLE.value, f"panorama {group[0].source.name}: {error.problem}"
    except Exception as error:
        return internal_failure(error, f"cutting of panorama {group[0].source.name}")


def _cut(group: list[CutOut]) -> tuple[str, str] | None:
    import cv2

    from georef.features.images import read_image
    from georef.features.panorama import cut_heads

    panorama = read_image(group[0].source)
    size, projection = (panorama.shape[1], panorama.shape[0]), group[0].projection
    if wanted := expected_size(projection, size):
        return RejectReason.WRONG_SIZE.value, f"{size[0]} x {size[1]} px; an image of {projection} is {wanted}"
    heads = tuple(cutout.head for cutout in group)
    for cutout, picture in zip(group, cut_heads(panorama, projection, heads), strict=True):
        _, data = cv2.imencode(".png", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_PNG_COMPRESSION, 3])
        write_bytes_atomically(data.tobytes(), cutout.path)
    return None
