"""Splits of surveyed points into control and check points, chosen by where the points lie and never by results."""

from __future__ import annotations

from itertools import combinations
from math import comb

import numpy as np

from georef.geometry.rigid import Array

Split = tuple[int, ...]
_ENUMERATED = 20_000  # subsets; of more, so many are drawn
_BEST_SHARE = 0.25


def spread_splits(positions: Array, control: int, count: int) -> list[Split]:
    """`count` different choices of `control` of N points (N, k) as control, fewer where there are not so many.

    A choice is well spread where no point is far from its nearest control point (covering radius). Of the quarter that
    is spread best, those are taken in turn whose points have served least as control, so that each point serves and is
    checked about equally often. The same points give the same splits. Raises ValueError unless 0 < control < N.
    """
    total = len(positions)
    if not 0 < control < total:
        raise ValueError(f"cannot take {control} of {total} points as control and check the others")
    subsets = _subsets(total, control)
    distance = np.linalg.norm(positions[:, None] - positions[None], axis=2)
    radius = distance[:, subsets].min(axis=2).max(axis=0)
    best = np.argsort(radius, kind="stable")[: max(count, int(np.ceil(_BEST_SHARE * len(subsets))))]
    members = np.zeros((len(best), total), np.int64)
    members[np.arange(len(best))[:, None], subsets[best]] = 1
    used, free = np.zeros(total, np.int64), np.ones(len(best), bool)
    chosen: list[Split] = []
    for _ in range(min(count, len(best))):
        load = np.where(free, np.square(used + members).sum(axis=1), np.iinfo(np.int64).max)
        taken = int(np.argmin(load))  # the first of equal ones, which is spread best
        free[taken] = False
        used += members[taken]
        chosen.append(tuple(int(i) for i in subsets[best[taken]]))
    return chosen


def _subsets(total: int, size: int) -> np.ndarray:
    """All subsets (K, size) of a size, or many of them drawn at random with a fixed seed."""
    if comb(total, size) <= _ENUMERATED:
        return np.array(list(combinations(range(total), size)), dtype=np.int64)
    rng = np.random.default_rng(0)
    drawn = {tuple(sorted(rng.choice(total, size, replace=False).tolist())) for _ in range(_ENUMERATED)}
    return np.array(sorted(drawn), dtype=np.int64)
