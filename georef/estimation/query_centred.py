"""The default way: a first pose from a few references, then guided matching in all that see the same points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from georef.estimation.agreement import Contradiction, Matched, contradiction
from georef.estimation.expected import most_informative
from georef.estimation.guided import GuidedOptions, guided_matches
from georef.estimation.local_model import LocalModel, query_centred_model
from georef.estimation.pnp import EstimatedPose, refine_pose
from georef.estimation.query import Query, consensus, matched, outcome_of
from georef.geometry.covariance import largest_position_sigma
from georef.geometry.rigid import Array, Rigid3
from georef.types.features import Matches
from georef.types.results import Outcome, Rejected, RejectReason

_MOST_LEFT_OUT = 3  # contradictions of one query; with more, it is not the references that are odd


def query_centred(query: Query, ranked: NDArray[np.int64]) -> Outcome:
    """A first pose from a few references by the matcher, then guided matching in all that see the same points."""
    first = first_pose(query, ranked)
    if isinstance(first, Rejected):
        return first
    pose, model, _ = first
    order = _in_order(query, ranked, pose, model)
    found = _guided_poses(query, pose, order)
    if query.image.camera.estimate and found.estimate is not None:  # its lines were those of a camera from few matches
        query.use(found.estimate.camera)
        found = _guided_poses(query, found.estimate.world_from_cam, order)
    found = _agreeing(query, found)
    return outcome_of(query, found.estimate, found.model, found.chosen)


@dataclass(frozen=True, eq=False)
class _Guided:
    """A pose from the guided matches with some references."""

    chosen: list[int]
    matches: list[Matches]
    estimate: EstimatedPose | None
    model: LocalModel


@dataclass(frozen=True, eq=False)
class _Order:
    """References, the most helpful first, and the position sigma (m) that is expected with each and those before."""

    indices: list[int]
    sigma_m: Array

    def needed(self, sigma_m: float, factor: float = 1.0) -> int:
        """How many of them are expected to reach a sigma; all where none does."""
        enough = np.flatnonzero(factor * self.sigma_m <= sigma_m)
        return int(enough[0]) + 1 if len(enough) else len(self.indices)


def _guided_poses(query: Query, pose: Rigid3, order: _Order) -> _Guided:
    """Guided matching in as many references as it takes until the position is known well enough, or in all."""
    target, least = query.search.config.target_sigma_m, query.search.config.first_count
    count = max(least, order.needed(target))
    matches: list[Matches] = []
    while True:
        chosen = order.indices[:count]
        with query.timed("guided matching"):
            matches += [_guided(query, pose, index) for index in chosen[len(matches) :]]
        found = _pose_of(query, pose, chosen, matches)
        sigma = np.inf if found.estimate is None else largest_position_sigma(found.estimate.cov)
        if sigma <= target or count >= len(order.indices):
            return found
        factor = sigma / order.sigma_m[len(chosen) - 1]
        count = max(count + 1, order.needed(target, factor))


def _pose_of(query: Query, pose: Rigid3, chosen: list[int], matches: list[Matches]) -> _Guided:
    with query.timed("pose"):
        references = [query.reference.posed(i) for i in chosen]
        model = query_centred_model(references, matches, query.reference.noise.keypoint_sigma)
        estimate = refine_pose(pose, query.observed, model, query.reference.errors(chosen))
        return _Guided(chosen, matches, estimate, model)


def _agreeing(query: Query, found: _Guided) -> _Guided:
    """The pose without the references and epochs that contradict the others."""
    for _ in range(_MOST_LEFT_OUT):
        if found.estimate is None:
            return found
        with query.timed("agreement"):
            odd = _contradiction(query, found, found.estimate)
        if odd is None:
            return found
        query.notes.append(odd.describe(query.reference.images[found.chosen[odd.views[0]]].image_id))
        kept = [v for v in range(len(found.chosen)) if v not in odd.views]
        chosen, matches = [found.chosen[v] for v in kept], [found.matches[v] for v in kept]
        found = _pose_of(query, found.estimate.world_from_cam, chosen, matches)
    return found


def _contradiction(query: Query, found: _Guided, estimate: EstimatedPose) -> Contradiction | None:
    matched = Matched(
        [query.reference.posed(i) for i in found.chosen],
        found.matches,
        query.reference.errors(found.chosen),
        [query.reference.images[i].epoch for i in found.chosen],
        query.reference.noise.keypoint_sigma,
    )
    observed = query.observed.with_camera(estimate.camera)
    return contradiction(matched, observed, estimate.world_from_cam, found.model.take(estimate.inliers))


def first_pose(query: Query, ranked: NDArray[np.int64]) -> tuple[Rigid3, LocalModel, list[int]] | Rejected:
    """A pose by the matcher from a few references, else from more, with its points and the references they are from."""
    found: tuple[Rigid3, LocalModel] | Rejected
    found = Rejected(query.image.image_id, RejectReason.NO_CANDIDATES, "no reference image")
    for count in sorted({query.search.config.first_count, query.search.config.count}):
        indices = [int(i) for i in ranked[:count]]
        found = _first_pose_of(query, indices)
        if not isinstance(found, Rejected):
            return (*found, indices)
    return found


def _first_pose_of(query: Query, indices: list[int]) -> tuple[Rigid3, LocalModel] | Rejected:
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
        refined = refine_pose(found.world_from_cam, query.observed, model, query.reference.errors(indices))
        if refined is None:
            detail = f"{len(model)} points do not fix the pose and the camera"
            return Rejected(query.image.image_id, RejectReason.DEGENERATE, detail)
        query.use(refined.camera)
        return refined.world_from_cam, model


def _in_order(query: Query, ranked: NDArray[np.int64], pose: Rigid3, model: LocalModel) -> _Order:
    """The references that fix the pose best together, `count` at most."""
    with query.timed("candidates"):
        asked = [int(i) for i in query.search.with_neighbours(ranked, pose.translation)]
        cameras = [query.reference.images[i].camera for i in asked]
        sizes = np.array([[c.width, c.height] for c in cameras], dtype=float)
        choice = most_informative(
            pose,
            query.observed,
            model,
            query.reference.views(asked),
            sizes,
            [query.reference.pose_cov(i) for i in asked],
            query.reference.noise,
            query.search.config.first_count,
            query.search.config.count,
        )
        return _Order([asked[int(i)] for i in choice.order], choice.sigma_m)


def _guided(query: Query, pose: Rigid3, index: int) -> Matches:
    options = GuidedOptions.of(query.config)
    known = query.pairs.get(index)
    return guided_matches(query.posed.posed(pose), query.reference.posed(index), options, known)
