"""VLAD learned from the reference: its parts against plain formulas, its state on disk, and that it finds places."""

from __future__ import annotations

import tracemalloc
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from safetensors.numpy import load_file, save_file

from georef.errors import StageError
from georef.features.globals import vlad as module
from georef.features.globals.kmeans import assign, kmeans
from georef.features.globals.sampling import Reservoir
from georef.features.globals.state import LearnedState
from georef.features.globals.vlad import Vlad
from georef.features.globals.whitening import learn_whitening
from georef.types.features import Features


def features_of(descriptors: NDArray) -> Features:
    count = len(descriptors)
    return Features(
        (640, 480),
        np.zeros((count, 2), np.float32),
        np.linspace(1, 0.1, count, dtype=np.float32),
        np.ones(count, np.float32),
        descriptors,
        np.zeros((count, 3), np.uint8),
    )


def street_of_places(places: int, views: int, seed: int = 0, seen: int = 80) -> list[list[Features]]:
    """Views of places: each sees most of its place's things, some of all places', some of nobody's."""
    random = np.random.default_rng(seed)
    things = random.normal(size=(places, 120, 32))
    common = random.normal(size=(40, 32))

    def view(place: int) -> Features:
        own = things[place][random.permutation(120)[:seen]]
        rows = np.concatenate([own, common[random.permutation(40)[:30]], random.normal(size=(40, 32))])
        return features_of((rows + 0.3 * random.normal(size=rows.shape)).astype(np.float16))

    return [[view(place) for _ in range(views)] for place in range(places)]


def learned(samples: list[Features], **options: int) -> Vlad:
    made = Vlad(**options)  # type: ignore[arg-type]
    return made.with_state(made.learn(samples))


@pytest.mark.parametrize("places", [10, 60])
def test_the_view_of_the_same_place_is_nearest(places: int) -> None:
    """Few references (rank below size) and more: the first neighbour is right, and chance is not."""
    views = street_of_places(places, 3)
    descriptor = learned([v for place in views for v in place[:2]], centres=16, size=64)
    reference = np.array([descriptor.describe(None, v) for place in views for v in place[:2]])
    queries = np.array([descriptor.describe(None, place[2]) for place in views])
    best = (queries @ reference.T).argmax(1) // 2
    assert (best == np.arange(places)).mean() >= 0.9
    wrong = np.roll(queries, 1, axis=0)
    assert ((wrong @ reference.T).argmax(1) // 2 == np.arange(places)).mean() < 0.2


def test_the_row_before_whitening_is_the_formula() -> None:
    random = np.random.default_rng(1)
    made, centres = Vlad(centres=3), random.normal(size=(3, 5)).astype(np.float32)
    rows = random.normal(size=(12, 5))
    rows /= np.linalg.norm(rows, axis=1, keepdims=True)
    expected = np.zeros((3, 5))
    for row in rows:
        k = np.argmin(np.linalg.norm(row - centres, axis=1))
        expected[k] += row - centres[k]
    expected = np.sign(expected) * np.sqrt(np.abs(expected))
    lengths = np.linalg.norm(expected, axis=1, keepdims=True)
    expected = np.divide(expected, lengths, out=np.zeros_like(expected), where=lengths > 0).ravel()
    expected /= np.linalg.norm(expected)
    np.testing.assert_allclose(made._vlad(features_of(rows.astype(np.float32)), centres), expected, atol=1e-5)


def test_scale_of_descriptors_does_not_matter() -> None:
    views = [v for place in street_of_places(8, 2) for v in place]
    descriptor = learned(views, centres=8, size=16)
    twice = features_of(views[0].descriptors * np.float16(2))
    np.testing.assert_allclose(descriptor.describe(None, views[0]), descriptor.describe(None, twice), atol=1e-5)


def test_an_image_without_features_has_a_row() -> None:
    views = [v for place in street_of_places(6, 2) for v in place]
    row = learned(views, centres=8, size=16).describe(None, features_of(np.zeros((0, 32), np.float16)))
    assert np.linalg.norm(row) == pytest.approx(1, abs=1e-5)


def test_the_state_survives_the_disk_and_stands_in_the_version(tmp_path: Path) -> None:
    views = [v for place in street_of_places(6, 2) for v in place]
    made = Vlad(centres=8, size=16)
    state = made.learn(views)
    state.save(tmp_path / "deep" / "vlad.safetensors")
    again = LearnedState.load(tmp_path / "deep" / "vlad.safetensors")
    assert again.sha256 == state.sha256
    first, second = made.with_state(state), made.with_state(again)
    np.testing.assert_array_equal(first.describe(None, views[3]), second.describe(None, views[3]))
    assert first.version() == second.version()
    assert state.sha256[:12] in first.version()
    assert made.learn(views[:-1]).sha256 != state.sha256
    assert list((tmp_path / "deep").iterdir()) == [tmp_path / "deep" / "vlad.safetensors"]


def test_learning_twice_gives_the_same() -> None:
    views = [v for place in street_of_places(6, 2) for v in place]
    assert Vlad(centres=8, size=16).learn(views).sha256 == Vlad(centres=8, size=16).learn(views).sha256


def test_states_that_cannot_be_used_are_refused(tmp_path: Path) -> None:
    views = [v for place in street_of_places(6, 2) for v in place]
    path = tmp_path / "vlad.safetensors"
    state = Vlad(centres=8, size=16).learn(views)
    with pytest.raises(StageError, match="expected 'vlad-1 size=16 centres=4"):
        Vlad(centres=4, size=16).with_state(state)
    with pytest.raises(StageError, match="no learned state"):
        LearnedState.load(path)
    state.save(path)
    save_file(load_file(path) | {"mean": np.zeros(256, np.float32)}, path, metadata={"format": "other"})
    with pytest.raises(StageError, match="another format"):
        LearnedState.load(path)
    path.write_bytes(b"cut off")
    with pytest.raises(StageError, match="damaged"):
        LearnedState.load(path)


def test_an_altered_state_does_not_have_its_hash(tmp_path: Path) -> None:
    path = tmp_path / "vlad.safetensors"
    LearnedState("a", {"x": np.zeros(3, np.float32)}).save(path)
    content = bytearray(path.read_bytes())
    content[-1] ^= 1
    path.write_bytes(content)
    with pytest.raises(StageError, match="hash"):
        LearnedState.load(path)


def test_what_cannot_be_learned_from_is_refused() -> None:
    views = [v for place in street_of_places(6, 2) for v in place]
    with pytest.raises(ValueError, match="twice"):
        Vlad().learn(iter(views))
    with pytest.raises(StageError, match="150 local descriptors cannot teach 200 centres"):
        Vlad(centres=200).learn(views[:1])
    with pytest.raises(StageError, match="at least two different rows"):
        Vlad(centres=8).learn(views[:1])
    with pytest.raises(StageError, match="learned nothing yet"):
        Vlad().describe(None, views[0])
    with pytest.raises(StageError, match="64 components, those of the reference had 32"):
        learned(views, centres=8, size=16).describe(None, features_of(np.ones((5, 64), np.float32)))


def test_memory_of_learning_does_not_grow_with_the_map(monkeypatch: pytest.MonkeyPatch) -> None:
    """Five times the images, the same peak: both samples are full in either case."""
    monkeypatch.setattr(module, "_SAMPLED_DESCRIPTORS", 2000)
    monkeypatch.setattr(module, "_SAMPLED_ROWS", 50)

    class Stream:
        def __init__(self, count: int) -> None:
            self.count = count

        def __iter__(self) -> Iterator[Features]:
            for index in range(self.count):
                random = np.random.default_rng(index)
                yield features_of(random.normal(size=(100, 32)).astype(np.float32))

    def peak(count: int) -> int:
        tracemalloc.start()
        Vlad(centres=8, size=16).learn(Stream(count))
        value = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return value

    peak(60)
    assert peak(300) < 1.1 * peak(60)


def test_a_reservoir_keeps_each_row_with_the_same_chance() -> None:
    kept = np.zeros(40)
    for seed in range(400):
        reservoir = Reservoir(10, seed)
        for start in range(0, 40, 8):
            reservoir.add(np.arange(start, start + 8, dtype=np.float32)[:, None])
        assert len(reservoir.rows) == len(np.unique(reservoir.rows)) == 10
        kept[reservoir.rows[:, 0].astype(int)] += 1
    assert np.abs(kept - 100).max() < 4.5 * np.sqrt(400 * 0.25 * 0.75)
    assert Reservoir(10, 0).rows.shape == (0, 0)


def test_kmeans_finds_separate_clouds() -> None:
    random = np.random.default_rng(2)
    middles = 10 * random.normal(size=(6, 4))
    rows = (middles[random.integers(6, size=3000)] + 0.1 * random.normal(size=(3000, 4))).astype(np.float32)
    centres = kmeans(rows, 6, seed=1)
    nearest, _ = assign(centres, middles.astype(np.float32))
    assert sorted(nearest) == list(range(6))
    np.testing.assert_allclose(centres, middles[nearest], atol=0.05)


def test_kmeans_with_fewer_different_rows_than_centres() -> None:
    rows = np.repeat(np.eye(3, dtype=np.float32), 5, axis=0)
    assert np.isfinite(kmeans(rows, 5)).all()
    with pytest.raises(ValueError, match="at least as many"):
        kmeans(rows[:4], 5)


def test_whitening_of_many_rows_makes_the_components_alike() -> None:
    random = np.random.default_rng(3)
    rows = (random.normal(size=(20_000, 12)) @ np.diag(np.geomspace(1, 30, 12)) + 5).astype(np.float32)
    whitening = learn_whitening(rows, 6)
    out = (rows - whitening.mean) @ whitening.axes.T
    np.testing.assert_allclose(np.cov(out.T), np.eye(6), atol=0.02)
    np.testing.assert_allclose(np.linalg.norm(whitening.apply(rows[:9]), axis=1), 1, atol=1e-5)


def test_whitening_of_few_rows_is_a_rotation_that_loses_nothing() -> None:
    """n = k + 1 rows: their cosines about the mean stay, with a query's to them but for the query's own length."""
    random = np.random.default_rng(4)
    rows, query = random.normal(size=(5, 40)).astype(np.float32), random.normal(size=(1, 40)).astype(np.float32)
    whitening = learn_whitening(rows, 16)
    assert whitening.axes.shape == (4, 40)
    found = whitening.apply(rows) @ whitening.apply(np.concatenate([rows, query])).T
    centred = rows - rows.mean(0)
    unit = centred / np.linalg.norm(centred, axis=1, keepdims=True)
    np.testing.assert_allclose(found[:, :5], unit @ unit.T, atol=0.35)
    order = np.argsort(unit @ (query - rows.mean(0))[0])
    assert (np.argsort(found[:, 5]) == order).mean() >= 0.6
    assert (whitening.apply(query)[:, 4:] == 0).all()
