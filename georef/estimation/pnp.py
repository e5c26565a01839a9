"""Exterior orientation of one image from 2D-3D correspondences: refinement, and a full covariance.

The refinement weights every correspondence with the noise of its keypoint and the covariance of its map point. The
covariance adds what correspondences share: the errors of the reference poses that their points were triangulated from.
What is not known of the camera is estimated with the pose, whose covariance is then the marginal one.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from georef.estimation.first_pose import QueryImage
from georef.estimation.local_model import LocalModel
from georef.estimation.reference_errors import ReferenceErrors, reference_gains
from georef.geometry.camera import Camera, intrinsic_derivatives
from georef.geometry.covariance import symmetric
from georef.geometry.projection import Views, linearize
from georef.geometry.rigid import Array, Rigid3

_ITERATIONS = 20
_CONVERGED = 1e-9
_CAUCHY_SCALE = 2.0
_LARGEST_STEP = 0.2  # of the logarithm of the focal length, and of distortion coefficients
_UNIT = 1e-12  # least eigenvalue of the normal matrix with unit diagonal


@dataclass(frozen=True, eq=False)
class EstimatedPose:
    world_from_cam: Rigid3
    cov: Array  # (6, 6) right perturbation
    relative_cov: Array  # (6, 6) the same without the errors of the reference poses
    inliers: NDArray[np.bool_]  # (P,) of the local model's points
    sigma0: float  # a-posteriori over a-priori standard deviation of an observation
    camera: Camera  # as estimated; the given one where it is known
    intrinsics_cov: Array  # (q, q) of steps of camera.estimate; (0, 0) where the camera is known


def refine_pose(
    start: Rigid3,
    query: QueryImage,
    model: LocalModel,
    reference_errors: ReferenceErrors,
    gate_probability: float = 0.999,
) -> EstimatedPose | None:
    """Refines a pose on all points of a local model: Cauchy, chi-square gate, then least squares on what passed.

    What query.camera does not know is refined with it, from its values.
    reference_errors: of the model's views. None where geometry fails.
    """
    found = _iterate(start, query, model, np.ones(len(model), bool), robust=True)
    if found is None:
        return None
    inliers = np.ones(len(model), bool)
    for _ in range(3):
        gated = _gate(*found, model, inliers, gate_probability)
        if gated is None or gated.sum() < 6 + len(query.camera.estimate):
            return None
        refitted = _iterate(*found, model, gated, robust=False)
        if refitted is None:
            return None
        settled = np.array_equal(gated, inliers)
        found, inliers = refitted, gated
        if settled:
            break
    return with_covariance(*found, model, inliers, reference_errors)


def refit_pose(
    start: Rigid3, query: QueryImage, model: LocalModel, reference_errors: ReferenceErrors
) -> EstimatedPose | None:
    """Least squares on all points of a local model, which are known to be good. None where geometry fails."""
    everything = np.ones(len(model), bool)
    found = _iterate(start, query, model, everything, robust=False)
    return None if found is None else with_covariance(*found, model, everything, reference_errors)


def with_covariance(
    pose: Rigid3,
    query: QueryImage,
    model: LocalModel,
    inliers: NDArray[np.bool_],
    reference_errors: ReferenceErrors,
) -> EstimatedPose | None:
    """The covariance of a pose estimated from the inliers: image noise, map points, and reference poses.

    None where the points do not fix the pose and what is unknown of the camera.
    """
    used = model.take(inliers)
    system = _Weighted.at(pose, query, used)
    normal = system.normal()
    cov_unit = _inverse(normal)
    if cov_unit is None:
        return None
    squares = float(np.einsum("ni,nij,nj->", system.residual, system.weight, system.residual))
    variance_factor = squares / max(2 * len(used) - len(normal), 1)
    relative = symmetric(variance_factor * cov_unit)
    by_point = -cov_unit @ np.swapaxes(system.by_unknown, 1, 2) @ system.weight @ system.by_point  # (P, 6 + q, 3)
    cov = symmetric(relative + reference_errors.propagated(reference_gains(used, by_point)))
    return EstimatedPose(
        pose,
        cov[:6, :6],
        relative[:6, :6],
        inliers,
        float(np.sqrt(variance_factor)),
        query.camera,
        cov[6:, 6:],
    )


@dataclass(frozen=True, eq=False)
class _Weighted:
    """Reprojection of a model's points into the query, linearised and weighted."""

    residual: Array  # (P, 2) projected minus observed
    by_unknown: Array  # (P, 2, 6 + q): pose, then the unknowns of the camera
    by_point: Array  # (P, 2, 3)
    cov: Array  # (P, 2, 2) of an observation, map point included
    weight: Array  # (P, 2, 2)

    @staticmethod
    def at(pose: Rigid3, query: QueryImage, model: LocalModel) -> _Weighted:
        views, first = Views.of([pose], [query.camera]), np.zeros(len(model), np.int64)
        lin = linearize(views, first, model.points)
        unknown = query.camera.estimate
        by_camera = intrinsic_derivatives(query.camera, views.to_cam(first, model.points), unknown)
        by_unknown = np.concatenate([lin.by_pose, by_camera], axis=2)
        noise = np.square(query.sigma_px[model.keypoint])[:, None, None] * np.eye(2)
        cov = noise + lin.by_point @ model.cov @ np.swapaxes(lin.by_point, 1, 2)
        in_front = np.asarray(np.isfinite(lin.pixel).all(axis=1))
        cov[~in_front] = np.eye(2)
        weight = cast(Array, np.linalg.inv(cov) * in_front[:, None, None])
        residual = np.nan_to_num(lin.pixel - query.pixels[model.keypoint], nan=1e6)
        return _Weighted(residual, np.nan_to_num(by_unknown), np.nan_to_num(lin.by_point), cov, weight)

    def normal(self, robust_weight: Array | None = None) -> Array:
        weight = self.weight if robust_weight is None else self.weight * robust_weight[:, None, None]
        return np.einsum("nki,nkl,nlj->ij", self.by_unknown, weight, self.by_unknown)

    def gradient(self, robust_weight: Array | None = None) -> Array:
        weight = self.weight if robust_weight is None else self.weight * robust_weight[:, None, None]
        return np.einsum("nki,nkl,nl->i", self.by_unknown, weight, self.residual)

    def distance(self) -> Array:
        """Mahalanobis distances (P,)."""
        return np.sqrt(np.einsum("ni,nij,nj->n", self.residual, self.weight, self.residual))


def _iterate(
    pose: Rigid3, query: QueryImage, model: LocalModel, selected: NDArray[np.bool_], *, robust: bool
) -> tuple[Rigid3, QueryImage] | None:
    """Gauss-Newton on the selected points; with Cauchy weights at the scale that the residuals themselves show.

    The camera of the query that is returned is the estimated one.
    """
    used = model.take(selected)
    for _ in range(_ITERATIONS):
        system = _Weighted.at(pose, query, used)
        weight = None
        if robust:
            distance = system.distance()
            scale = _CAUCHY_SCALE * max(float(np.median(distance)) / 1.1774, 1e-6)  # median of a 2-d unit normal
            weight = 1.0 / (1.0 + np.square(distance / scale))
        try:
            step = -np.linalg.solve(system.normal(weight), system.gradient(weight))
        except np.linalg.LinAlgError:
            return None
        if query.camera.estimate:
            step = step * min(1.0, _LARGEST_STEP / max(float(np.abs(step[6:]).max()), 1e-12))
            query = query.with_camera(query.camera.changed(query.camera.estimate, step[6:]))
        pose = pose.retract(step[:6])
        if float(np.abs(step).max()) < _CONVERGED:
            break
    return pose, query


def _gate(
    pose: Rigid3, query: QueryImage, model: LocalModel, inliers: NDArray[np.bool_], probability: float
) -> NDArray[np.bool_] | None:
    """Points whose residual r passes r' Qvv^-1 r / s0^2 <= chi2_2, where Qvv = S - A Qxx A' inside the fit."""
    system = _Weighted.at(pose, query, model)
    normal = system.normal(inliers.astype(float))
    inverse = _inverse(normal)
    if inverse is None:
        return None
    fitted = system.by_unknown @ inverse @ np.swapaxes(system.by_unknown, 1, 2)
    cofactor = system.cov + np.where(inliers[:, None, None], -fitted, fitted)
    statistic = np.einsum("ni,nij,nj->n", system.residual, np.linalg.pinv(cofactor, hermitian=True), system.residual)
    scale2 = float(np.median(statistic[inliers])) / chi2.ppf(0.5, 2)
    return statistic <= max(scale2, 1e-12) * chi2.ppf(probability, 2)


def _inverse(normal: Array) -> Array | None:
    """The inverse of a normal matrix; None where it is singular to working precision."""
    diagonal = np.diag(normal)
    if not (diagonal > 0).all():
        return None
    scale = 1.0 / np.sqrt(diagonal)  # radians, metres and coefficients differ by orders of magnitude
    scaled = normal * scale[:, None] * scale[None, :]
    if np.linalg.eigvalsh(scaled)[0] <= _UNIT:
        return None
    return cast(Array, np.linalg.inv(scaled)) * scale[:, None] * scale[None, :]
