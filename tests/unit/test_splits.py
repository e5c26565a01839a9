"""Splits of surveyed points into control and check points."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest

from georef.evaluation.splits import spread_splits

_POINTS = np.random.default_rng(3).uniform(0, 100, (11, 2))


def _radius(split: tuple[int, ...]) -> float:
    distance = np.linalg.norm(_POINTS[:, None] - _POINTS[list(split)], axis=2)
    return float(distance.min(axis=1).max())


def test_splits_are_different_and_each_point_serves_about_equally_often() -> None:
    splits = spread_splits(_POINTS, 5, 20)
    assert len(set(splits)) == 20
    assert all(len(set(split)) == 5 for split in splits)
    used = np.bincount(np.ravel(splits), minlength=11)
    assert used.min() >= 4
    assert used.max() <= 15


def test_splits_are_spread_better_than_most() -> None:
    quarter = np.quantile([_radius(split) for split in combinations(range(11), 5)], 0.26)
    assert max(_radius(split) for split in spread_splits(_POINTS, 5, 20)) <= quarter


def test_the_same_points_give_the_same_splits() -> None:
    assert spread_splits(_POINTS, 4, 10) == spread_splits(_POINTS.copy(), 4, 10)


def test_of_many_points_some_subsets_are_drawn() -> None:
    many = np.random.default_rng(4).uniform(0, 100, (60, 2))
    splits = spread_splits(many, 10, 20)
    assert len(set(splits)) == 20
    assert splits == spread_splits(many, 10, 20)


def test_few_points_give_all_there_are_and_none_is_refused() -> None:
    assert sorted(spread_splits(_POINTS[:3], 1, 20)) == [(0,), (1,), (2,)]
    for control in (0, 3):
        with pytest.raises(ValueError, match=f"cannot take {control} of 3"):
            spread_splits(_POINTS[:3], control, 1)
