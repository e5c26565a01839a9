"""What an epoch gives to its adjustment: images, points, observations and weighted constraints. No check point fits in.

`from_problem` makes the block of it that is adjusted.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from georef.estimation.reference_errors import ReferenceErrors
from georef.geometry.camera import Camera
from georef.geometry.projection import Views
from georef.geometry.rigid import Array, Rigid3
from georef.geometry.triangulation import triangulate
from georef.types.campaign import PosePrior, PositionPrior
from georef.types.constraints import ControlPoint
from georef.types.scene import Observations

_KNOWN_DEPTH = 0.1  # of its distance: a control point whose marks say less starts at its coordinates


@dataclass(frozen=True, eq=False)
class AutomaticGcps:
    """K ground control points that come from the reference images instead of a survey.

    `cov` is the image noise of their triangulation from references held at their given poses. What the references'
    own errors add is shared among points, and carried along as derivatives: it enters the posterior, not the weights,
    so that the result stays tied to the reference as it is published.
    """

    point: NDArray[np.int64]  # (K,) index in the problem's points, rising
    position: Array  # (K, 3) in world
    cov: Array  # (K, 3, 3)
    ray_gcp: NDArray[np.int64]  # (n,) of each reference ray: which of the K
    ray_reference: NDArray[np.int64]  # (n,) and which reference
    by_reference_pose: Array  # (n, 3, 6) derivative of the position
    reference_ids: tuple[str, ...]
    reference_errors: ReferenceErrors  # of the R references

    def __len__(self) -> int:
        return len(self.point)

    @staticmethod
    def none() -> AutomaticGcps:
        empty = np.zeros(0, np.int64)
        zero = np.zeros
        nobody = ReferenceErrors.independent(zero((0, 6, 6)))
        return AutomaticGcps(empty, zero((0, 3)), zero((0, 3, 3)), empty, empty, zero((0, 3, 6)), (), nobody)

    def take(self, keep: NDArray[np.bool_], renumber: NDArray[np.int64]) -> AutomaticGcps:
        """The GCPs to keep (K,), their points renumbered by (P,)."""
        rays = keep[self.ray_gcp]
        return replace(
            self,
            point=renumber[self.point[keep]],
            position=self.position[keep],
            cov=self.cov[keep],
            ray_gcp=(np.cumsum(keep) - 1)[self.ray_gcp[rays]],
            ray_reference=self.ray_reference[rays],
            by_reference_pose=self.by_reference_pose[rays],
        )


@dataclass(frozen=True, eq=False)
class Problem:
    """A bundle adjustment. Index i of the constraints is the image's position in `image_ids`."""

    image_ids: tuple[str, ...]
    cameras: tuple[Camera, ...]
    world_from_cams: tuple[Rigid3, ...]  # approximate values
    points: Array  # (P, 3) tie points and automatic GCPs, approximate values
    observations: Observations  # of `points`
    gcps: AutomaticGcps = field(default_factory=AutomaticGcps.none)
    pose_priors: Mapping[int, PosePrior] = field(default_factory=dict)
    position_priors: Mapping[int, PositionPrior] = field(default_factory=dict)
    control: tuple[ControlPoint, ...] = ()

    def __post_init__(self) -> None:
        if not all(isinstance(point, ControlPoint) for point in self.control):
            raise TypeError("only control points can take part in an adjustment")

    def restricted(self, observations: NDArray[np.bool_], gcps: NDArray[np.bool_]) -> Problem:
        """Only the observations and automatic GCPs to keep, and the points that these still determine."""
        kept = self.observations.take(observations)
        needed = np.full(len(self.points), 2)
        needed[self.gcps.point[gcps]] = 1
        enough = np.bincount(kept.point, minlength=len(self.points)) >= needed
        renumber = np.cumsum(enough) - 1
        kept = kept.take(enough[kept.point])
        return replace(
            self,
            points=self.points[enough],
            observations=kept.with_points(renumber[kept.point]),
            gcps=self.gcps.take(gcps & enough[self.gcps.point], renumber),
        )


def control_observations(problem: Problem) -> Observations:
    """Marks of the control points as observations; point index is the position in `problem.control`.

    Marks in images that are not part of the problem are left out.
    """
    return mark_observations(problem.control, problem.image_ids)


def mark_observations(points: Sequence[ControlPoint], image_ids: Sequence[str]) -> Observations:
    """The marks that control points have in some images; point index is the position among the points."""
    index = {name: i for i, name in enumerate(image_ids)}
    rows = [
        (p, index[mark.image_id], mark.pixel, mark.sigma_px)
        for p, point in enumerate(points)
        for mark in point.marks
        if mark.image_id in index
    ]
    return Observations(
        point=np.array([row[0] for row in rows], dtype=np.int64),
        view=np.array([row[1] for row in rows], dtype=np.int64),
        pixel=np.array([row[2] for row in rows], dtype=np.float64).reshape(-1, 2),
        sigma_px=np.array([row[3] for row in rows], dtype=np.float64),
        keypoint=np.full(len(rows), -1, dtype=np.int64),
    )


def control_start(problem: Problem) -> Array:
    """Where control points (C, 3) start: intersected from their marks, so that a robust loss can tell wrong coordinates
    from wrong marks; at their coordinates where the marks do not say."""
    marks, given = control_observations(problem), np.array([c.point_in_world for c in problem.control]).reshape(-1, 3)
    if not len(marks):
        return given
    views = Views.of(problem.world_from_cams, problem.cameras)
    found = triangulate(views, marks.point, marks.view, marks.pixel, marks.sigma_px, len(given))
    sigma = np.sqrt(np.trace(np.nan_to_num(found.cov), axis1=1, axis2=2))
    nearest = np.full(len(given), np.inf)
    np.minimum.at(nearest, marks.point, np.linalg.norm(found.points[marks.point] - views.centres[marks.view], axis=1))
    known = np.isfinite(found.points).all(axis=1) & (sigma < _KNOWN_DEPTH * nearest)
    return np.where(known[:, None], found.points, given)
