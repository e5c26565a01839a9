"""Check points against the adjusted block: differences, what was predicted of them, and their summary.

Differences are estimated minus reference, along the axes of the world (east, north, up). Absolute and relative check
points answer different questions and are never pooled.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from georef.evaluation.check_summary import CheckPointSummary, summarize_differences
from georef.evaluation.forward_intersection import (
    Intersection,
    JointPoseCov,
    PosedImages,
    intersect,
    points_cov_from_poses,
)
from georef.evaluation.mark_sigma import MarkSigmaComponent, component_of, mark_sigma_component
from georef.evaluation.statistics import finite, finite_list, nees
from georef.geometry.covariance import symmetric
from georef.geometry.rigid import Array
from georef.types.constraints import CheckKind, CheckPoint

__all__ = [
    "CheckPointError",
    "CheckPointErrors",
    "CheckPointReport",
    "CheckPointSummary",
    "JointPoseCov",
    "MarkSigmaComponent",
    "NotDetermined",
    "PosedImages",
    "check_point_errors",
    "evaluate_check_points",
    "mark_sigma_component",
    "point_error",
]


@dataclass(frozen=True, eq=False)
class CheckPointError:
    """Estimated minus reference coordinates of one check point."""

    point_id: str
    kind: CheckKind
    difference_m: Array  # (3,) dE, dN, dH
    image_count: int
    mark_count: int
    residual_rms_px: float  # of both coordinates of all marks, observed pixels
    predicted_cov: Array | None  # (3, 3) of the difference, m^2; None where the covariance of the poses is unknown

    @property
    def distance_m(self) -> float:
        """Length of the difference in 3D."""
        return float(np.linalg.norm(self.difference_m))

    @property
    def predicted_sigma_m(self) -> Array | None:
        """1-sigma (3,) of the difference, east, north, up."""
        return None if self.predicted_cov is None else np.sqrt(np.diag(self.predicted_cov))

    @property
    def nees(self) -> float | None:
        """difference' predicted_cov^-1 difference, 3 degrees of freedom."""
        return None if self.predicted_cov is None else nees(self.difference_m, self.predicted_cov)

    def to_dict(self) -> dict[str, object]:
        """Plain values for JSON."""
        de, dn, dh = finite_list(self.difference_m) or [None] * 3
        return {
            "point_id": self.point_id,
            "kind": str(self.kind),
            "de_m": de,
            "dn_m": dn,
            "dh_m": dh,
            "distance_m": finite(self.distance_m),
            "image_count": self.image_count,
            "mark_count": self.mark_count,
            "residual_rms_px": finite(self.residual_rms_px),
            "predicted_sigma_m": finite_list(self.predicted_sigma_m),
            "nees": finite(self.nees),
        }


@dataclass(frozen=True)
class NotDetermined:
    """A check point that could not be intersected, and why."""

    point_id: str
    kind: CheckKind
    mark_count: int  # in posed images
    reason: str

    def to_dict(self) -> dict[str, object]:
        """Plain values for JSON."""
        return {
            "point_id": self.point_id,
            "kind": str(self.kind),
            "mark_count": self.mark_count,
            "reason": self.reason,
        }


@dataclass(frozen=True, eq=False)
class CheckPointErrors:
    """Every check point, in one of two lists."""

    determined: tuple[CheckPointError, ...]
    not_determined: tuple[NotDetermined, ...] = ()
    joint_cov: Array | None = None  # (3P, 3P) of the P differences that are determined, m^2; None: unknown

    def summarize(self) -> dict[CheckKind, CheckPointSummary]:
        """One summary for each kind that occurs."""
        kinds = {entry.kind for entry in (*self.determined, *self.not_determined)}
        return {kind: self._summary(kind) for kind in CheckKind if kind in kinds}

    def _summary(self, kind: CheckKind) -> CheckPointSummary:
        rows = [i for i, error in enumerate(self.determined) if error.kind == kind]
        chosen = [self.determined[i] for i in rows]
        differences = np.array([error.difference_m for error in chosen]).reshape(-1, 3)
        missing = sum(entry.kind == kind for entry in self.not_determined)
        joint = None if self.joint_cov is None else _blocks(self.joint_cov, rows)
        values = [error.nees for error in chosen]
        return summarize_differences(kind, differences, values, joint_cov=joint, not_determined=missing)


@dataclass(frozen=True)
class CheckPointReport:
    """All that is known of the check points, with the sigmas of the marks as stated and as estimated."""

    errors: CheckPointErrors  # with the stated sigmas
    component: MarkSigmaComponent
    summaries: dict[CheckKind, CheckPointSummary]  # with the stated sigmas
    summaries_estimated: dict[CheckKind, CheckPointSummary] | None  # with the estimated ones; None: not estimable

    def to_dict(self) -> dict[str, object]:
        """Plain values for JSON, free of NaN and infinity."""
        estimated = self.summaries_estimated
        return {
            "mark_sigma_component": self.component.to_dict(),
            "summaries": {str(kind): value.to_dict() for kind, value in self.summaries.items()},
            "summaries_with_estimated_mark_sigma": None
            if estimated is None
            else {str(kind): value.to_dict() for kind, value in estimated.items()},
            "points": [error.to_dict() for error in self.errors.determined],
            "not_determined": [entry.to_dict() for entry in self.errors.not_determined],
        }


def evaluate_check_points(points: Sequence[CheckPoint], images: PosedImages) -> CheckPointReport:
    """Errors and summaries of all check points, and the variance component of their marks.

    The estimated component changes no coordinates, only what is predicted of them.
    """
    found = [intersect(point, images) for point in points]
    component = component_of([entry for entry in found if isinstance(entry, Intersection)], images)
    stated = _errors(points, found, images, 1.0)
    estimated = None if component.factor is None else _errors(points, found, images, component.factor).summarize()
    return CheckPointReport(stated, component, stated.summarize(), estimated)


def check_point_errors(
    points: Sequence[CheckPoint], images: PosedImages, *, sigma_factor: float = 1.0
) -> CheckPointErrors:
    """Differences of check points that are intersected from posed images; sigma_factor scales their marks' sigmas.

    predicted_cov adds the noise of the marks, the poses with their correlations between images, and the covariance of
    an absolute point, taken as independent. A relative point is part of the reference: give `images` the covariance of
    the poses against the reference as it is published; the point's own sigma, which says how well the reference is
    known, earns no credit. Raises ValueError where sigma_factor is not positive.
    """
    if not sigma_factor > 0:
        raise ValueError("sigma_factor must be positive")
    return _errors(points, [intersect(point, images) for point in points], images, sigma_factor)


def _errors(
    points: Sequence[CheckPoint], found: Sequence[Intersection | str], images: PosedImages, factor: float
) -> CheckPointErrors:
    pairs = [(p, entry) for p, entry in zip(points, found, strict=True) if isinstance(entry, Intersection)]
    joint = None if images.joint_cov is None else _joint_cov(pairs, images.joint_cov, factor)
    missing = [
        NotDetermined(p.point_id, p.kind, sum(mark.image_id in images.index for mark in p.marks), entry)
        for p, entry in zip(points, found, strict=True)
        if isinstance(entry, str)
    ]
    covs = [None if joint is None else _blocks(joint, [i]) for i in range(len(pairs))]
    determined = [point_error(p, entry, cov) for (p, entry), cov in zip(pairs, covs, strict=True)]
    return CheckPointErrors(tuple(determined), tuple(missing), joint)


def _joint_cov(pairs: list[tuple[CheckPoint, Intersection]], poses_cov: JointPoseCov, factor: float) -> Array:
    """Joint covariance (3P, 3P) of the differences: poses, marks, and the reference coordinates."""
    out = symmetric(points_cov_from_poses([found for _, found in pairs], poses_cov))
    for i, (point, found) in enumerate(pairs):
        own = point.cov if point.kind is CheckKind.ABSOLUTE else np.zeros((3, 3))
        out[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] += symmetric(factor**2 * found.mark_cov + own)
    return out


def _blocks(joint: Array, rows: list[int]) -> Array:
    """The joint covariance (3k, 3k) of k of the points."""
    index = (3 * np.array(rows, dtype=np.int64)[:, None] + np.arange(3)).ravel()
    return joint[np.ix_(index, index)]


def point_error(point: CheckPoint, found: Intersection, predicted_cov: Array | None) -> CheckPointError:
    """What an intersected point differs by."""
    return CheckPointError(
        point.point_id,
        point.kind,
        found.point - point.point_in_world,
        len(found.images),
        len(found.residual_px),
        float(np.sqrt(np.mean(np.square(found.residual_px)))),
        predicted_cov,
    )
