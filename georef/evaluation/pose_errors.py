"""Estimated poses against the truth: errors, recall at thresholds, and whether their covariances are true.

An image that has no estimate counts as infinitely wrong wherever all images are summarised.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from georef.evaluation.statistics import (
    Interval,
    NeesSummary,
    finite,
    finite_list,
    median_interval,
    nees,
    summarize_nees,
    wilson_interval,
)
from georef.geometry.rigid import Array, Rigid3, rotation_angle
from georef.types.campaign import require_covariance

PoseWithCov = tuple[Rigid3, Array | None]

THRESHOLDS: tuple[tuple[float, float], ...] = (
    (0.01, 0.1),
    (0.025, 0.25),
    (0.05, 0.5),
    (0.1, 1.0),
    (0.2, 2.0),
    (0.5, 5.0),
    (1.0, 10.0),
)
"""(position m, rotation deg) that an image must both keep to be counted."""


@dataclass(frozen=True)
class TruthSigmas:
    """How well the truth is known itself: 1-sigma per axis, zero where it is exact."""

    position_m: float = 0.0
    rotation_rad: float = 0.0

    def __post_init__(self) -> None:
        if not (0.0 <= self.position_m < np.inf and 0.0 <= self.rotation_rad < np.inf):
            raise ValueError("the sigmas of the truth must be finite and not negative")

    @property
    def cov(self) -> Array:
        """Covariance (6, 6) of the true pose, (rad, m); isotropic, hence the same in camera and world axes."""
        return np.diag(np.square([self.rotation_rad] * 3 + [self.position_m] * 3))


@dataclass(frozen=True, eq=False)
class PoseError:
    """Estimated minus true pose of one image; infinite where it has no estimate."""

    image_id: str
    offset_m: Array | None  # (3,) dE, dN, dH of the camera centre, world axes; None without an estimate
    position_m: float  # 3D distance of the camera centres
    rotation_rad: float  # angle between the attitudes
    nees: float | None = None  # 6 degrees of freedom; None without a covariance
    nees_position: float | None = None  # 3
    nees_rotation: float | None = None  # 3

    @property
    def has_estimate(self) -> bool:
        return self.offset_m is not None

    def to_dict(self) -> dict[str, object]:
        """Plain values for JSON: metres and degrees; None where the image has no estimate."""
        offset = finite_list(self.offset_m) or [None] * 3
        return {
            "image_id": self.image_id,
            "de_m": offset[0],
            "dn_m": offset[1],
            "dh_m": offset[2],
            "position_m": finite(self.position_m),
            "rotation_deg": finite(np.rad2deg(self.rotation_rad)),
            "nees": finite(self.nees),
            "nees_position": finite(self.nees_position),
            "nees_rotation": finite(self.nees_rotation),
        }


@dataclass(frozen=True)
class ErrorQuantiles:
    """Median and maximum of one kind of error, in its unit."""

    median: float  # over all images, those without an estimate infinite; NaN without images
    median_interval: Interval | None  # 95 % by order statistics; None for fewer than 6 images
    median_estimated: float  # over the images that have an estimate; NaN without
    maximum_estimated: float

    @staticmethod
    def of(values: Sequence[float] | Array) -> ErrorQuantiles:
        """Of errors (N,) with infinity for an image without an estimate."""
        every = np.asarray(values, dtype=np.float64)
        known = every[np.isfinite(every)]
        middle, largest = (float(np.median(known)), float(known.max())) if len(known) else (np.nan, np.nan)
        return ErrorQuantiles(_median(every), median_interval(every), middle, largest)

    def to_dict(self) -> dict[str, object]:
        """Plain values for JSON; None for what is infinite or has no images."""
        return {
            "median": finite(self.median),
            "median_interval_95": finite_list(self.median_interval),
            "median_estimated": finite(self.median_estimated),
            "maximum_estimated": finite(self.maximum_estimated),
        }


@dataclass(frozen=True)
class Recall:
    """Percentage of all images within a position and a rotation threshold at once."""

    position_m: float
    rotation_deg: float
    percent: float  # NaN without images
    interval: Interval | None  # 95 %, Wilson; None without images


@dataclass(frozen=True, eq=False)
class PoseErrors:
    """Errors of all images that should have a pose, in their order, and their summary."""

    errors: tuple[PoseError, ...]
    without_truth: tuple[str, ...]  # estimates that could not be compared
    position_m: ErrorQuantiles
    rotation_deg: ErrorQuantiles
    mean_offset_m: Array | None  # (3,) bias dE, dN, dH of the estimated images; None without
    rmse_offset_m: Array | None  # (3,) per axis
    recall: tuple[Recall, ...]
    nees: NeesSummary  # 6 degrees of freedom
    nees_position: NeesSummary  # 3
    nees_rotation: NeesSummary  # 3

    @property
    def failed(self) -> tuple[str, ...]:
        """Images without an estimate."""
        return tuple(error.image_id for error in self.errors if not error.has_estimate)

    def to_dict(self) -> dict[str, object]:
        """Plain values for JSON, free of NaN and infinity."""
        return {
            "image_count": len(self.errors),
            "failed": list(self.failed),
            "without_truth": list(self.without_truth),
            "position_m": self.position_m.to_dict(),
            "rotation_deg": self.rotation_deg.to_dict(),
            "mean_offset_m": finite_list(self.mean_offset_m),
            "rmse_offset_m": finite_list(self.rmse_offset_m),
            "recall": [
                {
                    "position_m": r.position_m,
                    "rotation_deg": r.rotation_deg,
                    "percent": finite(r.percent),
                    "interval_95": finite_list(r.interval),
                }
                for r in self.recall
            ],
            "nees": self.nees.to_dict(),
            "nees_position": self.nees_position.to_dict(),
            "nees_rotation": self.nees_rotation.to_dict(),
            "images": [error.to_dict() for error in self.errors],
        }


def compare_poses(
    estimated: Mapping[str, PoseWithCov],
    truth: Mapping[str, Rigid3],
    *,
    truth_sigmas: TruthSigmas | None = None,
    expected: Iterable[str] | None = None,
) -> PoseErrors:
    """Errors of world_from_cam estimates and whether they agree with their covariances.

    estimated: image id -> pose and its covariance (6, 6) in (rad, m), right perturbation, or None. Rejected images are
    left out of it. expected: the images that should have a pose, all of `truth` where it is None. Raises ValueError:
    an expected image without truth, a pose that is not finite, a covariance that is none.
    """
    names = tuple(dict.fromkeys(truth if expected is None else expected))
    unknown = [name for name in names if name not in truth]
    if unknown:
        raise ValueError(f"images without a true pose cannot be judged: {unknown[:5]}")
    truth_cov = (truth_sigmas or TruthSigmas()).cov
    errors = tuple(pose_error(name, estimated.get(name), truth[name], truth_cov) for name in names)
    return summarize_errors(errors, tuple(name for name in estimated if name not in truth))


def pose_error(image_id: str, estimate: PoseWithCov | None, truth: Rigid3, truth_cov: Array) -> PoseError:
    """The error of one image; truth_cov (6, 6), (rad, m), right perturbation of the true pose. ValueError as above.

    NEES = xi' S^-1 xi with estimate @ Exp(xi) = truth and S the sum of both covariances, to first order in xi.
    """
    if estimate is None:
        return PoseError(image_id, None, np.inf, np.inf)
    pose, cov = estimate
    if not (np.isfinite(pose.rotation).all() and np.isfinite(pose.translation).all()):
        raise ValueError(f"the estimated pose of {image_id} is not finite")
    offset = pose.translation - truth.translation
    length, angle = float(np.linalg.norm(offset)), rotation_angle(pose.rotation.T @ truth.rotation)
    if cov is None:
        return PoseError(image_id, offset, length, angle)
    require_covariance(cov, 6)
    xi, both = pose.local(truth), cov + truth_cov
    parts = nees(xi, both), nees(xi[3:], both[3:, 3:]), nees(xi[:3], both[:3, :3])
    return PoseError(image_id, offset, length, angle, *parts)


def summarize_errors(errors: tuple[PoseError, ...], without_truth: tuple[str, ...] = ()) -> PoseErrors:
    """The errors of images and their summary; without_truth: estimates that could not be compared."""
    position_m = np.array([error.position_m for error in errors])
    rotation_deg = np.rad2deg([error.rotation_rad for error in errors])
    offsets = np.array([error.offset_m for error in errors if error.offset_m is not None])
    return PoseErrors(
        errors=errors,
        without_truth=without_truth,
        position_m=ErrorQuantiles.of(position_m),
        rotation_deg=ErrorQuantiles.of(rotation_deg),
        mean_offset_m=offsets.mean(axis=0) if len(offsets) else None,
        rmse_offset_m=np.sqrt(np.mean(np.square(offsets), axis=0)) if len(offsets) else None,
        recall=tuple(_recall(position_m, rotation_deg, *limits) for limits in THRESHOLDS),
        nees=summarize_nees((error.nees for error in errors), 6),
        nees_position=summarize_nees((error.nees_position for error in errors), 3),
        nees_rotation=summarize_nees((error.nees_rotation for error in errors), 3),
    )


def _recall(position_m: Array, rotation_deg: Array, limit_m: float, limit_deg: float) -> Recall:
    within = (position_m <= limit_m) & (rotation_deg <= limit_deg)
    percent = 100.0 * float(within.mean()) if len(within) else np.nan
    return Recall(limit_m, limit_deg, percent, wilson_interval(int(within.sum()), len(within)))


def _median(values: Array) -> float:
    return float(np.median(values)) if len(values) else np.nan
