"""One image on its way to a pose: what every method of localization needs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from georef.config import LocalizeConfig
from georef.estimation.first_pose import FirstPose, QueryImage, ransac_pose
from georef.estimation.guided import PosedFeatures
from georef.estimation.local_model import LocalModel
from georef.estimation.pnp import EstimatedPose, refit_pose
from georef.estimation.reference_map import ReferenceMap
from georef.estimation.search import Search
from georef.estimation.timer import StepTimer
from georef.estimation.weak_geometry import arrangement, weak_geometry, weakness
from georef.features.base import Matcher
from georef.geometry.camera import Camera
from georef.geometry.covariance import largest_position_sigma
from georef.geometry.rigid import Rigid3
from georef.types.campaign import Image
from georef.types.features import Features, Matches
from georef.types.results import Localized, Outcome, ReferenceMatches, Rejected, RejectReason


@dataclass
class Query:
    """What the localization of one image carries along: its inputs, its matches, and how long each step took."""

    image: Image
    features: Features
    reference: ReferenceMap
    matcher: Matcher
    config: LocalizeConfig
    match_keypoints: int
    search: Search
    observed: QueryImage = field(init=False)
    posed: PosedFeatures = field(init=False)
    cpu_s: dict[str, float] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    pairs: dict[int, Matches] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.use(self.image.camera)

    def use(self, camera: Camera) -> None:
        """Go on with another camera of the query image: one that was estimated."""
        self.posed = PosedFeatures.of(self.features, camera, Rigid3.identity())
        sigma = self.reference.noise.keypoint_sigma * self.features.scales_px.astype(np.float64)
        self.observed = QueryImage(camera, self.posed.pixels, sigma)

    def timed(self, step: str) -> StepTimer:
        return StepTimer(self.cpu_s, step)


def matched(query: Query, index: int) -> Matches:
    """Matches of the query with a reference by the matcher, computed once."""
    if index not in query.pairs:
        with query.timed("matching"):
            reference = query.reference.posed(index).features
            count = query.match_keypoints
            query.pairs[index] = query.matcher.match(query.features.head(count), reference.head(count))
    return query.pairs[index]


def consensus(query: Query, model: LocalModel) -> FirstPose | Rejected:
    """The pose that enough points agree with; from here on `query` has the camera that it was found with."""
    query.use(query.image.camera)
    found = ransac_pose(query.observed, model, query.config.ransac_gate_px, query.config.seed)
    inliers = 0 if found is None else int(found.inliers.sum())
    if found is None or not _enough(inliers, model, query.config):
        detail = f"{inliers} of {len(model)} points agree with one pose"
        return Rejected(query.image.image_id, RejectReason.FEW_INLIERS, detail)
    query.use(found.camera)
    return found


def outcome_of(query: Query, estimate: EstimatedPose | None, model: LocalModel, chosen: Sequence[int]) -> Outcome:
    image_id = query.image.image_id
    if estimate is None:
        why = f": {', '.join(arrangement(query.observed, model))}" if len(model) else ""
        return Rejected(image_id, RejectReason.DEGENERATE, f"{len(model)} points do not fix the pose{why}")
    inliers = int(estimate.inliers.sum())
    if not _enough(inliers, model, query.config):
        return Rejected(image_id, RejectReason.FEW_INLIERS, f"{inliers} of {len(model)} points agree with one pose")
    used = model.take(estimate.inliers)
    sigma = largest_position_sigma(estimate.cov)
    if sigma > query.config.max_position_sigma_m:
        limit = query.config.max_position_sigma_m
        why = "; ".join([weakness(estimate.relative_cov).text, *arrangement(query.observed, used)])
        detail = f"position sigma {sigma:.2f} m, over {limit:g} m: {why}"
        return Rejected(image_id, RejectReason.DEGENERATE, detail)
    if weak := weak_geometry(estimate.relative_cov, query.observed, used):
        query.notes.append(weak)
    if 0 < query.config.max_correspondences < len(used):
        used, estimate = _thinned(query, used, estimate, chosen)
    return Localized(
        image_id=image_id,
        world_from_cam=estimate.world_from_cam,
        world_from_cam_cov=estimate.cov,
        relative_cov=estimate.relative_cov,
        correspondence_count=len(used),
        sigma0=estimate.sigma0,
        matches=_reference_matches(used, [query.reference.images[i].image_id for i in chosen]),
        points_in_world=used.points,
        keypoints=used.keypoint,
        cpu_s=dict(query.cpu_s),
        camera=estimate.camera if query.image.camera.estimate else None,
        intrinsics_cov=estimate.intrinsics_cov if query.image.camera.estimate else None,
        quarter_turns=query.features.quarter_turns,
    )


def _enough(inliers: int, model: LocalModel, config: LocalizeConfig) -> bool:
    """Whether enough points agree; of several points of one keypoint, one at most can."""
    return inliers >= config.min_inliers and inliers >= config.min_inlier_ratio * len(np.unique(model.keypoint))


def _thinned(
    query: Query, model: LocalModel, estimate: EstimatedPose, chosen: Sequence[int]
) -> tuple[LocalModel, EstimatedPose]:
    """The pose from a random choice of the verified points, where the configuration limits their number."""
    order = np.random.default_rng(query.config.seed).permutation(len(model))
    model = model.take(np.isin(np.arange(len(model)), order[: query.config.max_correspondences]))
    observed = query.observed.with_camera(estimate.camera)
    refined = refit_pose(estimate.world_from_cam, observed, model, query.reference.errors(chosen))
    return model, refined or estimate


def _reference_matches(model: LocalModel, ids: Sequence[str]) -> tuple[ReferenceMatches, ...]:
    obs = model.observations
    pairs = np.column_stack([model.keypoint[obs.point], obs.keypoint]).astype(np.int32)
    return tuple(ReferenceMatches(name, pairs[obs.view == i]) for i, name in enumerate(ids) if (obs.view == i).any())
