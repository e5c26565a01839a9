"""The variance component of the marks of check points, from how well their rays intersect."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from georef.evaluation.forward_intersection import (
    Intersection,
    JointPoseCov,
    PosedImages,
    images_of,
    intersect,
    spread,
)
from georef.evaluation.statistics import finite
from georef.geometry.rigid import Array
from georef.types.constraints import CheckPoint

_ITERATIONS, _SMALLEST = 200, 1e-6


@dataclass(frozen=True)
class MarkSigmaComponent:
    """The factor that the stated sigmas of the marks are to be multiplied with; about 1 where they are true."""

    point_count: int
    mark_count: int
    redundancy: int  # 2 marks - 3 points
    plain_factor: float | None  # sqrt(v'Pv / redundancy), the errors of the poses included; None without redundancy
    factor: float | None  # without them; None where they alone explain the residuals, or without redundancy
    sigma: float | None  # 1-sigma of factor

    def to_dict(self) -> dict[str, object]:
        """Plain values for JSON."""
        return {
            "point_count": self.point_count,
            "mark_count": self.mark_count,
            "redundancy": self.redundancy,
            "plain_factor": finite(self.plain_factor),
            "factor": finite(self.factor),
            "sigma": finite(self.sigma),
        }


def mark_sigma_component(points: Iterable[CheckPoint], images: PosedImages) -> MarkSigmaComponent:
    """The component over all points that are determined, whatever they are independent of: marks are marks.

    The residuals of the intersections hold the noise of the marks and, where rays of different images disagree, the
    errors of the poses, which all points of an image share. Projected on the null space of the points they have the
    covariance s^2 I + G, with G from `images.joint_cov`; s^2 is its restricted maximum-likelihood estimate (Patterson
    and Thompson 1971). Without joint_cov G = 0, and factor is plain_factor: it takes all for noise of the marks.
    Blunders among the marks are not removed and enlarge it.
    """
    return component_of([found for p in points if isinstance(found := intersect(p, images), Intersection)], images)


def component_of(intersections: list[Intersection], images: PosedImages) -> MarkSigmaComponent:
    """The same from intersections that have been computed already."""
    marks = sum(len(found.residual_px) for found in intersections)
    redundancy = 2 * marks - 3 * len(intersections)
    counts = len(intersections), marks, redundancy
    if redundancy == 0:
        return MarkSigmaComponent(*counts, None, None, None)
    spectrum = _spectrum(intersections, images.joint_cov)
    plain = float(np.sqrt(np.sum(spectrum.size * spectrum.square) / redundancy))
    variance, variance_sigma = _likeliest(spectrum)
    if variance <= _SMALLEST:
        return MarkSigmaComponent(*counts, plain, None, None)
    factor = float(np.sqrt(variance))
    return MarkSigmaComponent(*counts, plain, factor, 0.5 * variance_sigma / factor)


class _Spectrum(NamedTuple):
    """Uncorrelated combinations of the residuals, in g groups of equal variance s^2 + from_poses."""

    square: Array  # (g,) mean square
    from_poses: Array  # (g,)
    size: Array  # (g,) combinations in the group


def _spectrum(intersections: list[Intersection], joint_cov: JointPoseCov | None) -> _Spectrum:
    # Columns of a basis: combinations of the residuals of a point that do not depend on where it is.
    bases = [np.linalg.qr(found.by_point, mode="complete").Q[:, 3:] for found in intersections]
    values = np.concatenate([basis.T @ found.whitened for basis, found in zip(bases, intersections, strict=True)])
    total, count = float(values @ values), len(values)
    if joint_cov is None:
        return _Spectrum(np.array([total / count]), np.zeros(1), np.array([float(count)]))
    every = images_of(intersections)
    parts = [spread(b.T @ found.by_poses, found.images, every) for b, found in zip(bases, intersections, strict=True)]
    vectors, sizes, _ = np.linalg.svd(np.vstack(parts) @ _root(joint_cov(every)), full_matrices=False)
    along = np.square(vectors.T @ values)
    rest = count - len(along)  # not touched by the poses
    if rest == 0:
        return _Spectrum(along, np.square(sizes), np.ones(count))
    untouched = max(total - float(along.sum()), 0.0) / rest
    return _Spectrum(
        np.append(along, untouched), np.append(np.square(sizes), 0.0), np.append(np.ones(len(along)), rest)
    )


def _root(cov: Array) -> Array:
    """A matrix L with L L' = cov (k, k), which may be singular; scaled, as radians and metres differ in size."""
    scale = np.sqrt(np.diag(cov))
    scale[scale == 0.0] = 1.0
    values, vectors = np.linalg.eigh(cov / np.outer(scale, scale))
    return scale[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))


def _likeliest(spectrum: _Spectrum) -> tuple[float, float]:
    """s^2 and its 1-sigma by Fisher scoring."""
    square, from_poses, count = spectrum
    variance = max(float(np.sum(count * square) / np.sum(count)), _SMALLEST)
    for _ in range(_ITERATIONS):
        weight = count / np.square(variance + from_poses)
        updated = max(float(np.sum(weight * (square - from_poses)) / np.sum(weight)), _SMALLEST)
        if abs(updated - variance) <= 1e-9 * updated:
            break
        variance = updated
    return variance, float(np.sqrt(2.0 / np.sum(count / np.square(variance + from_poses))))
