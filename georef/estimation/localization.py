"""Localization of one image against the reference: `Localized | Rejected(reason)`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import pycolmap
from numpy.typing import NDArray

from georef.config import CandidatesConfig, LocalizeConfig
from georef.estimation.candidates import Box, overlap, search_box
from georef.estimation.first_pose import FirstPose, QueryImage, ransac_pose
from georef.estimation.global_model import global_model, one_point_each
from georef.estimation.guided import GuidedOptions, PosedFeatures, guided_matches
from georef.estimation.local_model import LocalModel, query_centred_model
from georef.estimation.pnp import EstimatedPose, refine_pose, refit_pose, with_covariance
from georef.estimation.prior_check import against_prior
from georef.estimation.published import VerifyPair, published_model, verify_pair
from georef.estimation.reference_map import ReferenceMap
from georef.estimation.search import FindSimilar, Search
from georef.estimation.timer import StepTimer
from georef.features.base import Matcher
from georef.geometry.camera import Camera
from georef.geometry.rigid import Rigid3
from georef.types.campaign import Image
from georef.types.features import Features, Matches
from georef.types.results import Localized, Outcome, ReferenceMatches, Rejected, RejectReason


@dataclass
class _Work:
    """What one localization carries along: its inputs, and how long each step took."""

    image: Image
    features: Features
    reference: ReferenceMap
    matcher: Matcher
    config: LocalizeConfig
    match_keypoints: int
    search: Search
    query: QueryImage = field(init=False)
    posed: PosedFeatures = field(init=False)
    cpu_s: dict[str, float] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    pairs: dict[int, Matches] = field(default_factory=dict)
    tried: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        self.use(self.image.camera)

    def use(self, camera: Camera) -> None:
        """Go on with another camera of the query image: one that was estimated."""
        self.posed = PosedFeatures.of(self.features, camera, Rigid3.identity())
        sigma = self.reference.noise.keypoint_sigma * self.features.scales_px.astype(np.float64)
        self.query = QueryImage(camera, self.posed.pixels, sigma)

    def timed(self, step: str) -> StepTimer:
        return StepTimer(self.cpu_s, step)


def localize_image(
    image: Image,
    features: Features,
    reference: ReferenceMap,
    matcher: Matcher,
    candidates: CandidatesConfig,
    config: LocalizeConfig,
    match_keypoints: int,
    find_similar: FindSimilar | None = None,
) -> Outcome:
    """The pose of one image with its covariance, or why there is none.

    References inside the position prior's box are tried first, then the whole reference. find_similar: the vector
    database, asked for this image; needed for every ranking but "votes".
    """
    if len(features) < config.min_inliers:
        return Rejected(image.image_id, RejectReason.FEW_FEATURES, f"{len(features)} keypoints")
    search = Search(reference, features, image.heading_rad, candidates, find_similar)
    work = _Work(image, features, reference, matcher, config, match_keypoints, search)
    box = search_box(search.positions, image.gnss, candidates)
    outcome = _localize_in(work, box)
    if isinstance(outcome, Rejected) and not box.whole_reference:
        work.notes.append(
            f"inside the search box: {outcome.reason.value} ({outcome.detail}); tried the whole reference"
        )
        outcome = _localize_in(work, search_box(search.positions, None, candidates))
    judged = against_prior(outcome, image, config)
    return replace(judged, notes=tuple(work.notes), cpu_s=dict(work.cpu_s), candidates=work.tried)


def _localize_in(work: _Work, box: Box) -> Outcome:
    if box.note:
        work.notes.append(box.note)
    with work.timed("candidates"):
        ranked, note = work.search.ranked(box)
    if note:
        work.notes.append(note)
    if len(ranked) < 2:
        return Rejected(work.image.image_id, RejectReason.NO_CANDIDATES, f"{len(ranked)} reference images")
    work.tried = tuple(work.reference.images[int(i)].image_id for i in ranked[: work.search.config.count])
    return _METHODS[work.config.method](work, ranked)


def _query_centred(work: _Work, ranked: NDArray[np.int64]) -> Outcome:
    """A first pose from a few references by the matcher, then guided matching in all that see the same points."""
    first = None
    for count in sorted({work.search.config.first_count, work.search.config.count}):
        first = _first_pose(work, [int(i) for i in ranked[:count]])
        if not isinstance(first, Rejected):
            break
    if first is None or isinstance(first, Rejected):
        return first or Rejected(work.image.image_id, RejectReason.NO_CANDIDATES, "no reference image")
    pose, model = first
    chosen = _that_see(work, ranked, pose, model)
    estimate, model = _guided_pose(work, pose, chosen)
    if work.image.camera.estimate and estimate is not None:  # its lines were those of a camera from few matches
        work.use(estimate.camera)
        estimate, model = _guided_pose(work, estimate.world_from_cam, chosen)
    return _outcome(work, estimate, model, chosen)


def _guided_pose(work: _Work, pose: Rigid3, chosen: Sequence[int]) -> tuple[EstimatedPose | None, LocalModel]:
    with work.timed("guided matching"):
        matches = [_guided(work, pose, index) for index in chosen]
    with work.timed("pose"):
        references = [work.reference.posed(i) for i in chosen]
        model = query_centred_model(references, matches, work.reference.noise.keypoint_sigma)
        return refine_pose(pose, work.query, model, lambda v: work.reference.pose_cov(chosen[v])), model


def _first_pose(work: _Work, indices: list[int]) -> tuple[Rigid3, LocalModel] | Rejected:
    matches = [_matched(work, index) for index in indices]
    with work.timed("pose"):
        references = [work.reference.posed(i) for i in indices]
        model = query_centred_model(references, matches, work.reference.noise.keypoint_sigma)
        if len(model) < work.config.min_inliers:
            total = sum(len(m) for m in matches)
            detail = f"{len(model)} points that two references agree on, of {total} matches in {len(indices)} images"
            return Rejected(work.image.image_id, RejectReason.FEW_MATCHES, detail)
        found = _consensus(work, model)
        if isinstance(found, Rejected):
            return found
        model = model.take(found.inliers)
        if not work.image.camera.estimate:
            return found.world_from_cam, model
        refined = refine_pose(found.world_from_cam, work.query, model, lambda v: work.reference.pose_cov(indices[v]))
        if refined is None:
            detail = f"{len(model)} points do not fix the pose and the camera"
            return Rejected(work.image.image_id, RejectReason.DEGENERATE, detail)
        work.use(refined.camera)
        return refined.world_from_cam, model


def _consensus(work: _Work, model: LocalModel) -> FirstPose | Rejected:
    """The pose that enough points agree with; from here on `work` has the camera that it was found with."""
    work.use(work.image.camera)
    found = ransac_pose(work.query, model, work.config.ransac_gate_px, work.config.seed)
    inliers = 0 if found is None else int(found.inliers.sum())
    if found is None or not _enough(inliers, len(model), work.config):
        detail = f"{inliers} of {len(model)} points agree with one pose"
        return Rejected(work.image.image_id, RejectReason.FEW_INLIERS, detail)
    work.use(found.camera)
    return found


def _matched(work: _Work, index: int) -> Matches:
    """Matches of the query with a reference by the matcher, computed once."""
    if index not in work.pairs:
        with work.timed("matching"):
            reference = work.reference.posed(index).features
            count = work.match_keypoints
            work.pairs[index] = work.matcher.match(work.features.head(count), reference.head(count))
    return work.pairs[index]


def _that_see(work: _Work, ranked: NDArray[np.int64], pose: Rigid3, model: LocalModel) -> list[int]:
    """The references that see most of the points from a similar side, at most `count`, already matched ones first."""
    with work.timed("candidates"):
        directions = model.points - pose.translation
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        asked = work.search.with_neighbours(ranked, pose.translation)
        cameras = [work.reference.images[int(i)].camera for i in asked]
        sizes = np.array([[c.width, c.height] for c in cameras], dtype=float)
        seen = overlap(model.points, directions, work.reference.views([int(i) for i in asked]), sizes)
        order = np.argsort(-seen, kind="stable")
        return [int(asked[i]) for i in order[: work.search.config.count] if seen[i] > 0]


def _guided(work: _Work, pose: Rigid3, index: int) -> Matches:
    options = GuidedOptions(work.config.guided_gate, work.config.guided_min_similarity, work.config.guided_ratio)
    known = work.pairs.get(index)
    return guided_matches(work.posed.posed(pose), work.reference.posed(index), options, known)


def _published(work: _Work, ranked: NDArray[np.int64]) -> Outcome:
    """All pairs among the query and its candidates matched; COLMAP's triangulation from the fixed reference poses."""
    chosen = sorted(int(i) for i in ranked[: work.search.config.count])
    references = [work.reference.posed(i) for i in chosen]
    with work.timed("matching"):
        model = published_model(references, _pair_verifier(work, chosen, references), work.reference.noise)
    return _posed_by_ransac(work, model, chosen)


def _global_model(work: _Work, ranked: NDArray[np.int64]) -> Outcome:
    """The query matched with its candidates; points of the precomputed map by the keypoints that it matches there."""
    candidates = sorted(int(i) for i in ranked[: work.candidates.count])
    matches = {index: _matched(work, index) for index in candidates}
    with work.timed("map points"):
        structures = {index: work.reference.structure(index) for index in candidates}
        model, chosen = global_model(structures, matches, work.reference.views)
    return _posed_by_ransac(work, model, chosen)


def _posed_by_ransac(work: _Work, model: LocalModel, chosen: Sequence[int]) -> Outcome:
    """RANSAC and COLMAP's refinement on its inliers, one point a keypoint; then the covariance."""
    with work.timed("pose"):
        if len(model) < work.config.min_inliers:
            return Rejected(work.image.image_id, RejectReason.FEW_MATCHES, f"{len(model)} triangulated points")
        found = _consensus(work, model)
        if isinstance(found, Rejected):
            return found
        pose, covs = found.world_from_cam, lambda v: work.reference.pose_cov(chosen[v])
        used = one_point_each(pose, work.query, model, found.inliers)
        if work.image.camera.estimate:  # COLMAP has estimated no covariance, and no distortion
            model = model.take(used)
            estimate = refine_pose(pose, work.query, model, covs)
        else:
            estimate = with_covariance(pose, work.query, model, used, covs)
    return _outcome(work, estimate, model, chosen)


def _pair_verifier(work: _Work, chosen: list[int], references: list[PosedFeatures]) -> VerifyPair:
    """Pairs of references (chosen in rising order) are verified once for all queries of a process."""

    def verify(a: int, b: int) -> pycolmap.TwoViewGeometry:
        if b == len(chosen):
            return verify_pair(references[a], work.posed, work.matcher, work.match_keypoints)
        key = chosen[a], chosen[b]
        if key not in work.reference.pairs:
            geometry = verify_pair(references[a], references[b], work.matcher, work.match_keypoints)
            work.reference.pairs[key] = geometry
        return work.reference.pairs[key]

    return verify


def _enough(inliers: int, points: int, config: LocalizeConfig) -> bool:
    return inliers >= config.min_inliers and inliers >= config.min_inlier_ratio * points


def _thinned(
    work: _Work, model: LocalModel, estimate: EstimatedPose, chosen: Sequence[int]
) -> tuple[LocalModel, EstimatedPose]:
    """The pose from a random choice of the verified points, where the configuration limits their number."""
    order = np.random.default_rng(work.config.seed).permutation(len(model))
    model = model.take(np.isin(np.arange(len(model)), order[: work.config.max_correspondences]))
    query = work.query.with_camera(estimate.camera)
    refined = refit_pose(estimate.world_from_cam, query, model, lambda v: work.reference.pose_cov(chosen[v]))
    return model, refined or estimate


def _outcome(work: _Work, estimate: EstimatedPose | None, model: LocalModel, chosen: Sequence[int]) -> Outcome:
    image_id = work.image.image_id
    if estimate is None:
        return Rejected(image_id, RejectReason.DEGENERATE, f"{len(model)} points do not fix the pose")
    inliers = int(estimate.inliers.sum())
    if not _enough(inliers, len(model), work.config):
        return Rejected(image_id, RejectReason.FEW_INLIERS, f"{inliers} of {len(model)} points agree with one pose")
    sigma = float(np.sqrt(np.linalg.eigvalsh(estimate.cov[3:, 3:])[-1]))
    if sigma > work.config.max_position_sigma_m:
        limit = work.config.max_position_sigma_m
        return Rejected(image_id, RejectReason.DEGENERATE, f"position sigma {sigma:.2f} m, over {limit:g} m")
    used = model.take(estimate.inliers)
    if 0 < work.config.max_correspondences < len(used):
        used, estimate = _thinned(work, used, estimate, chosen)
    return Localized(
        image_id=image_id,
        world_from_cam=estimate.world_from_cam,
        world_from_cam_cov=estimate.cov,
        relative_cov=estimate.relative_cov,
        correspondence_count=len(used),
        sigma0=estimate.sigma0,
        matches=_reference_matches(used, [work.reference.images[i].image_id for i in chosen]),
        points_in_world=used.points,
        keypoints=used.keypoint,
        cpu_s=dict(work.cpu_s),
        camera=estimate.camera if work.image.camera.estimate else None,
        intrinsics_cov=estimate.intrinsics_cov if work.image.camera.estimate else None,
    )


def _reference_matches(model: LocalModel, ids: Sequence[str]) -> tuple[ReferenceMatches, ...]:
    obs = model.observations
    pairs = np.column_stack([model.keypoint[obs.point], obs.keypoint]).astype(np.int32)
    return tuple(ReferenceMatches(name, pairs[obs.view == i]) for i, name in enumerate(ids) if (obs.view == i).any())


_METHODS: dict[str, Callable[[_Work, NDArray[np.int64]], Outcome]] = {
    "query-centred": _query_centred,
    "published": _published,
    "global-model": _global_model,
}
