"""Localization by look-up: a first pose tells where the verified tracks of the reference are seen, and how surely.

The first pose comes from descriptors of tracks in the most promising references, or from the matcher where these are
not enough. Then the map points that it sees from a similar side are projected into the query, and compared with the
keypoints within the disc that the covariances of pose, point and keypoint allow; the pose is refined, and once more
with the smaller discs, on points as they are seen from the side of the query.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from georef.estimation.agreement import Matched, contradicting_epoch
from georef.estimation.candidates import overlap
from georef.estimation.global_model import global_model, one_point_each
from georef.estimation.guided import GuidedOptions
from georef.estimation.local_model import LocalModel
from georef.estimation.pnp import EstimatedPose, refine_pose
from georef.estimation.query import Query, consensus, outcome_of
from georef.estimation.query_centred import first_pose
from georef.estimation.seen_tracks import SeenTracks, as_seen_from, associate, local_model_of, without_views
from georef.features.nearest import MutualNearest
from georef.geometry.rigid import Rigid3
from georef.types.features import Matches
from georef.types.results import Outcome, Rejected, RejectReason

_VOTE_RATIO = 0.95


def from_tracks(query: Query, ranked: NDArray[np.int64]) -> Outcome:
    """A first pose, then the tracks that it sees, looked for where they must be."""
    first = _first(query, ranked)
    if isinstance(first, Rejected):
        return first
    estimate, model = first
    names: list[int] = []
    for last in (False, True):
        with query.timed("candidates"):
            chosen = _that_see(query, ranked, estimate.world_from_cam, model)
        with query.timed("map points"):
            model, names = _found(query, estimate, chosen)
            if last:
                model = as_seen_from(model, estimate.world_from_cam, query.reference.noise)
        with query.timed("pose"):
            refined = refine_pose(estimate.world_from_cam, query.observed, model, query.reference.errors(names))
        if refined is None:
            return outcome_of(query, None, model, names)
        estimate = refined
        if query.image.camera.estimate:
            query.use(estimate.camera)
    return _agreeing(query, estimate, model, names)


def _agreeing(query: Query, estimate: EstimatedPose, model: LocalModel, names: list[int]) -> Outcome:
    """The outcome without the epochs that contradict the others."""
    for _ in range(len({query.reference.images[i].epoch for i in names}) - 1):
        with query.timed("agreement"):
            matched = _matched(query, model.take(estimate.inliers), names)
            odd = contradicting_epoch(matched, query.observed, estimate.world_from_cam)
        if odd is None:
            break
        query.notes.append(odd.describe(query.reference.images[names[odd.views[0]]].image_id))
        model, names = without_views(model, names, odd.views, query.reference.views)
        with query.timed("pose"):
            refined = refine_pose(estimate.world_from_cam, query.observed, model, query.reference.errors(names))
        if refined is None:
            return outcome_of(query, None, model, names)
        estimate = refined
    return outcome_of(query, estimate, model, names)


def _matched(query: Query, model: LocalModel, names: Sequence[int]) -> Matched:
    """What the references have in common with the query: the observations of the tracks that it sees."""
    obs = model.observations
    pairs = np.column_stack([model.keypoint[obs.point], obs.keypoint]).astype(np.int32)
    here = [obs.view == view for view in range(len(names))]
    return Matched(
        [query.reference.posed(i) for i in names],
        [Matches(pairs[rows], np.ones(int(rows.sum()), np.float32)) for rows in here],
        query.reference.errors(names),
        [query.reference.images[i].epoch for i in names],
        query.reference.noise.keypoint_sigma,
    )


def _found(query: Query, estimate: EstimatedPose, chosen: Sequence[int]) -> tuple[LocalModel, list[int]]:
    """The tracks of some references that keypoints of the query are found for, and the references that see them."""
    structures = {index: query.reference.structure(index) for index in chosen}
    posed = {index: query.reference.posed(index) for index in chosen}
    seen = SeenTracks.of(structures, posed, estimate.world_from_cam, query.observed.camera)
    options = GuidedOptions.of(query.config)
    pairs = associate(seen, posed, query.posed, query.observed, estimate, options)
    return local_model_of(seen, structures, pairs, query.reference.views)


def _first(query: Query, ranked: NDArray[np.int64]) -> tuple[EstimatedPose, LocalModel] | Rejected:
    """A pose with its covariance, from descriptors of tracks, else from the matcher."""
    for count in sorted({query.search.config.first_count, query.search.config.count}):
        found = _by_descriptors(query, [int(i) for i in ranked[:count]])
        if not isinstance(found, Rejected):
            return found
    query.notes.append("first pose by the matcher: descriptors of tracks were not enough")
    first = first_pose(query, ranked)
    if isinstance(first, Rejected):
        return first
    pose, model, indices = first
    with query.timed("pose"):
        return _refined(query, pose, model, indices)


def _by_descriptors(query: Query, candidates: Sequence[int]) -> tuple[EstimatedPose, LocalModel] | Rejected:
    matcher = MutualNearest(ratio=_VOTE_RATIO)
    with query.timed("first matches"):
        own = query.features.head(query.match_keypoints)
        structures = {index: query.reference.structure(index) for index in candidates}
        matches = {}
        for index, structure in structures.items():
            tracked = structure.keypoint[structure.keypoint < query.match_keypoints]
            found = matcher.match(own, query.reference.posed(index).features.take(tracked))
            found.indices[:, 1] = tracked[found.indices[:, 1]]
            matches[index] = found
        model, names = global_model(structures, matches, query.reference.views)
    with query.timed("pose"):
        if len(model) < query.config.min_inliers:
            detail = f"{len(model)} tracks in {len(candidates)} images"
            return Rejected(query.image.image_id, RejectReason.FEW_MATCHES, detail)
        found = consensus(query, model)
        if isinstance(found, Rejected):
            return found
        model = model.take(one_point_each(found.world_from_cam, query.observed, model, found.inliers))
        return _refined(query, found.world_from_cam, model, names)


def _refined(
    query: Query, pose: Rigid3, model: LocalModel, names: Sequence[int]
) -> tuple[EstimatedPose, LocalModel] | Rejected:
    estimate = refine_pose(pose, query.observed, model, query.reference.errors(names))
    if estimate is None:
        detail = f"{len(model)} points do not fix the pose"
        return Rejected(query.image.image_id, RejectReason.DEGENERATE, detail)
    query.use(estimate.camera)
    return estimate, model.take(estimate.inliers)


def _that_see(query: Query, ranked: NDArray[np.int64], pose: Rigid3, model: LocalModel) -> list[int]:
    """The references that see most of the points from a similar side, at most `count`."""
    directions = model.points - pose.translation
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    asked = [int(i) for i in query.search.with_neighbours(ranked, pose.translation)]
    cameras = [query.reference.images[i].camera for i in asked]
    sizes = np.array([[c.width, c.height] for c in cameras], dtype=float)
    seen = overlap(model.points, directions, query.reference.views(asked), sizes)
    order = np.argsort(-seen, kind="stable")
    return [asked[i] for i in order[: query.search.config.count] if seen[i] > 0]
