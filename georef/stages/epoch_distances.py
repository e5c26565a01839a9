"""Measured distances of an epoch: scale bars and taped lengths, between control points or points marked for them."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from georef.errors import InputError
from georef.estimation.adjustment.block import KINDS_OF_POINT, Block
from georef.estimation.adjustment.epoch_constraints import with_distances, with_marked_points
from georef.estimation.adjustment.problem import mark_observations
from georef.io.marks import check_marks, read_marks
from georef.io.motions import DistanceTable, read_distances
from georef.project import Project
from georef.stages.survey import Survey
from georef.types.constraints import ControlPoint, Mark

logger = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class DeclaredDistances:
    """A table of distances, and the points that are marked for them alone."""

    table: DistanceTable
    points: tuple[ControlPoint, ...]  # without coordinates


def read_declared_distances(project: Project, survey: Survey) -> DeclaredDistances | None:
    """What the project declares of distances. Raises InputError, also for ends that nothing determines."""
    section = project.file.epochs[survey.epoch.epoch].distances
    if section is None:
        return None
    table = read_distances(project.data(section.file))
    points = () if section.marks is None else _marked(project.data(section.marks), survey)
    _refuse_unknown_ends(table, points, survey, project.config.adjust.surveyed_control)
    return DeclaredDistances(table, points)


def with_measured_distances(project: Project, survey: Survey, block: Block) -> Block:
    """The block with the distances whose two ends its images determine."""
    declared = read_declared_distances(project, survey)
    if declared is None:
        return block
    priors, table, points = block.point_priors, declared.table, declared.points
    control = priors.kind == KINDS_OF_POINT.index("control")
    place = {name: int(priors.point[k]) for k, name in enumerate(priors.point_ids) if control[k]}
    if points:
        block, own = with_marked_points(block, mark_observations(points, block.image_ids), len(points))
        place |= {point.point_id: int(p) for point, p in zip(points, own, strict=True) if p >= 0}
    used = [k for k in range(len(table.a)) if table.a[k] in place and table.b[k] in place]
    if len(used) < len(table.a):
        message = "%s: %d of %d distances have an end that is not seen in two localized images"
        logger.warning(message, table.path, len(table.a) - len(used), len(table.a))
    a, b = (np.array([place[end[k]] for k in used], dtype=np.int64) for end in (table.a, table.b))
    return with_distances(block, a, b, table.distance_m[used], table.sigma_m[used])


def _marked(path: Path, survey: Survey) -> tuple[ControlPoint, ...]:
    """The points that a table of marks shows; none of them has coordinates."""
    marks = read_marks(path, repeats="mean")
    sizes = {i.image_id: (i.camera.width, i.camera.height) for i in survey.epoch.images}
    check_marks(marks, marks.point_ids, sizes)
    surveyed = {point.point_id for point in survey.control}
    both = next((name for name in marks.point_ids if name in surveyed), None)
    if both is not None:
        raise InputError(
            f"Point '{both}' is marked here and among the control points.",
            expected="points of distances that have no coordinates.",
            remedy="Delete its marks here: a distance may end at a control point.",
            path=path,
        )
    of_point: dict[str, list[Mark]] = {}
    for point, image, pixel, sigma in zip(marks.point_ids, marks.image_ids, marks.pixels, marks.sigmas_px, strict=True):
        of_point.setdefault(point, []).append(Mark(image, pixel, float(sigma)))
    return tuple(ControlPoint(name, np.zeros(3), np.eye(3), tuple(own)) for name, own in of_point.items())


def _refuse_unknown_ends(
    table: DistanceTable, points: Sequence[ControlPoint], survey: Survey, control_used: bool
) -> None:
    surveyed = {point.point_id for point in survey.control}
    known = surveyed | {point.point_id for point in points}
    for k, name in [(row, end[row]) for row in range(len(table.a)) for end in (table.a, table.b)]:
        if name not in known or (name in surveyed and not control_used):
            why = "is neither marked nor a control point" if name not in known else "is control that takes no part"
            raise InputError(
                f"The distance from '{table.a[k]}' to '{table.b[k]}' ends at '{name}', which {why}.",
                expected="points of the table of marks (distances.marks), or control points that take part.",
                remedy="Correct the name, add its marks, or set adjust.surveyed_control = true.",
                path=table.path,
                row=int(table.rows[k]),
            )
