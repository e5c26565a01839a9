"""The adjustment problem of a new epoch: localized images, constraints of the configured kind, tie points."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from georef.config import AdjustConfig
from georef.errors import StageError
from georef.estimation.adjustment.problem import AutomaticGcps, Problem
from georef.estimation.candidates import overlap
from georef.estimation.guided import PosedFeatures, epipolar_distances
from georef.estimation.local_model import triangulate_consistent
from georef.estimation.reference_errors import point_by_reference_pose
from georef.estimation.reference_map import ReferenceMap
from georef.estimation.tracks import (
    PairMatches,
    build_tracks,
    distributed,
    nearest_ray_angles,
    quantized,
    select_points,
    triangulated_tracks,
)
from georef.features.base import Matcher
from georef.geometry.camera import Camera
from georef.geometry.projection import Views, linearize
from georef.geometry.rigid import Array
from georef.types.campaign import Image, PosePrior, PositionPrior
from georef.types.constraints import ControlPoint
from georef.types.results import Localized, ReferenceNoise
from georef.types.scene import Observations

_LEAST_PAIR_MATCHES = 15
_GCP_GATE_SIGMAS = 3.5


def tie_pairs(
    images: Sequence[PosedFeatures], localized: Sequence[Localized], neighbours: int
) -> list[tuple[int, int]]:
    """The pairs of new images to match: each with those that see most of the points it was localized from."""
    seen = np.zeros((len(images), len(images)), np.int64)
    for i, result in enumerate(localized):
        seen[i] = _seen_by(images, result)
        seen[i, i] = 0
    shared = np.maximum(seen, seen.T)
    return sorted(
        {
            (min(i, int(j)), max(i, int(j)))
            for i in range(len(images))
            for j in np.argsort(-shared[i], kind="stable")[:neighbours]
            if shared[i, j] > 0
        }
    )


def _seen_by(images: Sequence[PosedFeatures], result: Localized) -> NDArray[np.int64]:
    directions = result.points_in_world - result.world_from_cam.translation
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    views = Views.of([image.world_from_cam for image in images], [image.camera for image in images])
    sizes = np.array([[image.camera.width, image.camera.height] for image in images], dtype=float)
    return overlap(result.points_in_world, directions, views, sizes)


def match_pair(
    images: tuple[PosedFeatures, PosedFeatures],
    pose_px: tuple[float, float],
    matcher: Matcher,
    keypoints: int,
    gate: float,
) -> NDArray[np.int32]:
    """Matches (n, 2) of two new images, the strongest keypoints of each, near each other's epipolar lines.

    `gate` is the largest distance, in keypoint scales combined with `pose_px`, what the uncertainty of the poses
    amounts to in each. None are returned where they are too few to be trusted.
    """
    a, b = images
    found = matcher.match(a.features.head(keypoints), b.features.head(keypoints)).indices
    scales = np.column_stack([a.features.scales_px[found[:, 0]], b.features.scales_px[found[:, 1]]])
    allowed = gate * np.hypot(scales, np.hypot(*pose_px))
    found = found[(epipolar_distances(a, b, found) <= allowed).all(axis=1)].astype(np.int32)
    return found if len(found) >= _LEAST_PAIR_MATCHES else found[:0]


def pose_sigma_px(camera: Camera, result: Localized) -> float:
    """By how much the uncertainty of a pose moves the points that it rests on, in its image: 1-sigma, the median."""
    views = Views.of([result.world_from_cam], [camera])
    by_pose = linearize(views, np.zeros(len(result.points_in_world), np.int64), result.points_in_world).by_pose
    variance = np.einsum("nki,ij,nkj->n", by_pose, result.world_from_cam_cov, by_pose) / 2.0
    return float(np.sqrt(np.nanmedian(variance)))


def epoch_problem(
    images: Sequence[Image],
    localized: Sequence[Localized],
    new: Sequence[PosedFeatures],
    ties: Sequence[PairMatches],
    reference: ReferenceMap,
    control: tuple[ControlPoint, ...],
    config: AdjustConfig,
) -> Problem:
    """The problem of the localized images (all four sequences in one order) for the configured constraints.

    An image whose camera was estimated keeps its localization: it takes part by its pose with the covariance that is
    marginal to its camera, and by no keypoint, which the same matches would count twice and a held camera too much.
    """
    known = [not p.camera.estimate for p in new]
    ties = [m for m in ties if known[m.a] and known[m.b]] if config.tie_points else []
    posed, matches, covs = list(new), ties, [r.world_from_cam_cov for r in localized]
    used: list[int] = []
    if config.constraints == "auto-gcps" and any(known):
        used, to_references = _reference_matches(localized, known, reference)
        posed += [reference.posed(i) for i in used]
        covs += [reference.pose_cov(i) for i in used]
        matches += to_references
    points, observations = _points(posed, matches, covs, reference.noise, len(new), config)
    in_new = observations.view < len(new)
    problem = Problem(
        image_ids=tuple(r.image_id for r in localized),
        cameras=tuple(p.camera for p in new),
        world_from_cams=tuple(p.world_from_cam for p in new),
        points=points,
        observations=observations.take(in_new),
        gcps=_automatic_gcps(observations.take(~in_new), len(points), len(new), used, reference),
        pose_priors=_pose_priors(localized, known, of_all=config.constraints == "pose-priors"),
        position_priors=position_priors(images, localized) if config.gnss else {},
        control=_marked_in(control, [i.image_id for i, k in zip(images, known, strict=True) if k])
        if config.surveyed_control
        else (),
    )
    return problem.restricted(np.ones(len(problem.observations), bool), np.ones(len(problem.gcps), bool))


def _points(
    posed: Sequence[PosedFeatures],
    matches: Sequence[PairMatches],
    covs: Sequence[Array],
    noise: ReferenceNoise,
    new_count: int,
    config: AdjustConfig,
) -> tuple[Array, Observations]:
    """Tracks, triangulated, thinned to the budget of the new images."""
    count, observations = build_tracks(posed, matches, noise.keypoint_sigma)
    if count == 0:
        return np.zeros((0, 3)), observations
    points, observations = triangulated_tracks(count, observations, posed, covs)
    angle = nearest_ray_angles(points, observations, np.array([p.world_from_cam.translation for p in posed]))
    observations = replace(observations, sigma_px=quantized(observations.sigma_px * noise.widening(angle)))
    sizes = np.array([[p.camera.width, p.camera.height] for p in posed], dtype=float)
    is_new = np.arange(len(posed)) < new_count
    in_new = np.bincount(observations.point[observations.view < new_count], minlength=len(points))
    gcp = np.bincount(observations.point[observations.view >= new_count], minlength=len(points)) >= 2
    keep = np.zeros(len(points), bool)
    for kind, budget in (
        (gcp & (in_new >= 1), config.max_gcps_per_image),
        (~gcp & (in_new >= config.min_tie_point_rays), config.max_tie_points_per_image),
    ):
        chosen = distributed(observations.take(kind[observations.point]), sizes, is_new, budget)
        keep[: len(chosen)] |= chosen
    return select_points(points, observations, keep)


def _automatic_gcps(
    rays: Observations, count: int, new_count: int, used: Sequence[int], reference: ReferenceMap
) -> AutomaticGcps:
    """The points (of `count`) that at least two references see, triangulated from these alone."""
    if not len(rays):
        return AutomaticGcps.none()
    views = reference.views(used)
    rays = replace(rays, view=rays.view - new_count)
    model = triangulate_consistent(views, np.arange(count), rays, _GCP_GATE_SIGMAS)
    obs = model.observations
    return AutomaticGcps(
        point=model.keypoint,
        position=model.points,
        cov=model.cov,
        ray_gcp=obs.point,
        ray_reference=obs.view,
        by_reference_pose=point_by_reference_pose(model),
        reference_ids=tuple(reference.images[i].image_id for i in used),
        reference_errors=reference.errors(used),
    )


def _reference_matches(
    localized: Sequence[Localized], known: Sequence[bool], reference: ReferenceMap
) -> tuple[list[int], list[PairMatches]]:
    """The references that localizations with a known camera rest on, and their verified matches with the new images."""
    index = {image.image_id: i for i, image in enumerate(reference.images)}
    taking_part = [(n, result) for n, result in enumerate(localized) if known[n]]
    used = sorted({index[m.reference_id] for _, result in taking_part for m in result.matches})
    place = {i: len(localized) + k for k, i in enumerate(used)}
    matches = [
        PairMatches(n, place[index[m.reference_id]], m.indices) for n, result in taking_part for m in result.matches
    ]
    if not matches:
        raise StageError(
            "No localized image has matches with the reference; there are no automatic GCPs to adjust with."
        )
    return used, matches


def _pose_priors(localized: Sequence[Localized], known: Sequence[bool], *, of_all: bool) -> Mapping[int, PosePrior]:
    return {
        i: PosePrior(r.world_from_cam, r.world_from_cam_cov) for i, r in enumerate(localized) if of_all or not known[i]
    }


def _marked_in(control: tuple[ControlPoint, ...], image_ids: Sequence[str]) -> tuple[ControlPoint, ...]:
    """The control points with their marks in some images."""
    return tuple(replace(p, marks=tuple(m for m in p.marks if m.image_id in image_ids)) for p in control)


def position_priors(images: Sequence[Image], localized: Sequence[Localized]):
    """GNSS of the images whose localization does not already contradict it; images of one station share one fix.

    Each of n such images gets it with n times its covariance, so that together they know no more than was measured.
    """
    taking = [i for i, result in enumerate(localized) if images[i].gnss is not None and not result.gnss_rejected]
    together = Counter(images[i].station for i in taking if images[i].station is not None)
    priors = {i: (images[i].gnss, together.get(images[i].station, 1)) for i in taking}
    return {i: PositionPrior(p.position_in_world, n * p.cov) for i, (p, n) in priors.items() if p is not None}
