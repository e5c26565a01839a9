"""Cameras of a recording: pinholes with their pictures, and the measured marks in them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
import rerun as rr

from georef.geometry.camera import ideal_from_observed
from georef.geometry.rigid import Array, Rigid3
from georef.types.campaign import Image
from georef.types.constraints import CheckPoint, ControlPoint, Mark
from georef.viewer.pictures import picture_jpeg, small_pinhole
from georef.viewer.scene import new_with_picture, reference_with_picture
from georef.viewer.writer import NEW, REFERENCE, Rgb, Writer

_FRUSTUM_SHARE, _FRUSTUM_M = 0.03, (0.3, 10.0)


def log_cameras(writer: Writer) -> None:
    scene = writer.scene
    new, near = new_with_picture(scene), reference_with_picture(scene)
    marks = _marks_by_image([*scene.check, *scene.control])
    for image in new:
        parts: list[object] = ["world", "new", image.image_id]
        _log_camera(writer, parts, image, scene.adjusted[image.image_id], NEW)
        _log_marks(writer, [*parts, "marks"], image, marks.get(image.image_id, []))
        writer.image_paths.append((image.image_id, rr.new_entity_path(parts)))
    for image, pose in (scene.reference[i] for i in near):
        _log_camera(writer, ["world", "reference", image.image_id], image, pose, REFERENCE)
    writer.legend += [
        ("world/new", "new cameras at their adjusted poses, orange"),
        ("world/reference", "reference, grey"),
    ]
    shown = {image.image_id for image in new}
    others = [pose.translation for name, pose in scene.adjusted.items() if name not in shown]
    _log_others(writer, "world/new_others", others, NEW)
    far = np.setdiff1d(np.arange(len(scene.reference)), near)
    _log_others(writer, "world/reference_others", list(scene.reference_centres[far]), REFERENCE)


def _log_camera(writer: Writer, path: list[object], image: Image, world_from_cam: Rigid3, color: Rgb) -> None:
    small = small_pinhole(image.camera, writer.longest_side_px)
    distance = float(np.clip(_FRUSTUM_SHARE * writer.scene.focus[1], *_FRUSTUM_M))
    pinhole = rr.Pinhole(
        resolution=[small.width, small.height],
        focal_length=small.focal,
        principal_point=small.centre,
        camera_xyz=rr.ViewCoordinates.RDF,
        image_plane_distance=distance,
        color=color,
    )
    pose = rr.Transform3D(translation=world_from_cam.translation, mat3x3=world_from_cam.rotation)
    picture = picture_jpeg(image.path, image.camera, small)
    shown = [] if picture is None else [rr.EncodedImage(contents=picture, media_type="image/jpeg")]
    writer.log(path, pose, pinhole, *shown)


def _log_others(writer: Writer, path: str, centres: Sequence[Array], color: Rgb) -> None:
    if centres:
        writer.log(path, rr.Points3D(np.array(centres), colors=color, radii=rr.Radius.ui_points(2.5)))
        writer.legend.append((path, f"{len(centres)} more cameras, without their pictures"))


def _marks_by_image(points: Iterable[CheckPoint | ControlPoint]) -> dict[str, list[tuple[str, Mark]]]:
    out: dict[str, list[tuple[str, Mark]]] = {}
    for point in points:
        for mark in point.marks:
            out.setdefault(mark.image_id, []).append((point.point_id, mark))
    return out


def _log_marks(writer: Writer, path: list[object], image: Image, marks: list[tuple[str, Mark]]) -> None:
    """The measured marks, at their place in the undistorted picture."""
    if not marks:
        return
    small = small_pinhole(image.camera, writer.longest_side_px)
    pixels = ideal_from_observed(image.camera, np.array([mark.pixel for _, mark in marks])) * small.scale
    names = [f"{name} (mark)" for name, _ in marks]
    writer.log(path, rr.Points2D(pixels, labels=names, show_labels=False, colors=NEW, radii=rr.Radius.ui_points(4.0)))
