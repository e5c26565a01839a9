"""Calibrations of a block beside those of another program."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np

from georef.errors import InputError
from georef.estimation.adjustment.measured.correlations import unknowns_of
from georef.estimation.adjustment.measured.solutions import Solved
from georef.evaluation.calibrations import compare_calibrations, difference_map
from georef.geometry.camera import Camera
from georef.io.pix4d import Pix4dPoses, read_pix4d_cameras, read_pix4d_poses
from georef.project import Project
from georef.sections import BlockComparison

_GRID = 13


def comparisons(project: Project, section: BlockComparison, found: Solved) -> list[dict[str, Any]]:
    """Each camera that the other program knows. Raises InputError."""
    ours = {camera.camera_id: camera for camera in found.solution.state.cameras}
    theirs = _theirs(project, section, found, ours)
    sigmas = {unknown.name: unknown.sigma for unknown in unknowns_of(found)}
    return [_comparison(ours[name], camera, section.format, sigmas) for name, camera in theirs.items()]


def _theirs(project: Project, section: BlockComparison, found: Solved, ours: dict[str, Camera]) -> dict[str, Camera]:
    """Their cameras by our ids."""
    if section.parameters is not None:
        return _of_images(read_pix4d_poses(project.data(section.parameters)), found)
    assert section.camera is not None, "validated: a comparison names a file"
    path, order = project.data(section.camera), section.order or tuple(ours)
    unknown = [name for name in order if name not in ours]
    if unknown:
        raise InputError(
            f"compare.order names the camera '{unknown[0]}', which took no image.",
            expected=f"the cameras {', '.join(ours)} in the order of the file.",
            remedy="Correct the list in project.toml.",
            path=path,
        )
    read = read_pix4d_cameras(path, [(ours[name].width, ours[name].height) for name in order])
    return dict(zip(order, read, strict=True))


def _of_images(poses: Pix4dPoses, found: Solved) -> dict[str, Camera]:
    """The camera of the first image of each of ours that their file has."""
    theirs = dict(zip(poses.image_ids, poses.cameras, strict=True))
    theirs |= {name.rsplit(".", 1)[0]: camera for name, camera in theirs.items()}
    out: dict[str, Camera] = {}
    for image, calibration in zip(found.block.image_ids, found.block.calibration, strict=True):
        camera = theirs.get(image, theirs.get(image.rsplit(".", 1)[0]))
        if camera is not None:
            out.setdefault(found.block.calibrations[calibration].camera.camera_id, camera)
    if not out:
        raise InputError(
            "No image of the block is in the file of the other program's parameters.",
            expected=f"names such as '{found.block.image_ids[0]}'.",
            remedy="Name the file of the same block.",
            path=poses.path,
        )
    return out


def _comparison(ours: Camera, theirs: Camera, program: str, sigmas: dict[str, float]) -> dict[str, Any]:
    names = [name for name in ours.estimate if name in ("focal", "cx", "cy") or name in theirs.lens.parameters]
    pixels, differences = difference_map(ours, theirs, _GRID)
    return {
        "program": program,
        "camera": ours.camera_id,
        "parameters": [
            {
                "name": name,
                "value": ours.value(name),
                "sigma": sigmas.get(f"{name} of {ours.camera_id}"),
                "other": theirs.value(name),
            }
            for name in names
        ],
        **asdict(compare_calibrations(ours, theirs)),
        "size_px": [ours.width, ours.height],
        "map_px": np.column_stack([pixels, differences]).round(4).tolist(),
    }
