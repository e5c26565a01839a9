"""True poses of new images, read for comparison alone: no stage of the pipeline is given them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import numpy as np

from georef.crs import CrsDefinition, WorldFrame, crs_kind
from georef.errors import InputError
from georef.evaluation.pose_errors import TruthSigmas
from georef.geometry.rigid import Rigid3
from georef.io.columns import CrsKind
from georef.io.declarations import check_declared_crs, check_declared_height
from georef.io.pose_records import PoseTable
from georef.io.poses import read_poses
from georef.project import Project
from georef.stages.survey import load_survey, world_poses


@dataclass(frozen=True, eq=False)
class Truth:
    """True world_from_cam of new images, in the world of the project, and how well they are known."""

    poses: Mapping[str, Rigid3]
    sigmas: TruthSigmas


@dataclass(frozen=True, eq=False)
class TruthFile:
    """The content of a file of true poses, of images of the epoch alone."""

    table: PoseTable
    sigmas: TruthSigmas

    def __len__(self) -> int:
        return sum(record.has_pose for record in self.table.records)

    def in_world(self, world: WorldFrame) -> Truth:
        """The poses in a project's world."""
        posed = [record for record in self.table.records if record.has_pose]
        positions = np.array([record.position_in_crs for record in posed])
        axes = np.array([record.axes_from_cam for record in posed])
        names = (record.image_id for record in posed)
        return Truth(dict(zip(names, world_poses(world, positions, axes), strict=True)), self.sigmas)


def read_truth(path: Path, project: Project, epoch: str, sigmas: TruthSigmas) -> TruthFile:
    """The true poses of images of an epoch, in the project's CRS. Raises InputError: another CRS, no such image."""
    section = project.file.crs
    definition = CrsDefinition(section.horizontal, section.height)
    table = read_poses(path, crs_kind=cast(CrsKind, crs_kind(definition)))
    check_declared_crs(table, section.horizontal)
    if section.height is not None:
        check_declared_height(table, section.height)
    images = [image.image_id for image in load_survey(project, epoch).epoch.images]
    known = set(images)
    records = tuple(record for record in table.records if record.has_pose and record.image_id in known)
    if not records:
        first = table.records[0].image_id if table.records else "none"
        raise InputError(
            f"No image of epoch {epoch} has a true pose; the first there is '{first}'.",
            expected=f"image names as in the project, such as '{images[0]}'.",
            remedy="Correct the names, or name the right file with --truth and the epoch with --epoch.",
            path=path,
        )
    return TruthFile(PoseTable(table.path, table.declared, table.crs_kind, records), sigmas)
