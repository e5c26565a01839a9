"""Which camera took which image: by a column of a table, by the image's folder, or the only one there is."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from georef.errors import InputError
from georef.geometry.camera import ESTIMABLE, Camera
from georef.io.camera_table import DEFAULT_FOCAL, read_cameras
from georef.io.exif import image_size, size_and_focal

_UNREADABLE = (65536, 65536)  # no mark is outside of it


@dataclass(frozen=True)
class Stated:
    """The cameras that a table of images names: image id -> camera id, "" where it names none; rows for messages."""

    path: Path | None = None
    cameras: Mapping[str, str] = field(default_factory=dict)
    rows: Mapping[str, int] = field(default_factory=dict)

    @staticmethod
    def of(path: Path, image_ids: Sequence[str], cameras: Sequence[str], rows: Sequence[int]) -> Stated:
        return Stated(path, dict(zip(image_ids, cameras, strict=True)), dict(zip(image_ids, rows, strict=True)))


@dataclass(frozen=True)
class CameraTable:
    """The cameras of an epoch and the table that they stand in."""

    cameras: Mapping[str, Camera]
    path: Path

    @staticmethod
    def read(path: Path) -> CameraTable:
        return CameraTable(read_cameras(path), path)

    def camera_of(self, image_id: str, stated: Stated) -> Camera:
        """The camera of an image. Raises InputError where nothing says which it is."""
        name = stated.cameras.get(image_id, "")
        if name:
            return self._named(name, image_id, stated)
        if len(self.cameras) == 1:
            return next(iter(self.cameras.values()))
        folders = image_id.split("/")[:-1]
        found = [folder for folder in folders if folder in self.cameras]
        if found:
            return self.cameras[found[-1]]
        raise InputError(
            f"Nothing says which of {len(self.cameras)} cameras took image '{image_id}': {self._list()}.",
            expected="a column `camera` in the table of the images, or a folder for each camera, named by its id.",
            remedy=_table_remedy(stated) + "move the image into the folder of its camera, or give the epoch a table "
            "of one camera.",
            path=self.path,
        )

    def _named(self, name: str, image_id: str, stated: Stated) -> Camera:
        if name not in self.cameras:
            raise InputError(
                f"Image '{image_id}' is said to be of camera '{name}', which the table of cameras does not have.",
                expected=f"one of {self._list()}, as {self.path} has them.",
                remedy="Correct the column `camera`, or add the camera to that table.",
                path=stated.path,
                row=stated.rows.get(image_id),
            )
        return self.cameras[name]

    def _list(self) -> str:
        names = list(self.cameras)
        return ", ".join(names[:5]) + (" ..." if len(names) > 5 else "")


def _table_remedy(stated: Stated) -> str:
    return f"Add the column to {stated.path}, " if stated.path is not None else "Name a table with that column, "


def require_known(camera: Camera, path: Path) -> Camera:
    """A reference image's camera. Raises InputError where its table says that it is to be estimated."""
    if camera.estimate:
        raise InputError(
            f"Camera '{camera.camera_id}' is to be estimated ({', '.join(camera.estimate)}), and reference images "
            "were taken with it.",
            expected="calibrated cameras for the reference: all else is measured against it.",
            remedy="Calibrate the camera, or use its images as a new epoch.",
            path=path,
        )
    return camera


def unknown_camera(path: Path, unknown: tuple[str, ...]) -> Camera:
    """A camera of which only the picture is known: it starts from the focal length of EXIF, or from the usual one.

    A file that cannot be read gets a camera of any size; the image is rejected as unreadable before it matters.
    """
    try:
        size, focal = size_and_focal(path)
    except OSError:
        size, focal = _UNREADABLE, None
    start = DEFAULT_FOCAL * max(size) if focal is None else focal
    camera_id = f"unknown {size[0]}x{size[1]} {start:.0f} px"
    return Camera(camera_id, *size, start, start, size[0] / 2.0, size[1] / 2.0, estimate=unknown)


def with_unknown(camera: Camera, unknown: tuple[str, ...], path: Path) -> Camera:
    """The camera of one image, with what its epoch declares to be estimated.

    Where the table says no focal length, EXIF does, if it can.
    """
    names = tuple(name for name in ESTIMABLE if name in {*camera.estimate, *unknown})
    if not names:
        return camera
    started = replace(camera, estimate=names)
    if "focal" in camera.estimate and camera.fx == camera.fy == DEFAULT_FOCAL * max(camera.width, camera.height):
        try:
            focal = size_and_focal(path)[1]
        except OSError:
            focal = None
        return started if focal is None else replace(started, fx=focal, fy=focal)
    return started


def pinhole_of_row(image_id: str, intrinsics: Sequence[float], path: Path) -> Camera:
    """The camera whose fx, fy, cx, cy stand beside an image's orientation; of any size where the file is no image."""
    try:
        width, height = image_size(path)
    except OSError:  # it is rejected as unreadable before the size matters
        width, height = _UNREADABLE
    fx, fy, cx, cy = (float(v) for v in intrinsics)
    return Camera(image_id, width, height, fx, fy, cx, cy)
