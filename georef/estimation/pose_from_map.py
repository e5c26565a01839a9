"""Two ways to compare with: points that COLMAP triangulates about a query, or those of a precomputed map; then PnP."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pycolmap
from numpy.typing import NDArray

from georef.estimation.global_model import global_model, one_point_each
from georef.estimation.guided import PosedFeatures
from georef.estimation.local_model import LocalModel
from georef.estimation.pnp import refine_pose, with_covariance
from georef.estimation.published import VerifyPair, published_model, verify_pair
from georef.estimation.query import Query, consensus, matched, outcome_of
from georef.types.results import Outcome, Rejected, RejectReason


def from_local_model(query: Query, ranked: NDArray[np.int64]) -> Outcome:
    """All pairs among the query and its candidates matched; COLMAP's triangulation from the fixed reference poses."""
    chosen = sorted(int(i) for i in ranked[: query.search.config.count])
    references = [query.reference.posed(i) for i in chosen]
    with query.timed("matching"):
        model = published_model(references, _pair_verifier(query, chosen, references), query.reference.noise)
    return _posed_by_ransac(query, model, chosen)


def from_global_model(query: Query, ranked: NDArray[np.int64]) -> Outcome:
    """The query matched with its candidates; points of the precomputed map by the keypoints that it matches there."""
    candidates = sorted(int(i) for i in ranked[: query.search.config.count])
    matches = {index: matched(query, index) for index in candidates}
    with query.timed("map points"):
        structures = {index: query.reference.structure(index) for index in candidates}
        model, chosen = global_model(structures, matches, query.reference.views)
    return _posed_by_ransac(query, model, chosen)


def _posed_by_ransac(query: Query, model: LocalModel, chosen: Sequence[int]) -> Outcome:
    """RANSAC and COLMAP's refinement on its inliers, one point a keypoint; then the covariance."""
    with query.timed("pose"):
        if len(model) < query.config.min_inliers:
            return Rejected(query.image.image_id, RejectReason.FEW_MATCHES, f"{len(model)} triangulated points")
        found = consensus(query, model)
        if isinstance(found, Rejected):
            return found
        pose, errors = found.world_from_cam, query.reference.errors(chosen)
        used = one_point_each(pose, query.observed, model, found.inliers)
        if query.image.camera.estimate:  # COLMAP has estimated no covariance, and no distortion
            model = model.take(used)
            estimate = refine_pose(pose, query.observed, model, errors)
        else:
            estimate = with_covariance(pose, query.observed, model, used, errors)
    return outcome_of(query, estimate, model, chosen)


def _pair_verifier(query: Query, chosen: list[int], references: list[PosedFeatures]) -> VerifyPair:
    """Pairs of references (chosen in rising order) are verified once for all queries of a process."""

    def verify(a: int, b: int) -> pycolmap.TwoViewGeometry:
        if b == len(chosen):
            return verify_pair(references[a], query.posed, query.matcher, query.match_keypoints)
        return query.reference.pair(
            (chosen[a], chosen[b]),
            lambda: verify_pair(references[a], references[b], query.matcher, query.match_keypoints),
        )

    return verify
