"""The adjustment problem of a new epoch: localized images, constraints of the configured kind, tie points."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from georef.config import AdjustConfig, LocalizeConfig
from georef.errors import StageError
from georef.estimation.adjustment.problem import AutomaticGcps, Problem
from georef.estimation.candidates import overlap
from georef.estimation.guided import GuidedOptions, PosedFeatures, guided_matches
from georef.estimation.local_model import triangulate_consistent
from georef.estimation.reference_map import ReferenceMap
from georef.estimation.tracks import (
    PairMatches,
    build_tracks,
    distributed,
    select_points,
    triangulated_tracks,
)
from georef.executor import Progress
from georef.geometry.projection import Views, linearize
from georef.types.campaign import Image, PosePrior
from georef.types.constraints import ControlPoint
from georef.types.results import Localized
from georef.types.scene import Observations

_LEAST_PAIR_MATCHES = 15
_GCP_GATE_SIGMAS = 3.5


def match_new_images(
    images: Sequence[PosedFeatures],
    localized: Sequence[Localized],
    config: LocalizeConfig,
    progress: Progress,
) -> list[PairMatches]:
    """Guided matches of all pairs of new images that can see common points of their localization."""
    options = GuidedOptions(config.guided_gate, config.guided_min_similarity, config.guided_ratio)
    out = []
    progress.begin("tie points", len(images) * (len(images) - 1) // 2)
    for i, j in combinations(range(len(images)), 2):
        if _sees(images[j], localized[i]) or _sees(images[i], localized[j]):
            matches = guided_matches(images[i], images[j], options)
            if len(matches) >= _LEAST_PAIR_MATCHES:
                out.append(PairMatches(i, j, matches.indices))
        progress.advance()
    progress.end()
    return out


def _sees(image: PosedFeatures, other: Localized) -> bool:
    """Whether an image can see points that another was localized from, from a similar side."""
    directions = other.points_in_world - other.world_from_cam.translation
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    views = Views.of([image.world_from_cam], [image.camera])
    size = np.array([[image.camera.width, image.camera.height]], dtype=float)
    return bool(overlap(other.points_in_world, directions, views, size)[0] > 0)


def epoch_problem(
    images: Sequence[Image],
    localized: Sequence[Localized],
    new: Sequence[PosedFeatures],
    ties: Sequence[PairMatches],
    reference: ReferenceMap,
    control: tuple[ControlPoint, ...],
    config: AdjustConfig,
) -> Problem:
    """The problem of the localized images (all four sequences in one order) for the configured constraints."""
    posed, matches, covs = list(new), list(ties) if config.tie_points else [], [r.world_from_cam_cov for r in localized]
    used: list[int] = []
    if config.constraints == "auto-gcps":
        used, to_references = _reference_matches(localized, reference, len(new))
        posed += [reference.posed(i) for i in used]
        covs += [reference.pose_cov(i) for i in used]
        matches += to_references
    points, observations = _points(posed, matches, covs, reference.noise.keypoint_sigma, len(new), config)
    in_new = observations.view < len(new)
    problem = Problem(
        image_ids=tuple(r.image_id for r in localized),
        cameras=tuple(p.camera for p in new),
        world_from_cams=tuple(p.world_from_cam for p in new),
        points=points,
        observations=observations.take(in_new),
        gcps=_automatic_gcps(observations.take(~in_new), len(points), len(new), used, reference),
        pose_priors=_pose_priors(localized) if config.constraints == "pose-priors" else {},
        position_priors=_position_priors(images, localized) if config.gnss else {},
        control=control if config.surveyed_control else (),
    )
    return problem.restricted(np.ones(len(problem.observations), bool), np.ones(len(problem.gcps), bool))


def _points(posed, matches, covs, keypoint_sigma, new_count, config):
    """Tracks, triangulated, thinned to the budget of the new images."""
    count, observations = build_tracks(posed, matches, keypoint_sigma)
    if count == 0:
        return np.zeros((0, 3)), observations
    points, observations = triangulated_tracks(count, observations, posed, covs)
    sizes = np.array([[p.camera.width, p.camera.height] for p in posed], dtype=float)
    is_new = np.arange(len(posed)) < new_count
    in_new = np.bincount(observations.point[observations.view < new_count], minlength=len(points))
    gcp = np.bincount(observations.point[observations.view >= new_count], minlength=len(points)) >= 2
    keep = np.zeros(len(points), bool)
    for kind, budget in (
        (gcp & (in_new >= 1), config.max_gcps_per_image),
        (~gcp & (in_new >= 2), config.max_tie_points_per_image),
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
    lin = linearize(views, obs.view, model.points[obs.point])
    pull = np.einsum("nki,nkj->nij", lin.by_point, lin.by_pose) / np.square(obs.sigma_px)[:, None, None]
    return AutomaticGcps(
        point=model.keypoint,
        position=model.points,
        cov=model.cov,
        ray_gcp=obs.point,
        ray_reference=obs.view,
        by_reference_pose=-model.cov[obs.point] @ pull,
        reference_ids=tuple(reference.images[i].image_id for i in used),
        reference_covs=np.array([reference.pose_cov(i) for i in used]),
    )


def _reference_matches(
    localized: Sequence[Localized], reference: ReferenceMap, new_count: int
) -> tuple[list[int], list[PairMatches]]:
    """The references that the localizations rest on, and their verified matches with the new images."""
    index = {image.image_id: i for i, image in enumerate(reference.images)}
    used = sorted({index[m.reference_id] for result in localized for m in result.matches})
    place = {i: new_count + k for k, i in enumerate(used)}
    matches = [
        PairMatches(n, place[index[m.reference_id]], m.indices)
        for n, result in enumerate(localized)
        for m in result.matches
    ]
    if not matches:
        raise StageError(
            "No localized image has matches with the reference; there are no automatic GCPs to adjust with."
        )
    return used, matches


def _pose_priors(localized: Sequence[Localized]) -> Mapping[int, PosePrior]:
    return {i: PosePrior(r.world_from_cam, r.world_from_cam_cov) for i, r in enumerate(localized)}


def _position_priors(images: Sequence[Image], localized: Sequence[Localized]):
    """GNSS of the images whose localization does not already contradict it."""
    return {
        i: image.gnss
        for i, (image, result) in enumerate(zip(images, localized, strict=True))
        if image.gnss is not None and not result.gnss_rejected
    }
