"""What every matcher of the table must keep, whatever it computes."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from made_weights import MADE
from synthetic import textured_image

from georef.features.base import Matcher, extract_features
from georef.features.registry import EXTRACTORS, MATCHERS, ComponentTable
from georef.types.features import Features, Matches

Component = Callable[[ComponentTable, str], Any]
Of = Callable[..., Features]


@pytest.fixture(params=MATCHERS.names())
def matcher(request: pytest.FixtureRequest, component: Component) -> Matcher:
    return component(MATCHERS, request.param)


@pytest.fixture
def features_of(matcher: Matcher, component: Component) -> Of:
    """Makes features that the matcher fits: real ones of its extractor, random ones for a matcher that fits all."""
    fitting = getattr(matcher, "extractors", None)

    def make(count: int, seed: int = 0) -> Features:
        if fitting is None:
            return _random_features(count, 128, seed)
        extractor = EXTRACTORS.resolve(fitting[0]).load()
        if getattr(extractor, "weights", None) in MADE:
            return _random_features(count, extractor.descriptor_size, seed)
        found = extract_features(component(EXTRACTORS, fitting[0]), textured_image(640, 480, seed), 640, 300)
        assert len(found) >= count
        return found.head(count)

    return make


def _random_features(count: int, size: int, seed: int) -> Features:
    rng = np.random.default_rng(seed)
    descriptors = rng.normal(size=(count, size))
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
def test_nothing_matches_nothing(matcher: Matcher, features_of: Of, count_a: int, count_b: int) -> None:
    matches = matcher.match(features_of(count_a), features_of(count_b))
    _assert_valid(matches, count_a, count_b)
    assert len(matches) == 0


@pytest.mark.parametrize(("count_a", "count_b"), [(1, 1), (1, 30), (30, 1), (2, 2)])
def test_few_keypoints(matcher: Matcher, features_of: Of, count_a: int, count_b: int) -> None:
    matches = matcher.match(features_of(count_a), features_of(count_b, seed=1))
    _assert_valid(matches, count_a, count_b)


def test_one_keypoint_matches_itself(
    matcher: Matcher, features_of: Of, with_trained_weights: Callable[[Any], None]
) -> None:
    with_trained_weights(matcher)
    one = features_of(1)
    assert matcher.match(one, one).indices.tolist() == [[0, 0]]


def test_identical_features_match_to_themselves(
    matcher: Matcher, features_of: Of, with_trained_weights: Callable[[Any], None]
) -> None:
    with_trained_weights(matcher)
    features = features_of(300)
    matches = matcher.match(features, features)
    _assert_valid(matches, 300, 300)
    assert len(matches) >= 285
    np.testing.assert_array_equal(matches.indices[:, 0], matches.indices[:, 1])


def test_a_shuffled_copy_is_matched_back(
    matcher: Matcher, features_of: Of, with_trained_weights: Callable[[Any], None]
) -> None:
    with_trained_weights(matcher)
    features = features_of(200)
    order = np.random.default_rng(1).permutation(200)
    matches = matcher.match(features, features.take(order))
    assert len(matches) >= 190
    np.testing.assert_array_equal(order[matches.indices[:, 1]], matches.indices[:, 0])


def test_each_index_at_most_once(matcher: Matcher, features_of: Of) -> None:
    features = features_of(120)
    doubled = features.take(np.repeat(np.arange(60), 2))
    _assert_valid(matcher.match(features, doubled), 120, 120)
    _assert_valid(matcher.match(doubled, features), 120, 120)


def test_twice_the_same(matcher: Matcher, features_of: Of) -> None:
    a, b = features_of(150), features_of(170)
    first, second = matcher.match(a, b), matcher.match(a, b)
    np.testing.assert_array_equal(first.indices, second.indices)
    np.testing.assert_array_equal(first.scores, second.scores)


def test_the_version_says_what_decides_the_result(matcher: Matcher) -> None:
    assert matcher.version() == matcher.version()
    assert matcher.version().startswith(matcher.name)


@pytest.mark.parametrize("quarter_turns", [1, 2, 3])
def test_features_of_a_turned_picture_match_as_they_were_found(
    matcher: Matcher, features_of: Of, quarter_turns: int
) -> None:
    """Whatever looks at places sees them in the picture as it was turned."""
    found = features_of(30)
    other = found.take(np.random.default_rng(2).permutation(30))
    expected = matcher.match(found, other)
    matches = matcher.match(found.turned_back(quarter_turns), other)
    np.testing.assert_array_equal(matches.indices, expected.indices)
    np.testing.assert_allclose(matches.scores, expected.scores, atol=2e-3)
    assert len(matches) > 0 or getattr(matcher, "weights", None) in MADE
