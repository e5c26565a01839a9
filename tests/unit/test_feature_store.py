"""The feature store: what went in comes out, half a file never counts."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from georef.errors import StageError
from georef.store.feature_store import FeatureStore
from georef.types.features import Features

NAMES = ("keypoints_px", "scores", "scales_px", "descriptors", "colors_rgb")


def _features(count: int, seed: int = 0, dtype: type = np.float16) -> Features:
    rng = np.random.default_rng(seed)
    return Features(
        image_size=(4000, 3000),
        keypoints_px=rng.uniform(0, 3000, (count, 2)).astype(np.float32),
        scores=np.sort(rng.random(count).astype(np.float32))[::-1],
        scales_px=rng.random(count).astype(np.float32),
        descriptors=(rng.random((count, 128)) * 255).astype(dtype),
        colors_rgb=rng.integers(0, 256, (count, 3), np.uint8),
    )


@pytest.fixture
def source(tmp_path: Path) -> Path:
    path = tmp_path / "image.jpg"
    path.write_bytes(b"pixels")
    return path


@pytest.fixture
def store(tmp_path: Path) -> FeatureStore:
    return FeatureStore(tmp_path / "features", extractor_version="sift-1")


@pytest.mark.parametrize("dtype", [np.float16, np.uint8, np.float32])
@pytest.mark.parametrize("count", [0, 1, 500])
def test_what_went_in_comes_out(store: FeatureStore, source: Path, count: int, dtype: type) -> None:
    features = _features(count, dtype=dtype)
    store.write("a", features, source)
    found = store.read("a")
    assert found.image_size == (4000, 3000)
    for name in NAMES:
        np.testing.assert_array_equal(getattr(found, name), getattr(features, name))
        assert getattr(found, name).dtype == getattr(features, name).dtype


@pytest.mark.parametrize("limit", [0, 1, 20, 500, 9999])
def test_the_head_is_read_alone(store: FeatureStore, source: Path, limit: int) -> None:
    features = _features(500)
    store.write("a", features, source)
    found = store.read("a", max_keypoints=limit)
    for name in NAMES:
        np.testing.assert_array_equal(getattr(found, name), getattr(features.head(limit), name))


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
