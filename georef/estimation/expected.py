"""Which references a pose should rest on: those from which it is expected to be known best.

Each reference is expected to see some of the points that a first pose rests on. Points are fixed by the rays to them
(N = sum p J'J / s^2), the pose by its points (H = sum A' (s^2 I + B N^-1 B')^-1 A), and the errors of the reference
poses come through both, as in the covariance of a localized pose. The choice is greedy: the reference that makes the
determinant of the covariance smallest goes first, until the next one would make it hardly smaller. It may even make it
larger: points are weighted by image noise alone, so that a reference whose error comes through does harm. This asks for
rays that intersect at good angles, for points all over the image, and for references whose errors are independent,
where a count of common points asks for more of the same.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from georef.estimation.first_pose import QueryImage
from georef.estimation.local_model import LocalModel
from georef.geometry.covariance import largest_position_sigma
from georef.geometry.projection import Views, linearize
from georef.geometry.rigid import Array, Rigid3
from georef.types.results import ReferenceNoise

_POINTS = 120  # of the model that the expectation is computed with
_CANDIDATES = 40  # that see most
_MATCHING_ANGLE_RAD = np.radians(25.0)  # at which a third of what two images see in common is still matched
_LARGEST_ANGLE_RAD = np.radians(60.0)
_LEAST_GAIN = -12.0 * np.log(1.0 - 0.03)  # of the logarithm of the determinant: sigmas 3 % smaller, one with another
_DEPTH_UNKNOWN = 0.5  # 1-sigma of a point before any ray, over its distance
_POSE_UNKNOWN = np.diag([1.0, 1.0, 1.0, 1e-2, 1e-2, 1e-2])  # information of a pose before any point: 1 rad, 10 m


@dataclass(frozen=True, eq=False)
class Choice:
    """References in the order in which they help, as indices into the views that were asked for."""

    order: NDArray[np.int64]
    sigma_m: Array  # the largest position sigma expected after each of them


@dataclass(frozen=True, eq=False)
class _Expectation:
    """Of P points seen in the query and in V references."""

    by_pose: Array  # (P, 2, 6) of the query's pixels
    by_point: Array  # (P, 2, 3)
    variance: Array  # (P,) px^2 of the query's keypoints
    unseen: Array  # (P, 3, 3) information of a point before any ray
    seen: Array  # (V, P) expected observations
    information: Array  # (V, P, 3, 3) of the points
    pull: Array  # (V, P, 3, 6) J' B / s^2 with J and B the derivatives of a reference's pixels by point and its pose
    pose_covs: Array  # (V, 6, 6)
    multiplicity: float  # points that each of the P stands for

    def covariances(self, chosen: Sequence[int], tried: NDArray[np.int64]) -> Array:
        """Covariances (K, 6, 6) of the pose from the chosen references and each of the K tried ones."""
        of_chosen = self.information[chosen].sum(axis=0) + self.unseen
        point_cov = np.linalg.inv(of_chosen + self.information[tried])  # (K, P, 3, 3)
        count = self.seen[chosen].sum(axis=0) + self.seen[tried]
        triangulated = self.multiplicity * (1.0 - (1.0 + count) * np.exp(-count))  # Poisson: two rays or more
        noise = self.by_point @ point_cov @ np.swapaxes(self.by_point, 1, 2)
        noise += self.variance[:, None, None] * np.eye(2)
        weighted = np.swapaxes(self.by_pose, 1, 2) @ np.linalg.inv(noise) * triangulated[:, :, None, None]
        cov = np.linalg.inv((weighted @ self.by_pose).sum(axis=1) + _POSE_UNKNOWN)
        gain = cov[:, None] @ weighted @ self.by_point @ point_cov  # (K, P, 6, 3)
        flat = np.swapaxes(gain, 1, 2).reshape(len(tried), 6, -1)
        for index in chosen:
            cov = cov + _through(flat @ self.pull[index].reshape(-1, 6), self.pose_covs[index])
        own = flat @ self.pull[tried].reshape(len(tried), -1, 6)
        return cov + _through(own, self.pose_covs[tried])


def _through(by_error: Array, cov: Array) -> Array:
    return by_error @ cov @ np.swapaxes(by_error, -1, -2)


def most_informative(
    pose: Rigid3,
    query: QueryImage,
    model: LocalModel,
    views: Views,
    sizes: Array,
    pose_covs: Sequence[Array],
    noise: ReferenceNoise,
    least: int,
    count: int,
) -> Choice:
    """At most `count` of the references (views; sizes (V, 2) width and height; pose_covs (6, 6) each), the best first.

    model: points that the query sees from `pose`. References that see none of them from a similar side are left out,
    and those that would hardly improve the pose once there are `least`.
    """
    points = np.unique(np.linspace(0, len(model) - 1, min(_POINTS, len(model))).round().astype(int))
    keypoint, points, total = model.keypoint[points], model.points[points], len(model)
    seen, angle = _expected_observations(pose, points, views, sizes)
    useful = np.argsort(-seen.sum(axis=1), kind="stable")[:_CANDIDATES]
    useful = useful[seen[useful].sum(axis=1) > 0]
    if len(points) == 0 or len(useful) == 0:
        return Choice(np.zeros(0, np.int64), np.zeros(0))
    sigma_px = query.sigma_px[keypoint]
    lin = linearize(views, np.repeat(useful, len(points)), np.tile(points, (len(useful), 1)))
    weight = seen[useful] / np.square(sigma_px * noise.widening(angle[useful]))
    by_point, by_own = (np.nan_to_num(d).reshape(len(useful), len(points), 2, -1) for d in (lin.by_point, lin.by_pose))
    weighted = np.swapaxes(by_point, 2, 3) * weight[:, :, None, None]
    own = linearize(Views.of([pose], [query.camera]), np.zeros(len(points), np.int64), points)
    distance = np.linalg.norm(points - pose.translation, axis=1)
    expectation = _Expectation(
        np.nan_to_num(own.by_pose),
        np.nan_to_num(own.by_point),
        np.square(sigma_px),
        np.eye(3) / np.square(_DEPTH_UNKNOWN * distance)[:, None, None],
        seen[useful],
        weighted @ by_point,
        weighted @ by_own,
        np.array([pose_covs[int(i)] for i in useful]),
        total / len(points),
    )
    order, sigma_m = _greedy(expectation, least, count)
    return Choice(useful[order], sigma_m)


def _greedy(expectation: _Expectation, least: int, count: int) -> tuple[NDArray[np.int64], Array]:
    chosen: list[int] = []
    sigmas: list[float] = []
    left, smallest = np.arange(len(expectation.seen)), np.inf
    while len(left) and len(chosen) < count:
        covs = expectation.covariances(chosen, left)
        volumes = np.linalg.slogdet(covs)[1]
        best = int(volumes.argmin())
        if volumes[best] > smallest - _LEAST_GAIN and len(chosen) >= least:
            break
        smallest = volumes[best]
        sigmas.append(largest_position_sigma(covs[best]))
        chosen.append(int(left[best]))
        left = np.delete(left, best)
    return np.array(chosen, np.int64), np.array(sigmas)


def _expected_observations(pose: Rigid3, points: Array, views: Views, sizes: Array) -> tuple[Array, Array]:
    """How likely each view has a match of each point (V, P), and the angles between its ray and the query's (V, P)."""
    rows = np.repeat(np.arange(len(views)), len(points))
    tiled = np.tile(points, (len(views), 1))
    pixel = views.project(rows, tiled).reshape(len(views), len(points), 2)
    with np.errstate(invalid="ignore"):
        inside = ((pixel >= 0) & (pixel <= sizes[:, None])).all(axis=2)
    to_query = points - pose.translation
    to_view = points - views.centres[:, None]
    near, far = np.linalg.norm(to_query, axis=1), np.linalg.norm(to_view, axis=2)
    angle = np.arccos(np.clip((to_view * to_query).sum(axis=2) / (near * far), -1.0, 1.0))
    nearer = np.minimum(near / far, far / near)
    likely = np.exp(-np.square(angle / _MATCHING_ANGLE_RAD)) * nearer
    return np.where(inside & (angle < _LARGEST_ANGLE_RAD), likely, 0.0), angle
