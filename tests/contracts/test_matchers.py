"""What every matcher of the table must keep, whatever it computes."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pytest

from georef.errors import WeightsError
from georef.features.base import Matcher
from georef.features.registry import MATCHERS, load_component
from georef.types.features import Features, Matches


@lru_cache
def _load(name: str) -> Matcher:
    return load_component(MATCHERS, name)


@pytest.fixture(params=MATCHERS.names())
def matcher(request: pytest.FixtureRequest) -> Matcher:
    try:
        return _load(request.param)
    except WeightsError as error:
        pytest.skip(f"weights of {request.param} are not in the cache: {str(error).splitlines()[0]}")


def _random_features(count: int, seed: int = 0) -> Features:
    rng = np.random.default_rng(seed)
    descriptors = rng.normal(size=(count, 128))
    descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
    return Features(
        image_size=(640, 480),
        keypoints_px=rng.uniform((2, 2), (638, 478), (count, 2)).astype(np.float32),
        scores=np.sort(rng.random(count).astype(np.float32))[::-1].copy(),
        scales_px=np.ones(count, np.float32),
        descriptors=descriptors.astype(np.float16),
        colors_rgb=np.zeros((count, 3), np.uint8),
    )


def _assert_valid(matches: Matches, count_a: int, count_b: int) -> None:
    assert matches.indices.shape == (len(matches), 2)
    assert matches.indices.dtype == np.int32
    assert matches.scores.shape == (len(matches),)
    assert matches.scores.dtype == np.float32
    assert ((matches.scores >= 0) & (matches.scores <= 1)).all()
    for column, count in zip(matches.indices.T, (count_a, count_b), strict=True):
        assert ((column >= 0) & (column < count)).all()
        assert len(np.unique(column)) == len(column)


@pytest.mark.parametrize(("count_a", "count_b"), [(0, 0), (0, 5), (5, 0)])
def test_nothing_matches_nothing(matcher: Matcher, count_a: int, count_b: int) -> None:
    matches = matcher.match(_random_features(count_a), _random_features(count_b))
    _assert_valid(matches, count_a, count_b)
    assert len(matches) == 0


@pytest.mark.parametrize(("count_a", "count_b"), [(1, 1), (1, 30), (30, 1), (2, 2)])
def test_few_keypoints(matcher: Matcher, count_a: int, count_b: int) -> None:
    matches = matcher.match(_random_features(count_a), _random_features(count_b, seed=1))
    _assert_valid(matches, count_a, count_b)


def test_one_keypoint_matches_itself(matcher: Matcher) -> None:
    one = _random_features(1)
    assert matcher.match(one, one).indices.tolist() == [[0, 0]]


def test_identical_features_match_to_themselves(matcher: Matcher) -> None:
    features = _random_features(300)
    matches = matcher.match(features, features)
    _assert_valid(matches, 300, 300)
    assert len(matches) >= 285
    np.testing.assert_array_equal(matches.indices[:, 0], matches.indices[:, 1])


def test_a_shuffled_copy_is_matched_back(matcher: Matcher) -> None:
    features = _random_features(200)
    order = np.random.default_rng(1).permutation(200)
    matches = matcher.match(features, features.take(order))
    assert len(matches) >= 190
    np.testing.assert_array_equal(order[matches.indices[:, 1]], matches.indices[:, 0])


def test_each_index_at_most_once(matcher: Matcher) -> None:
    features = _random_features(120)
    doubled = features.take(np.repeat(np.arange(60), 2))
    _assert_valid(matcher.match(features, doubled), 120, 120)
    _assert_valid(matcher.match(doubled, features), 120, 120)


def test_twice_the_same(matcher: Matcher) -> None:
    a, b = _random_features(150), _random_features(170)
    first, second = matcher.match(a, b), matcher.match(a, b)
    np.testing.assert_array_equal(first.indices, second.indices)
    np.testing.assert_array_equal(first.scores, second.scores)


def test_the_version_says_what_decides_the_result(matcher: Matcher) -> None:
    assert matcher.version() == matcher.version()
    assert matcher.version().startswith(matcher.name)
