"""Cameras of one rig exposure, or of a short sequence of exposures, as one problem: S stations instead of M poses.

A camera's pose is world_from_rig @ rig_from_cam. The mounting rig_from_cam is known from its calibration, exactly or
with a covariance; then it is an unknown with the calibration as its observation. Points are of two kinds: those that
reference images see have a position with covariance from there, free ones (tie points) are seen by query images alone.
A point that several cameras see is one point, so that the noise of its reference keypoints counts once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from georef.estimation.guided import PosedFeatures
from georef.estimation.local_model import triangulate_consistent
from georef.estimation.reference_errors import point_by_reference_pose
from georef.estimation.reference_map import ReferenceMap
from georef.estimation.tracks import PairMatches, build_tracks, distributed
from georef.geometry.projection import Views
from georef.geometry.rigid import Array, Rigid3
from georef.geometry.triangulation import triangulate
from georef.types.campaign import Mounting
from georef.types.results import ReferenceMatches
from georef.types.scene import Observations

_GATE_SIGMAS = 3.5
_TIE_GATE_SIGMAS = 6.0  # at approximate poses


@dataclass(frozen=True, eq=False)
class Member:
    """One image of a station: its features, how it is mounted, and its matches with reference images."""

    image_id: str
    station: int
    mounting: Mounting
    features: PosedFeatures  # the pose is approximate
    matches: tuple[ReferenceMatches, ...]


@dataclass(frozen=True, eq=False)
class StationProblem:
    """S stations, M members and P points. What reference images know of points is `prior_cov` about `given`."""

    members: tuple[Member, ...]
    world_from_rigs: tuple[Rigid3, ...]  # (S) approximate
    mountings: tuple[Mounting, ...]  # (C) those in use, each once
    mounting_of: NDArray[np.int64]  # (M,) index of each member's mounting
    given: Array  # (P, 3) points in world: from the references, or approximate
    prior_cov: Array  # (P, 3, 3) of the image noise of the references; zero for free points
    free: NDArray[np.bool_]  # (P,) no reference sees it
    observations: Observations  # in the members; view is the index of a member
    ray_point: NDArray[np.int64]  # (n,) of each reference ray: its point
    ray_reference: NDArray[np.int64]  # (n,) index in the reference map
    ray_keypoint: NDArray[np.int64]  # (n,) keypoint in that reference
    by_reference_pose: Array  # (n, 3, 6) derivative of the point by the pose of that reference

    @cached_property
    def prior_information(self) -> Array:
        """Information (P, 3, 3) of the points' given positions; zero for free points."""
        cov = np.where(self.free[:, None, None], np.eye(3), self.prior_cov)
        return np.where(self.free[:, None, None], 0.0, np.linalg.inv(cov))

    def scaled(self, factor: float) -> StationProblem:
        """The same problem with all keypoint noise scaled."""
        return replace(self, observations=self.observations.scaled(factor), prior_cov=self.prior_cov * factor**2)

    def started(self, world_from_rigs: Sequence[Rigid3]) -> StationProblem:
        """The same problem with other approximate stations."""
        return replace(self, world_from_rigs=tuple(world_from_rigs))


def station_problem(
    members: Sequence[Member],
    world_from_rigs: Sequence[Rigid3],
    ties: Sequence[PairMatches],
    reference: ReferenceMap,
    min_tie_rays: int = 3,
    max_ties_per_image: int = 100,
) -> StationProblem:
    """The problem of the members' matches with the references, and of `ties` between members (by their indices)."""
    index = {image.image_id: i for i, image in enumerate(reference.images)}
    used = sorted({index[m.reference_id] for member in members for m in member.matches})
    place = {i: len(members) + k for k, i in enumerate(used)}
    to_references = [
        PairMatches(n, place[index[m.reference_id]], m.indices)
        for n, member in enumerate(members)
        for m in member.matches
    ]
    posed = [_at(member, world_from_rigs) for member in members]
    images = [*posed, *(reference.posed(i) for i in used)]
    count, observations = build_tracks(images, [*to_references, *ties], reference.noise.keypoint_sigma)
    in_members = observations.view < len(members)
    points, rays = _from_references(count, observations.take(~in_members), used, len(members), reference)
    seen = observations.take(in_members)
    ties_at, free = _tie_points(posed, seen, points.known, min_tie_rays, max_ties_per_image)
    given = np.where(free[:, None], ties_at, points.given)
    keep = (points.known | free) & (np.bincount(seen.point, minlength=count) > 0)
    number = np.cumsum(keep) - 1
    seen = seen.take(keep[seen.point])
    ray_kept = keep[rays.point]
    mountings = {m.mounting.camera: m.mounting for m in members}
    return StationProblem(
        members=tuple(members),
        world_from_rigs=tuple(world_from_rigs),
        mountings=tuple(mountings.values()),
        mounting_of=np.array([list(mountings).index(m.mounting.camera) for m in members], dtype=np.int64),
        given=given[keep],
        prior_cov=points.cov[keep],
        free=free[keep],
        observations=seen.with_points(number[seen.point]),
        ray_point=number[rays.point[ray_kept]],
        ray_reference=rays.reference[ray_kept],
        ray_keypoint=rays.keypoint[ray_kept],
        by_reference_pose=rays.by_pose[ray_kept],
    )


def _at(member: Member, world_from_rigs: Sequence[Rigid3]) -> PosedFeatures:
    return member.features.posed(world_from_rigs[member.station] @ member.mounting.rig_from_cam)


@dataclass(frozen=True, eq=False)
class _Points:
    given: Array  # (P, 3)
    cov: Array  # (P, 3, 3)
    known: NDArray[np.bool_]  # (P,) triangulated from references


@dataclass(frozen=True, eq=False)
class _Rays:
    point: NDArray[np.int64]
    reference: NDArray[np.int64]
    keypoint: NDArray[np.int64]
    by_pose: Array  # (n, 3, 6)


def _from_references(
    count: int, rays: Observations, used: Sequence[int], members: int, reference: ReferenceMap
) -> tuple[_Points, _Rays]:
    """The points that at least two references agree on, and how these depend on the references' poses."""
    given, cov, known = np.zeros((count, 3)), np.zeros((count, 3, 3)), np.zeros(count, bool)
    if not len(rays):
        return _Points(given, cov, known), _Rays(rays.point, rays.view, rays.keypoint, np.zeros((0, 3, 6)))
    views = reference.views(used)
    model = triangulate_consistent(views, np.arange(count), replace(rays, view=rays.view - members), _GATE_SIGMAS)
    given[model.keypoint], cov[model.keypoint], known[model.keypoint] = model.points, model.cov, True
    obs, by_pose = model.observations, point_by_reference_pose(model)
    of_rays = _Rays(model.keypoint[obs.point], np.asarray(used)[obs.view], obs.keypoint, by_pose)
    return _Points(given, cov, known), of_rays


def _tie_points(
    posed: Sequence[PosedFeatures], seen: Observations, known: NDArray[np.bool_], min_rays: int, budget: int
) -> tuple[Array, NDArray[np.bool_]]:
    """Free points (P, 3) of tracks without references, and which of them are good and to be used."""
    count = len(known)
    rays = np.bincount(seen.point, minlength=count)
    wanted = ~known & (rays >= min_rays)
    if not wanted.any():
        return np.zeros((count, 3)), np.zeros(count, bool)
    obs = seen.take(wanted[seen.point])
    views = Views.of([p.world_from_cam for p in posed], [p.camera for p in posed])
    solved = triangulate(views, obs.point, obs.view, obs.pixel, obs.sigma_px, count)
    distance = np.linalg.norm(np.nan_to_num(solved.residual_px, nan=1e6), axis=1) / obs.sigma_px
    worst = np.zeros(count)
    np.maximum.at(worst, obs.point, distance)
    good = wanted & np.isfinite(solved.points).all(axis=1) & (worst <= _TIE_GATE_SIGMAS)
    sizes = np.array([[p.camera.width, p.camera.height] for p in posed], dtype=float)
    chosen = distributed(obs.take(good[obs.point]), sizes, np.ones(len(posed), bool), budget)
    good[len(chosen) :] = False
    good[: len(chosen)] &= chosen
    return np.nan_to_num(solved.points), good
