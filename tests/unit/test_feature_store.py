"""The feature store: what went in comes out, half a file never counts."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from georef.errors import StageError
from georef.store.feature_store import FeatureStore
from georef.types.features import Features

NAMES = ("keypoints_px", "scores", "scales_px", "descriptors", "colors_rgb")


def _features(count: int, seed: int = 0, dtype: type = np.uint8, size: int = 128) -> Features:
    """Features whose scores float16 can hold: with uint8 descriptors, what comes back is exact in either encoding."""
    rng = np.random.default_rng(seed)
    return Features(
        image_size=(4000, 3000),
        keypoints_px=rng.uniform(0, 3000, (count, 2)).astype(np.float32),
        scores=np.sort(rng.random(count).astype(np.float16).astype(np.float32))[::-1],
        scales_px=rng.random(count).astype(np.float32),
        descriptors=_descriptors(rng, count, dtype, size),
        colors_rgb=rng.integers(0, 256, (count, 3), np.uint8),
    )


def _descriptors(rng: np.random.Generator, count: int, dtype: type, size: int) -> np.ndarray:
    if dtype is np.uint8:
        return rng.integers(0, 256, (count, size), np.uint8)
    rows = rng.standard_normal((count, size))
    return (rows / np.linalg.norm(rows, axis=1, keepdims=True)).astype(dtype)


@pytest.fixture
def source(tmp_path: Path) -> Path:
    path = tmp_path / "image.jpg"
    path.write_bytes(b"pixels")
    return path


@pytest.fixture
def store(tmp_path: Path) -> FeatureStore:
    return FeatureStore(tmp_path / "features", extractor_version="sift-1")


@pytest.fixture
def exact(tmp_path: Path) -> FeatureStore:
    return FeatureStore(tmp_path / "features", extractor_version="sift-1", quantize=False)


@pytest.mark.parametrize("dtype", [np.float16, np.uint8, np.float32])
@pytest.mark.parametrize("count", [0, 1, 500])
def test_what_went_in_comes_out(exact: FeatureStore, source: Path, count: int, dtype: type) -> None:
    features = _features(count, dtype=dtype)
    exact.write("a", features, source)
    _assert_same(exact.read("a"), features)


def _assert_same(found: Features, features: Features, names: tuple[str, ...] = NAMES) -> None:
    assert found.image_size == features.image_size
    for name in names:
        np.testing.assert_array_equal(getattr(found, name), getattr(features, name))
        assert getattr(found, name).dtype == getattr(features, name).dtype


@pytest.mark.parametrize("size", [64, 100, 128, 256])
@pytest.mark.parametrize("dtype", [np.float16, np.float32])
@pytest.mark.parametrize("count", [0, 1, 1500])
def test_quantized_descriptors_keep_direction_and_length(
    store: FeatureStore, source: Path, count: int, dtype: type, size: int
) -> None:
    features = _features(count, dtype=dtype, size=size)
    store.write("a", features, source)
    found = store.read("a")
    _assert_same(found, features, ("keypoints_px", "scores", "scales_px", "colors_rgb"))
    assert found.descriptors.dtype == features.descriptors.dtype
    given, kept = features.descriptors.astype(np.float64), found.descriptors.astype(np.float64)
    lengths = np.linalg.norm(given, axis=1), np.linalg.norm(kept, axis=1)
    error = 1 - (given * kept).sum(axis=1) / lengths[0] / lengths[1]
    np.testing.assert_allclose(lengths[1], lengths[0], rtol=5e-4 if dtype is np.float16 else 1e-6)
    assert error.max(initial=0) < 8e-4
    if count > 1:
        assert 5e-5 < error.mean() < 2e-4  # 7 bits: better would not be quantized


def test_codes_use_the_whole_range(store: FeatureStore, source: Path) -> None:
    rows = np.zeros((4, 128), np.float32)
    rows[0, 5] = 1  # a unit vector
    rows[1] = np.linspace(-63, 63, 128).round()  # values that are codes
    rows[2] = -rows[1] * 1e-20
    features = replace(_features(4), descriptors=rows)  # the last row stays zero
    store.write("a", features, source)
    np.testing.assert_allclose(store.read("a").descriptors, rows, rtol=1e-6, atol=0)


def test_1024_aliked_features_fit_into_135_kb(store: FeatureStore, source: Path, tmp_path: Path) -> None:
    levels = np.array([1.0, 1.5, 2.0, 3.0], np.float32)
    features = replace(_features(1024, dtype=np.float16), scales_px=levels[np.arange(1024) % 4])
    store.write("a", features, source)
    (path,) = (tmp_path / "features").iterdir()
    assert 128 * 1024 < path.stat().st_size <= 135_000
    np.testing.assert_array_equal(store.read("a").scales_px, features.scales_px)


@pytest.mark.parametrize("count", [1, 300])
def test_scores_beyond_float16_stay_exact(store: FeatureStore, source: Path, count: int) -> None:
    features = replace(_features(count), scores=np.linspace(1e6, 1e-3, count).astype(np.float32))
    store.write("a", features, source)
    _assert_same(store.read("a"), features)


@pytest.mark.parametrize("count", [0, 1, 500])
def test_orientations_are_kept_where_there_are_any(
    store: FeatureStore, exact: FeatureStore, source: Path, count: int
) -> None:
    features = _features(count)
    turns = np.random.default_rng(1).uniform(-np.pi, np.pi, count).astype(np.float32)
    for kept in (store, exact):
        kept.write("a", replace(features, orientations_rad=turns), source)
        found = kept.read("a").orientations_rad
        assert found is not None
        assert found.dtype == np.float32
        np.testing.assert_array_equal(found, turns)
        np.testing.assert_array_equal(kept.read("a", 20).orientations_rad, turns[:20])
        kept.write("a", features, source)
        assert kept.read("a").orientations_rad is None


@pytest.mark.parametrize("different", [1, 2, 256, 257])
def test_scales_are_exact(store: FeatureStore, source: Path, different: int) -> None:
    scales = (np.arange(500) % different + 0.1).astype(np.float32)
    features = replace(_features(500), scales_px=scales)
    store.write("a", features, source)
    _assert_same(store.read("a"), features)
    _assert_same(store.read("a", 7), features.head(7))


def test_the_other_encoding_counts_as_missing(store: FeatureStore, exact: FeatureStore, source: Path) -> None:
    store.write("a", _features(9, dtype=np.float16), source)
    assert store.has("a", source)
    assert not exact.has("a", source)
    with pytest.raises(StageError, match="stored as '7 bits', expected 'exact'"):
        exact.read("a")
    exact.write("a", _features(9, dtype=np.float16), source)
    assert exact.has("a", source)
    assert not store.has("a", source)


def test_without_a_version_both_encodings_are_read(exact: FeatureStore, source: Path, tmp_path: Path) -> None:
    features = _features(9, dtype=np.float16)
    exact.write("a", features, source)
    _assert_same(FeatureStore(tmp_path / "features").read("a"), features)


def test_descriptors_that_are_not_finite_are_refused(store: FeatureStore, source: Path) -> None:
    features = _features(3, dtype=np.float32)
    features.descriptors[1, 1] = np.nan
    with pytest.raises(ValueError, match="not finite"):
        store.write("a", features, source)
    assert store.ids() == []


@pytest.mark.parametrize("dtype", [np.float16, np.uint8])
@pytest.mark.parametrize("limit", [0, 1, 20, 500, 9999])
def test_the_head_is_read_alone(store: FeatureStore, source: Path, limit: int, dtype: type) -> None:
    store.write("a", _features(500, dtype=dtype), source)
    _assert_same(store.read("a", max_keypoints=limit), store.read("a").head(limit))


def test_any_id_is_a_file_in_the_folder(store: FeatureStore, source: Path, tmp_path: Path) -> None:
    ids = ["a/b.jpg", "a%2Fb.jpg", "..", "../up", "straße 7?.png", ".hidden", "C:\\x", "con*"]
    for seed, image_id in enumerate(ids):
        store.write(image_id, _features(5, seed), source)
    assert store.ids() == sorted(ids)
    for seed, image_id in enumerate(ids):
        np.testing.assert_array_equal(store.read(image_id).scores, _features(5, seed).scores)
    assert all(path.parent == tmp_path / "features" for path in tmp_path.rglob("*.safetensors"))


@pytest.mark.parametrize("image_id", ["", "x" * 300])
def test_ids_that_cannot_be_file_names_are_refused(store: FeatureStore, source: Path, image_id: str) -> None:
    with pytest.raises(StageError, match="shorter id"):
        store.write(image_id, _features(1), source)


def test_a_changed_source_counts_as_missing(store: FeatureStore, source: Path) -> None:
    assert not store.has("a", source)
    store.write("a", _features(3), source)
    assert store.has("a", source)
    os.utime(source, ns=(0, 12345))
    assert not store.has("a", source)
    assert store.has("a")
    source.unlink()
    assert not store.has("a", source)


def test_another_extractor_version_counts_as_missing(store: FeatureStore, source: Path, tmp_path: Path) -> None:
    store.write("a", _features(3), source)
    newer = FeatureStore(tmp_path / "features", extractor_version="sift-2")
    assert not newer.has("a", source)
    with pytest.raises(StageError, match="'sift-1', expected 'sift-2'"):
        newer.read("a")
    assert FeatureStore(tmp_path / "features").has("a", source)


@pytest.mark.parametrize("part", [0.0, 0.001, 0.5, 0.999])
def test_a_damaged_file_counts_as_missing(store: FeatureStore, source: Path, tmp_path: Path, part: float) -> None:
    store.write("a", _features(300), source)
    (path,) = (tmp_path / "features").iterdir()
    content = path.read_bytes()
    path.write_bytes(content[: int(part * len(content))])
    assert not store.has("a", source)
    with pytest.raises(StageError, match="Run the extraction again"):
        store.read("a")
    store.write("a", _features(300), source)
    assert store.has("a", source)


def test_missing_features_say_what_to_do(store: FeatureStore) -> None:
    with pytest.raises(StageError, match="Run the extraction again"):
        store.read("a")
    assert store.ids() == []


def test_readers_see_whole_files_while_others_write(store: FeatureStore, source: Path, tmp_path: Path) -> None:
    versions = [_features(200 + seed, seed) for seed in range(4)]
    store.write("a", versions[0], source)

    def check() -> bool:
        found = store.read("a")
        return any(np.array_equal(found.descriptors, version.descriptors) for version in versions)

    with ThreadPoolExecutor(4) as pool:
        writes = [pool.submit(store.write, "a", versions[i % 4], source) for i in range(60)]
        checks = [pool.submit(check) for _ in range(60)]
        assert all(future.result() for future in checks)
        assert all(future.exception() is None for future in writes)
    assert [path.suffix for path in (tmp_path / "features").iterdir()] == [".safetensors"]
