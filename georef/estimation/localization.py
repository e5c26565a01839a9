"""Localization of one image against the reference: `Localized | Rejected(reason)`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from numpy.typing import NDArray

from georef.config import CandidatesConfig, LocalizeConfig
from georef.estimation.candidates import Box, Whereabouts
from georef.estimation.from_tracks import from_tracks
from georef.estimation.pose_from_map import from_global_model, from_local_model
from georef.estimation.prior_check import against_prior
from georef.estimation.query import Query
from georef.estimation.query_centred import query_centred
from georef.estimation.reference_map import ReferenceMap
from georef.estimation.search import FindSimilar, Search
from georef.features.base import Matcher
from georef.types.campaign import Image
from georef.types.features import Features
from georef.types.results import Outcome, Rejected, RejectReason

METHODS: dict[str, Callable[[Query, NDArray], Outcome]] = {  # of references, the most promising first
    "query-centred": query_centred,
    "tracks": from_tracks,
    "published": from_local_model,
    "global-model": from_global_model,
}


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
    where = Whereabouts(image.gnss, image.near, image.heading_rad)
    search = Search(reference, features, where, candidates, find_similar)
    query = Query(image, features, reference, matcher, config, match_keypoints, search)
    box = search.box()
    outcome = _localize_in(query, box)
    if isinstance(outcome, Rejected) and candidates.fallback and not box.whole_reference:
        query.notes.append(
            f"inside the search box: {outcome.reason.value} ({outcome.detail}); tried the whole reference"
        )
        outcome = _localize_in(query, search.everywhere())
    judged = against_prior(outcome, image, config)
    return replace(judged, notes=tuple(query.notes), cpu_s=dict(query.cpu_s), candidates=query.tried)


def _localize_in(query: Query, box: Box) -> Outcome:
    if box.note:
        query.notes.append(box.note)
    with query.timed("candidates"):
        ranked, note = query.search.ranked(box)
    if note:
        query.notes.append(note)
    if len(ranked) < 2:
        return Rejected(query.image.image_id, RejectReason.NO_CANDIDATES, f"{len(ranked)} reference images")
    query.tried = tuple(query.reference.images[int(i)].image_id for i in ranked[: query.search.config.count])
    return METHODS[query.config.method](query, ranked)
