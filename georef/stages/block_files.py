"""Files that an adjusted block leaves: poses with covariances, and calibrations."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from georef.estimation.adjustment.measured.solutions import Solved
from georef.geometry.camera import Camera
from georef.io.camera_table import CAMERA_COLUMNS, COEFFICIENT_COLUMNS
from georef.io.files import write_text_atomically
from georef.io.pose_records import PoseRecord, PosesFrame
from georef.io.poses import write_poses
from georef.stages.block_survey import BlockSurvey


def write_block_poses(survey: BlockSurvey, solved: Solved, path: Path) -> None:
    """Poses of all images in the CRS of the project, with their covariances."""
    block, state, world = solved.block, solved.solution.state, survey.world
    poses, covs = block.world_from_cam(state), solved.cofactors.images(block, state)
    positions = world.crs_from_world(poses.translation)
    turns = world.crs_axes_from_world(positions)
    records = (
        PoseRecord(image, "adjusted", position, turn @ rotation, cov)
        for image, position, turn, rotation, cov in zip(
            block.image_ids, positions, turns, poses.rotation, covs, strict=True
        )
    )
    definition, origin = world.definition, ", ".join(f"{value:.3f}" for value in world.origin_in_crs)
    kind = world.describe()["kind"]
    write_poses(records, path, PosesFrame(kind, definition.horizontal, definition.height, f"{origin} of this CRS"))


def write_block_cameras(solved: Solved, path: Path) -> None:
    """Calibrations as a table of cameras, with the sigmas of what was estimated (px, or without unit)."""
    layout, state = solved.cofactors.layout, solved.solution.state
    sigmas = np.sqrt(np.diag(solved.cofactors.border))
    estimated = [name for name in ("focal", "cx", "cy", "aspect", *COEFFICIENT_COLUMNS) if _any(state.cameras, name)]
    lines = [",".join([*CAMERA_COLUMNS, "model", *COEFFICIENT_COLUMNS, *(f"sigma_{name}" for name in estimated)])]
    for at, camera in zip(layout.calibration, state.cameras, strict=True):
        own = {name: sigmas[at + k] * camera.unit(name) for k, name in enumerate(camera.estimate)} if at >= 0 else {}
        values = (camera.fx, camera.fy, camera.cx, camera.cy)
        coefficients = dict(zip(camera.lens.parameters, camera.coefficients, strict=False))
        cells = [camera.camera_id, camera.width, camera.height, *(f"{v:.5f}" for v in values), camera.model]
        cells += [f"{coefficients[name]:.12g}" if name in coefficients else "" for name in COEFFICIENT_COLUMNS]
        cells += [f"{own[name]:.6g}" if name in own else "" for name in estimated]
        lines.append(",".join(map(str, cells)))
    write_text_atomically("\n".join(lines) + "\n", path)


def _any(cameras: tuple[Camera, ...], name: str) -> bool:
    return any(name in camera.estimate for camera in cameras)
