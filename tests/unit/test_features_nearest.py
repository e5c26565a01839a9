"""Similarity and mutual nearest neighbours against the plain definition."""

from __future__ import annotations

import numpy as np
import pytest

from georef.features.nearest import MutualNearest, similarity, unit_rows
from georef.features.sift import root_sift
from georef.types.features import Features

Pair = tuple[np.ndarray, np.ndarray]


def _features(descriptors: np.ndarray) -> Features:
    count = len(descriptors)
    flat = np.ones(count, np.float32)
    return Features((10, 10), np.zeros((count, 2), np.float32), flat, flat, descriptors, np.zeros((count, 3), np.uint8))


@pytest.fixture
def pair() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    a = rng.normal(size=(150, 32)).astype(np.float32)
    b = np.concatenate([a[:100] + 0.6 * rng.normal(size=(100, 32)), rng.normal(size=(80, 32))]).astype(np.float32)
    return unit_rows(a), unit_rows(b)


def _plain(a: np.ndarray, b: np.ndarray, ratio: float | None) -> set[tuple[int, int]]:
    distance = np.sqrt(np.maximum(2 - 2 * (a.astype(np.float64) @ b.T.astype(np.float64)), 0))
    found = set()
    for i in range(len(a)):
        j = int(distance[i].argmin())
        if distance[:, j].argmin() != i:
            continue
        rivals = np.sort(distance[i])[1], np.sort(distance[:, j])[1]
        if ratio is None or all(distance[i, j] < ratio * rival for rival in rivals):
            found.add((i, j))
    return found


@pytest.mark.parametrize("ratio", [None, 0.9, 0.7])
@pytest.mark.parametrize("chunk", [1, 7, 1000])
def test_matches_are_those_of_the_definition(pair: Pair, ratio: float | None, chunk: int) -> None:
    matches = MutualNearest(ratio=ratio, min_similarity=-1, chunk=chunk).match(_features(pair[0]), _features(pair[1]))
    assert set(map(tuple, matches.indices.tolist())) == _plain(*pair, ratio)


def test_a_floor_of_similarity(pair: Pair) -> None:
    matches = MutualNearest(ratio=None, min_similarity=0.8).match(_features(pair[0]), _features(pair[1]))
    assert 0 < len(matches) < 100
    assert (matches.scores >= 0.8).all()


@pytest.mark.parametrize("dtype", [np.float32, np.float16, np.uint8])
def test_similarity_of_stored_types(dtype: type) -> None:
    rng = np.random.default_rng(1)
    rows = np.abs(rng.normal(size=(20, 128)))
    rows /= np.linalg.norm(rows, axis=1, keepdims=True)
    stored = (rows * 512).round().clip(0, 255).astype(np.uint8) if dtype == np.uint8 else rows.astype(dtype)
    found = similarity(stored, stored[:7])
    assert found.shape == (20, 7)
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, rows @ rows[:7].T, atol=5e-3)


def test_root_sift_has_length_512() -> None:
    rows = np.random.default_rng(2).integers(0, 120, (50, 128)).astype(np.float32)
    np.testing.assert_allclose(np.linalg.norm(root_sift(rows).astype(float), axis=1), 512, rtol=0.01)
    assert (root_sift(np.zeros((1, 128), np.float32)) == 0).all()
