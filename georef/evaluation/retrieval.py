"""Retrieval judged by true poses: do the first candidates of a query look at what it looks at?

A reference is right for a query where their viewing frusta, at the query's true pose, have at least MIN_SHARED in
common (georef.geometry.frusta: each frustum between a tenth of its reach and the reach; the lesser of both shares).
Recall at k is the share of queries that have a right reference among their first k candidates; queries that no
reference is right for are left out, those without candidates count as missed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from georef.evaluation.statistics import Interval, wilson_interval
from georef.geometry.frusta import Frusta
from georef.geometry.rigid import Rigid3
from georef.types.campaign import Image

MIN_SHARED = 0.2
REACH_M = 30.0
RANKS = (1, 5, 10)


@dataclass(frozen=True)
class RetrievalRecall:
    """Share of queries with a right reference among the first `rank` candidates."""

    rank: int
    percent: float | None  # None without queries that have a right reference
    interval: Interval | None  # 95 %, Wilson


@dataclass(frozen=True)
class RetrievalQuality:
    recall: tuple[RetrievalRecall, ...]
    precision_percent: float | None  # mean share of right ones among the candidates of a query, at most RANKS[-1]
    judged: int  # queries that some reference is right for
    without: tuple[str, ...]  # queries that none is right for


def right_references(
    queries: Sequence[Image], truth: Mapping[str, Rigid3], references: Sequence[Image], reach_m: float = REACH_M
) -> dict[str, frozenset[str]]:
    """Ids of the references that are right for each query that has a true pose."""
    posed = [(image, image.world_from_cam) for image in references if image.world_from_cam is not None]
    frusta = Frusta.of([pose for _, pose in posed], [image.camera for image, _ in posed], reach_m)
    centres = frusta.views.centres
    out = {}
    for query in queries:
        if query.image_id not in truth:
            continue
        own = Frusta.of([truth[query.image_id]], [query.camera], reach_m)
        near = np.flatnonzero(np.linalg.norm(centres - own.views.centres[0], axis=1) <= 2.0 * reach_m)
        shared = own.shared(0, frusta, near)
        out[query.image_id] = frozenset(posed[int(i)][0].image_id for i in near[shared >= MIN_SHARED])
    return out


def retrieval_quality(candidates: Mapping[str, Sequence[str]], right: Mapping[str, frozenset[str]]) -> RetrievalQuality:
    """candidates: reference ids of each query, the most promising first; a query without an entry has none."""
    judged = [query for query, references in right.items() if references]
    hits = {query: [c in right[query] for c in candidates.get(query, ())][: RANKS[-1]] for query in judged}
    recall = []
    for rank in RANKS:
        count = sum(any(hit[:rank]) for hit in hits.values())
        percent = 100.0 * count / len(judged) if judged else None
        recall.append(RetrievalRecall(rank, percent, wilson_interval(count, len(judged))))
    shares = [float(np.mean(hit)) if hit else 0.0 for hit in hits.values()]
    precision = 100.0 * float(np.mean(shares)) if shares else None
    without = tuple(query for query, references in right.items() if not references)
    return RetrievalQuality(tuple(recall), precision, len(judged), without)
