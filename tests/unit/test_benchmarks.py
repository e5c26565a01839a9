"""The benchmarks at toy size: they run, and what they compare answers the same question."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from georef.benchmarks import features, vectors
from georef.benchmarks.city import City
from georef.benchmarks.measure import Cost, Waiting, measured, table
from georef.cli import app
from georef.terminal import exit_code


def _here(work, *arguments) -> Cost:
    """As `measured`, in this process."""
    return Cost(work(*arguments), 1.0, 1.0, 1.0)


def test_a_city_is_the_same_each_time_and_has_structure() -> None:
    city = City(12_000, 64)
    chunks = list(city.chunks())
    assert [len(chunk) for chunk in chunks] == [10_000, 2_000]
    again = list(City(12_000, 64).chunks())
    np.testing.assert_array_equal(chunks[1].descriptors, again[1].descriptors)
    descriptors = np.concatenate([chunk.descriptors for chunk in chunks])
    places = np.concatenate([chunk.places for chunk in chunks])
    np.testing.assert_allclose(np.linalg.norm(descriptors, axis=1), 1, rtol=1e-5)
    queries = city.queries(50)
    best = places[np.argmax(queries.descriptors @ descriptors.T, axis=1)]
    assert 0.5 < (best == queries.places).mean() <= 1
    assert (best == np.random.default_rng(0).permutation(queries.places)).mean() < 0.2


def test_streets_are_100_m_apart() -> None:
    (images,) = City(10_000, 8).chunks()
    across = np.minimum(*(np.abs((images.positions[:, axis] + 50) % 100 - 50) for axis in (0, 1)))
    assert np.quantile(across, 0.99) < 4
    assert images.positions[:, :2].max() > 290


def test_the_vector_benchmark(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(vectors, "measured", _here)
    result = vectors.run(3000, 16, 8, tmp_path)
    assert json.loads(json.dumps(result)) == result
    assert [search["images_median"] for search in result["searches"]] == [50, 1000, 3000, 3000, 3000]
    assert [search["index"]["recall"] for search in result["searches"]] == [1.0] * 5
    assert result["disk_mb"]["numpy"] > 3000 * 16 * 4 / 1e6
    assert result["disk_mb"]["index as written"] > 3000 * 16 * 4 / 1e6
    assert sum("box of about 1,000" in line for line in vectors.describe(result)) == 2


@pytest.mark.parametrize("name", features.WAYS)
def test_each_way_of_the_feature_benchmark_keeps_the_features(name: str, tmp_path: Path) -> None:
    given, way = features.synthetic_features(40, 3), features.WAYS[name]
    way.write(tmp_path, 7, given)
    for count in (None, 5):
        found = way.read(tmp_path, 7, count)
        np.testing.assert_array_equal(found.keypoints_px, given.keypoints_px[:count])
        np.testing.assert_allclose(found.descriptors, given.descriptors[:count].astype(np.float32), atol=6e-3)


def test_the_feature_benchmark_by_its_verb(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(features, "measured", _here)
    arguments = ["benchmark", "features", "--images", "3", "--keypoints", "64"]
    code = exit_code(app, [*arguments, "--scratch", str(tmp_path / "s"), "-o", str(tmp_path / "out.json")])
    assert code == 0
    assert "georef, 7 bits" in capsys.readouterr().out
    ways = json.loads((tmp_path / "out.json").read_text())["ways"]
    assert 1.5 < ways["georef, exact"]["disk_mb"] / ways["georef, 7 bits"]["disk_mb"] < 2.5
    assert list((tmp_path / "s").iterdir()) == []


def test_nothing_to_measure_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert exit_code(app, ["benchmark", "vectors", "--rows", "0"]) == 2
    assert "rows" in capsys.readouterr().err


def test_a_cost_is_that_of_its_own_process() -> None:
    small, large = measured(_allocate, 1), measured(_allocate, 300)
    assert large.result == 300
    assert 290 < large.peak_mb - small.peak_mb < 350


def _allocate(mb: int) -> int:
    return len(np.ones(mb * 10**6, np.uint8)) // 10**6


def test_waiting_counts_what_the_source_takes() -> None:
    waiting = Waiting(_slowly())
    assert list(waiting) == [0, 1, 2]
    assert 0.06 <= waiting.wall_s < 2


def _slowly():
    import time

    for number in range(3):
        time.sleep(0.02)
        yield number


def test_a_table_is_aligned() -> None:
    assert table(("what", "n"), [("a", "1"), ("bcdef", "1,000")]) == [
        "what       n",
        "-----  -----",
        "a          1",
        "bcdef  1,000",
    ]
