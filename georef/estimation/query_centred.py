"""The default way: a first pose from a few references, then guided matching in all that see the same points."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from georef.estimation.candidates import overlap
from georef.estimation.guided import GuidedOptions, guided_matches
from georef.estimation.local_model import LocalModel, query_centred_model
from georef.estimation.pnp import EstimatedPose, refine_pose
from georef.estimation.query import Query, consensus, matched, outcome_of
from georef.geometry.rigid import Rigid3
from georef.types.features import Matches
from georef.types.results import Outcome, Rejected, RejectReason


def query_centred(query: Query, ranked: NDArray[np.int64]) -> Outcome:
    """A first pose from a few references by the matcher, then guided matching in all that see the same points."""
    first = None
    for count in sorted({query.search.config.first_count, query.search.config.count}):
        first = first_pose_of(query, [int(i) for i in ranked[:count]])
        if not isinstance(first, Rejected):
            break
    if first is None or isinstance(first, Rejected):
        return first or Rejected(query.image.image_id, RejectReason.NO_CANDIDATES, "no reference image")
    pose, model = first
    chosen = that_see(query, ranked, pose, model)
    estimate, model = _guided_pose(query, pose, chosen)
    if query.image.camera.estimate and estimate is not None:  # its lines were those of a camera from few matches
        query.use(estimate.camera)
        estimate, model = _guided_pose(query, estimate.world_from_cam, chosen)
    return outcome_of(query, estimate, model, chosen)


def _guided_pose(query: Query, pose: Rigid3, chosen: Sequence[int]) -> tuple[EstimatedPose | None, LocalModel]:
    with query.timed("guided matching"):
        matches = [_guided(query, pose, index) for index in chosen]
    with query.timed("pose"):
        references = [query.reference.posed(i) for i in chosen]
        model = query_centred_model(references, matches, query.reference.noise.keypoint_sigma)
        return refine_pose(pose, query.observed, model, lambda v: query.reference.pose_cov(chosen[v])), model


def first_pose_of(query: Query, indices: list[int]) -> tuple[Rigid3, LocalModel] | Rejected:
    matches = [matched(query, index) for index in indices]
    with query.timed("pose"):
        references = [query.reference.posed(i) for i in indices]
        model = query_centred_model(references, matches, query.reference.noise.keypoint_sigma)
        if len(model) < query.config.min_inliers:
            total = sum(len(m) for m in matches)
            detail = f"{len(model)} points that two references agree on, of {total} matches in {len(indices)} images"
            return Rejected(query.image.image_id, RejectReason.FEW_MATCHES, detail)
        found = consensus(query, model)
        if isinstance(found, Rejected):
            return found
        model = model.take(found.inliers)
        if not query.image.camera.estimate:
            return found.world_from_cam, model
        refined = refine_pose(
            found.world_from_cam, query.observed, model, lambda v: query.reference.pose_cov(indices[v])
        )
        if refined is None:
            detail = f"{len(model)} points do not fix the pose and the camera"
            return Rejected(query.image.image_id, RejectReason.DEGENERATE, detail)
        query.use(refined.camera)
        return refined.world_from_cam, model


def that_see(query: Query, ranked: NDArray[np.int64], pose: Rigid3, model: LocalModel) -> list[int]:
    """The references that see most of the points from a similar side, at most `count`, already matched ones first."""
    with query.timed("candidates"):
        directions = model.points - pose.translation
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        asked = query.search.with_neighbours(ranked, pose.translation)
        cameras = [query.reference.images[int(i)].camera for i in asked]
        sizes = np.array([[c.width, c.height] for c in cameras], dtype=float)
        seen = overlap(model.points, directions, query.reference.views([int(i) for i in asked]), sizes)
        order = np.argsort(-seen, kind="stable")
        return [int(asked[i]) for i in order[: query.search.config.count] if seen[i] > 0]


def _guided(query: Query, pose: Rigid3, index: int) -> Matches:
    options = GuidedOptions(query.config.guided_gate, query.config.guided_min_similarity, query.config.guided_ratio)
    known = query.pairs.get(index)
    return guided_matches(query.posed.posed(pose), query.reference.posed(index), options, known)
