"""Exterior orientation of one image from 2D-3D correspondences: LO-RANSAC, refinement, and a full covariance.

The refinement weights every correspondence with the noise of its keypoint and the covariance of its map point. The
covariance adds what correspondences share: the errors of the reference poses that their points were triangulated from.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import cast

import numpy as np
import pycolmap
from numpy.typing import NDArray
from scipy.stats import chi2

from georef.estimation.local_model import LocalModel
from georef.geometry.camera import Camera
from georef.geometry.covariance import symmetric
from georef.geometry.projection import Views, linearize
from georef.geometry.rigid import Array, Rigid3
from georef.geometry.triangulation import segment_sum

_ITERATIONS = 20
_CONVERGED = 1e-9
_CAUCHY_SCALE = 2.0


@dataclass(frozen=True, eq=False)
class QueryImage:
    """What of the query image enters the pose: its camera and ideal keypoints with their noise."""

    camera: Camera
    ideal_px: Array  # (N, 2)
    sigma_px: Array  # (N,)


@dataclass(frozen=True, eq=False)
class EstimatedPose:
    world_from_cam: Rigid3
    cov: Array  # (6, 6) right perturbation
    relative_cov: Array  # (6, 6) the same without the errors of the reference poses
    inliers: NDArray[np.bool_]  # (P,) of the local model's points
    sigma0: float  # a-posteriori over a-priori standard deviation of an observation


def ransac_pose(
    query: QueryImage, model: LocalModel, gate_px: float, seed: int
) -> tuple[Rigid3, NDArray[np.bool_]] | None:
    """Pose by COLMAP's LO-RANSAC (P3P, EPnP) and its refinement, with the inliers (P,); None without consensus."""
    camera = pycolmap.Camera(
        model="PINHOLE",
        width=query.camera.width,
        height=query.camera.height,
        params=[query.camera.fx, query.camera.fy, query.camera.cx, query.camera.cy],
    )
    options = pycolmap.AbsolutePoseEstimationOptions()
    options.ransac.max_error = gate_px
    options.ransac.random_seed = seed
    pixels = query.ideal_px[model.keypoint]
    # A local origin keeps COLMAP's arithmetic well conditioned far from the world's origin.
    origin = model.points.mean(axis=0) if len(model) else np.zeros(3)
    found = None
    if len(model) >= 4:
        found = pycolmap.estimate_and_refine_absolute_pose(pixels, model.points - origin, camera, options)
    if found is None:
        return None
    cam_from_local = Rigid3.from_matrix(found["cam_from_world"].matrix())
    local_from_cam = cam_from_local.inverse()
    return Rigid3(local_from_cam.rotation, local_from_cam.translation + origin), np.asarray(found["inlier_mask"], bool)


def refine_pose(
    start: Rigid3,
    query: QueryImage,
    model: LocalModel,
    reference_pose_cov: Callable[[int], Array],
    gate_probability: float = 0.999,
) -> EstimatedPose | None:
    """Refines a pose on all points of a local model: Cauchy, chi-square gate, then least squares on what passed.

    reference_pose_cov(i) is the covariance (6, 6) of the model's i-th reference view. None where geometry fails.
    """
    pose = _iterate(start, query, model, np.ones(len(model), bool), robust=True)
    if pose is None:
        return None
    inliers = np.ones(len(model), bool)
    for _ in range(3):
        gated = _gate(pose, query, model, inliers, gate_probability)
        if gated is None or gated.sum() < 6:
            return None
        refitted = _iterate(pose, query, model, gated, robust=False)
        if refitted is None:
            return None
        settled = np.array_equal(gated, inliers)
        pose, inliers = refitted, gated
        if settled:
            break
    return with_covariance(pose, query, model, inliers, reference_pose_cov)


def refit_pose(
    start: Rigid3, query: QueryImage, model: LocalModel, reference_pose_cov: Callable[[int], Array]
) -> EstimatedPose | None:
    """Least squares on all points of a local model, which are known to be good. None where geometry fails."""
    everything = np.ones(len(model), bool)
    pose = _iterate(start, query, model, everything, robust=False)
    return None if pose is None else with_covariance(pose, query, model, everything, reference_pose_cov)


def with_covariance(
    pose: Rigid3,
    query: QueryImage,
    model: LocalModel,
    inliers: NDArray[np.bool_],
    reference_pose_cov: Callable[[int], Array],
) -> EstimatedPose | None:
    """The covariance of a pose estimated from the inliers: image noise, map points, and reference poses."""
    used = model.take(inliers)
    system = _Weighted.at(pose, query, used)
    normal = system.normal()
    if np.linalg.eigvalsh(normal)[0] <= 0:
        return None
    cov_unit = cast(Array, np.linalg.inv(normal))
    squares = float(np.einsum("ni,nij,nj->", system.residual, system.weight, system.residual))
    variance_factor = squares / max(2 * len(used) - 6, 1)
    relative = symmetric(variance_factor * cov_unit)
    cov = symmetric(relative + _shared_reference_part(system, cov_unit, used, reference_pose_cov))
    return EstimatedPose(pose, cov, relative, inliers, float(np.sqrt(variance_factor)))


@dataclass(frozen=True, eq=False)
class _Weighted:
    """Reprojection of a model's points into the query, linearised and weighted."""

    residual: Array  # (P, 2) projected minus observed
    by_pose: Array  # (P, 2, 6)
    by_point: Array  # (P, 2, 3)
    cov: Array  # (P, 2, 2) of an observation, map point included
    weight: Array  # (P, 2, 2)

    @staticmethod
    def at(pose: Rigid3, query: QueryImage, model: LocalModel) -> _Weighted:
        views = Views.of([pose], [query.camera])
        lin = linearize(views, np.zeros(len(model), np.int64), model.points)
        noise = np.square(query.sigma_px[model.keypoint])[:, None, None] * np.eye(2)
        cov = noise + lin.by_point @ model.cov @ np.swapaxes(lin.by_point, 1, 2)
        in_front = np.asarray(np.isfinite(lin.pixel).all(axis=1))
        cov[~in_front] = np.eye(2)
        weight = cast(Array, np.linalg.inv(cov) * in_front[:, None, None])
        residual = np.nan_to_num(lin.pixel - query.ideal_px[model.keypoint], nan=1e6)
        return _Weighted(residual, np.nan_to_num(lin.by_pose), np.nan_to_num(lin.by_point), cov, weight)

    def normal(self, robust_weight: Array | None = None) -> Array:
        weight = self.weight if robust_weight is None else self.weight * robust_weight[:, None, None]
        return np.einsum("nki,nkl,nlj->ij", self.by_pose, weight, self.by_pose)

    def gradient(self, robust_weight: Array | None = None) -> Array:
        weight = self.weight if robust_weight is None else self.weight * robust_weight[:, None, None]
        return np.einsum("nki,nkl,nl->i", self.by_pose, weight, self.residual)

    def distance(self) -> Array:
        """Mahalanobis distances (P,)."""
        return np.sqrt(np.einsum("ni,nij,nj->n", self.residual, self.weight, self.residual))


def _iterate(
    pose: Rigid3, query: QueryImage, model: LocalModel, selected: NDArray[np.bool_], *, robust: bool
) -> Rigid3 | None:
    """Gauss-Newton on the selected points; with Cauchy weights at the scale that the residuals themselves show."""
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
        pose = pose.retract(step)
        if float(np.abs(step).max()) < _CONVERGED:
            break
    return pose


def _gate(
    pose: Rigid3, query: QueryImage, model: LocalModel, inliers: NDArray[np.bool_], probability: float
) -> NDArray[np.bool_] | None:
    """Points whose residual r passes r' Qvv^-1 r / s0^2 <= chi2_2, where Qvv = S - A Qxx A' inside the fit."""
    system = _Weighted.at(pose, query, model)
    normal = system.normal(inliers.astype(float))
    if np.linalg.eigvalsh(normal)[0] <= 0:
        return None
    fitted = system.by_pose @ np.linalg.inv(normal) @ np.swapaxes(system.by_pose, 1, 2)
    cofactor = system.cov + np.where(inliers[:, None, None], -fitted, fitted)
    statistic = np.einsum("ni,nij,nj->n", system.residual, np.linalg.pinv(cofactor, hermitian=True), system.residual)
    scale2 = float(np.median(statistic[inliers])) / chi2.ppf(0.5, 2)
    return statistic <= max(scale2, 1e-12) * chi2.ppf(probability, 2)


def _shared_reference_part(
    system: _Weighted, cov_unit: Array, model: LocalModel, reference_pose_cov: Callable[[int], Array]
) -> Array:
    """Covariance (6, 6) that the errors of the reference poses bring, points that share a reference moving together.

    A reference pose error e moves a point by -N^-1 sum(A' W B) e, with A and B the derivatives of its observations by
    point and pose; the query pose follows by its own normal equations.
    """
    obs = model.observations
    lin = linearize(model.views, obs.view, model.points[obs.point])
    pull = np.einsum("nki,nkj->nij", lin.by_point, lin.by_pose) / np.square(obs.sigma_px)[:, None, None]
    point_by_pose = model.cov[obs.point] @ pull  # (n, 3, 6)
    gain = cov_unit @ np.swapaxes(system.by_pose, 1, 2) @ system.weight @ system.by_point  # (P, 6, 3)
    by_reference = segment_sum(gain[obs.point] @ point_by_pose, obs.view, len(model.views))
    return sum(
        (c @ reference_pose_cov(i) @ c.T for i, c in enumerate(by_reference)),
        start=np.zeros((6, 6)),
    )
