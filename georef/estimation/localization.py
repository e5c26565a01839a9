"""Localization of one image against the reference: `Localized | Rejected(reason)`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from numpy.typing import NDArray

from georef.config import CandidatesConfig, LocalizeConfig
from georef.estimation.candidates import Box, Whereabouts
from georef.estimation.from_tracks import from_tracks
from georef.estimation.pose_from_map import from_global_model, from_local_model
from georef.estimation.prior_check import STRONG_EVIDENCE, against_prior
from georef.estimation.query import Query
from georef.estimation.query_centred import query_centred
from georef.estimation.reference_map import ReferenceMap
from georef.estimation.search import FindSimilar, Ranking, Search
from georef.estimation.turning import Looked, TurnedPicture, has_few_votes, promising_turns
from georef.features.base import Matcher
from georef.types.campaign import Image
from georef.types.features import Features
from georef.types.results import Localized, Outcome, Rejected, RejectReason

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
    picture: TurnedPicture | None = None,
) -> Outcome:
    """The pose of one image with its covariance, or why there is none.

    References inside the position prior's box are tried first, then the whole reference. find_similar: the vector
    database, asked for this image; needed for every ranking but "votes". picture: where the image may lie on its side.
    """
    if len(features) < config.min_inliers:
        return Rejected(image.image_id, RejectReason.FEW_FEATURES, f"{len(features)} keypoints")
    where = Whereabouts(image.gnss, image.near, image.heading_rad)
    search = Search(reference, features, where, candidates, find_similar)
    query = Query(image, features, reference, matcher, config, match_keypoints, search)
    if picture is not None and picture.stated_turns:
        with query.timed("turning"):
            query = _seen_as(query, picture.look(picture.stated_turns))
    box = search.box()
    outcome = _localize_either_way(query, box, picture)
    if isinstance(outcome, Rejected) and candidates.fallback and not box.whole_reference:
        query.notes.append(
            f"inside the search box: {outcome.reason.value} ({outcome.detail}); tried the whole reference"
        )
        outcome = _localize_either_way(query, search.everywhere(), picture)
    if isinstance(outcome, Localized) and outcome.quarter_turns:
        query.notes.append(f"localized with the picture turned by {90 * outcome.quarter_turns} deg clockwise")
    judged = against_prior(outcome, image, config)
    return replace(judged, notes=tuple(query.notes), cpu_s=dict(query.cpu_s))


def _localize_either_way(query: Query, box: Box, picture: TurnedPicture | None) -> Outcome:
    """The outcome that rests on most points: of the picture as it is, or turned as votes say.

    Votes are asked where the picture has few as it is, which is known before anything is matched, or few points.
    """
    ranking = _ranked(query, box)
    if picture is None:
        return _localize_with(query, ranking)
    candidates = query.search.config
    on_its_side = has_few_votes(ranking, min(len(query.features), candidates.vote_keypoints), candidates)
    first = _localize_turned(query, box, picture) if on_its_side else None
    if first is not None and not _needs_more(first, query.config):
        return first
    as_it_is = _localize_with(query, ranking)
    if not on_its_side and _needs_more(as_it_is, query.config):
        first = _localize_turned(query, box, picture)
    return as_it_is if first is None or _points(as_it_is) >= _points(first) else first


def _localize_turned(query: Query, box: Box, picture: TurnedPicture) -> Outcome | None:
    """The best outcome of the ways up that have clearly more votes; None where there is none."""
    with query.timed("turning"):
        search, tried = query.search, query.features.quarter_turns
        turns = promising_turns(picture, query.reference, search.where, search.config, box, tried)
    best = None
    for other in turns:
        with query.timed("turning"):
            turned = _seen_as(query, picture.look(other))
        outcome = _localize_with(turned, _ranked(turned, box))
        if best is None or _points(outcome) > _points(best):
            best = outcome
        if not _needs_more(best, query.config):
            break
    return best


def _seen_as(query: Query, looked: Looked) -> Query:
    """The same image by other features of it; times and notes go on."""
    search = replace(query.search, features=looked.features, find_similar=looked.find_similar)
    return Query(
        query.image,
        looked.features,
        query.reference,
        query.matcher,
        query.config,
        query.match_keypoints,
        search,
        cpu_s=query.cpu_s,
        notes=query.notes,
    )


def _points(outcome: Outcome) -> int:
    return outcome.correspondence_count if isinstance(outcome, Localized) else 0


def _needs_more(outcome: Outcome, config: LocalizeConfig) -> bool:
    """Whether an image shares so little with the references that it may lie on its side."""
    return _points(outcome) < STRONG_EVIDENCE * config.min_inliers


def _ranked(query: Query, box: Box) -> Ranking:
    with query.timed("candidates"):
        ranking = query.search.ranked(box)
    query.notes += [note for note in (box.note, ranking.note) if note and note not in query.notes]
    return ranking


def _localize_with(query: Query, ranking: Ranking) -> Outcome:
    ranked = ranking.indices
    if len(ranked) < 2:
        return Rejected(query.image.image_id, RejectReason.NO_CANDIDATES, f"{len(ranked)} reference images")
    tried = tuple(query.reference.images[int(i)].image_id for i in ranked[: query.search.config.count])
    return replace(METHODS[query.config.method](query, ranked), candidates=tried)
