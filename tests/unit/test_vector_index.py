"""The vector index: what is found is what a search by hand finds; writers may die, readers may read meanwhile."""

from __future__ import annotations

import math
import multiprocessing
import os
import pickle
import signal
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from georef.errors import StageError
from georef.store import vector_index
from georef.store.vector_filter import condition
from georef.store.vector_index import VectorIndex
from georef.store.vector_rows import IndexRow

SIZE = 16
SPAWN = multiprocessing.get_context("spawn")


def _rows(count: int, seed: int = 0, prefix: str = "", size: int = SIZE) -> list[IndexRow]:
    """Rows with positions in 100 x 100 m, three epochs, and every seventh without heading."""
    rng = np.random.default_rng(seed)
    descriptors = rng.standard_normal((count, size)).astype(np.float32)
    descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
    return [
        IndexRow(
            key=f"{prefix}e{i % 3}/{i:05d}.jpg",
            position_in_world=np.array([*rng.uniform(-50, 50, 2), 2.0]),
            heading_rad=None if i % 7 == 0 else rng.uniform(-10, 10),
            epoch=f"e{i % 3}",
            camera="front",
            descriptor=descriptors[i],
        )
        for i in range(count)
    ]


def _open(folder: Path, version: str = "vlad-1", size: int = SIZE) -> VectorIndex:
    return VectorIndex(folder / "index", version=version, size=size)


@pytest.fixture(scope="module")
def filled(tmp_path_factory: pytest.TempPathFactory) -> tuple[VectorIndex, list[IndexRow]]:
    index, rows = _open(tmp_path_factory.mktemp("filled")), _rows(900)
    assert index.upsert(rows[:800]) == 800
    index.optimize()
    index.upsert(rows[800:])  # rows that the indices do not know yet
    return index, rows


def _by_hand(rows: list[IndexRow], query: np.ndarray, k: int, **filters: Any) -> list[tuple[float, str]]:
    centre, half = filters.get("centre"), filters.get("half_side_m")
    heading, window, epochs = filters.get("heading_rad"), filters.get("heading_window_deg", 180), filters.get("epochs")

    def passes(row: IndexRow) -> bool:
        if centre is not None and np.abs(row.position_in_world[:2] - centre[:2]).max() > half:
            return False
        if heading is not None and row.heading_rad is not None:
            turn = math.remainder(row.heading_rad - heading, math.tau)
            if abs(turn) > math.radians(window):
                return False
        return epochs is None or row.epoch in epochs

    found = [(float(np.linalg.norm(row.descriptor - query)), row.key) for row in rows if passes(row)]
    return sorted(found)[:k]


FILTERS = [
    {},
    {"centre": (10.0, -5.0), "half_side_m": 8.0},
    {"centre": np.array([0.0, 0.0, 99.0]), "half_side_m": 500.0},
    {"centre": (1000.0, 0.0), "half_side_m": 1.0},
    {"heading_rad": 0.1, "heading_window_deg": 90.0},
    {"heading_rad": -40.0, "heading_window_deg": 10.0},
    {"heading_rad": 3.0, "heading_window_deg": 170.0},
    {"heading_rad": 3.0, "heading_window_deg": 180.0},
    {"epochs": ("e1",)},
    {"epochs": ("e0", "e2", "none's")},
    {"epochs": ()},
    {"centre": (0, 0), "half_side_m": 30, "heading_rad": 6.2, "heading_window_deg": 90, "epochs": ["e2"]},
]


@pytest.mark.parametrize("filters", FILTERS)
def test_it_finds_what_a_search_by_hand_finds(filled: tuple[VectorIndex, list[IndexRow]], filters: dict) -> None:
    index, rows = filled
    for query in np.random.default_rng(3).standard_normal((4, SIZE)).astype(np.float32):
        expected = _by_hand(rows, query, 10, **filters)
        found = index.nearest(query, 10, **filters)
        assert found.keys == tuple(key for _, key in expected)
        np.testing.assert_allclose(found.distances, [distance for distance, _ in expected], atol=1e-5)


def test_headings_around_north_are_neighbours(tmp_path: Path) -> None:
    index = _open(tmp_path)
    headings = [0.0, math.radians(359), math.radians(1), math.radians(90), math.radians(181), -1e-18, math.tau]
    one = np.ones(SIZE, np.float32)
    index.upsert(IndexRow(f"{i}", np.zeros(3), heading, "e", "c", one) for i, heading in enumerate(headings))
    found = index.nearest(one, 10, heading_rad=0.0, heading_window_deg=2.0)
    assert set(found.keys) == {"0", "1", "2", "5", "6"}
    assert set(index.nearest(one, 10, heading_rad=0.0, heading_window_deg=90.0).keys) == {"0", "1", "2", "3", "5", "6"}
    assert set(index.nearest(one, 10, heading_rad=math.pi, heading_window_deg=2.0).keys) == {"4"}


def test_insert_update_delete(tmp_path: Path) -> None:
    index, rows = _open(tmp_path), _rows(30)
    assert (len(index), index.keys(), len(index.nearest(rows[0].descriptor, 3))) == (0, set(), 0)
    index.optimize()
    assert index.upsert(rows) == 30
    assert index.keys() == {row.key for row in rows}
    moved = IndexRow(rows[4].key, np.array([900.0, 900.0, 0.0]), None, "new", "rear", rows[9].descriptor)
    index.upsert([rows[4], moved])  # the last one counts
    assert len(index) == 30
    assert index.nearest(rows[9].descriptor, 5, centre=(900, 900), half_side_m=1).keys == (moved.key,)
    assert rows[4].key not in index.nearest(rows[4].descriptor, 30, epochs=["e1"]).keys
    assert index.delete([rows[0].key, "nobody", "it's"]) == 1
    assert index.keys() == {row.key for row in rows[1:]}
    index.upsert([rows[0]])
    assert index.nearest(rows[0].descriptor, 1).keys == (rows[0].key,)


def test_strange_keys_are_kept(tmp_path: Path) -> None:
    index, keys = _open(tmp_path), ["it's", 'a"b', "straße/7 ü", "%", "' OR TRUE --", "\\"]
    rows = [IndexRow(key, np.zeros(3), None, key, key, np.ones(SIZE, np.float32)) for key in keys]
    index.upsert(rows)
    assert index.keys() == set(keys)
    assert [index.nearest(np.ones(SIZE), 9, epochs=[key]).keys for key in keys] == [(key,) for key in keys]
    assert [index.delete([key]) for key in keys] == [1] * len(keys)


def test_rows_stream_in_batches(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """No more rows are taken than one batch holds before they are written."""
    monkeypatch.setattr(vector_index, "_BATCH_BYTES", 10 * 4 * SIZE)
    index, ahead = _open(tmp_path), []

    def rows() -> Iterator[IndexRow]:
        for number, row in enumerate(_rows(35)):
            ahead.append(number - len(index))
            yield row

    assert index.upsert(rows()) == 35
    assert (len(index), max(ahead)) == (35, 9)


@pytest.mark.parametrize(("version", "size"), [("vlad-2", SIZE), ("vlad-1", 2 * SIZE)])
def test_other_descriptors_are_refused(tmp_path: Path, version: str, size: int) -> None:
    _open(tmp_path).upsert(_rows(3))
    other = _open(tmp_path, version, size)
    with pytest.raises(StageError, match=r"descriptor (version|size) is '.*', expected '.*'\.\nDelete the folder"):
        other.keys()
    assert len(_open(tmp_path)) == 3


def test_a_damaged_index_says_what_to_do(tmp_path: Path) -> None:
    _open(tmp_path).upsert(_rows(3))
    for manifest in (tmp_path / "index" / "images.lance" / "_versions").iterdir():
        manifest.write_bytes(b"?")
    with pytest.raises(StageError, match=r"cannot be opened(.|\n)*index the images again"):
        len(_open(tmp_path))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"descriptor": np.ones(SIZE + 1, np.float32)}, "the descriptor of 'k' must be 16 finite values"),
        ({"descriptor": np.full(SIZE, np.nan, np.float32)}, "the descriptor of 'k'"),
        ({"position_in_world": np.array([0, np.inf, 0])}, "the position of 'k'"),
        ({"heading_rad": math.nan}, "the heading of 'k'"),
        ({"key": ""}, "needs a key"),
    ],
)
def test_rows_that_cannot_be_stored_are_named(tmp_path: Path, change: dict, message: str) -> None:
    given: dict[str, Any] = {
        "key": "k",
        "position_in_world": np.zeros(3),
        "heading_rad": None,
        "epoch": "e",
        "camera": "c",
    }
    index = _open(tmp_path)
    with pytest.raises(ValueError, match=message):
        index.upsert([IndexRow(**{"descriptor": np.ones(SIZE, np.float32), **given, **change})])
    assert len(index) == 0


@pytest.mark.parametrize(
    "arguments",
    [
        ((0, 0), None, None, None),
        (None, 5, None, None),
        (None, None, 1.0, None),
        (None, None, None, 9.0),
        ((math.nan, 0), 5, None, None),
        ((0, 0), -1, None, None),
        (None, None, math.inf, 9),
    ],
)
def test_half_a_filter_is_refused(arguments: tuple[Any, Any, Any, Any]) -> None:
    with pytest.raises(ValueError, match=r"needs|is no"):
        condition(*arguments, None)


def test_a_query_of_another_size_is_refused(filled: tuple[VectorIndex, list[IndexRow]]) -> None:
    with pytest.raises(ValueError, match="expected 16 finite values"):
        filled[0].nearest(np.ones(SIZE - 1), 3)


def test_a_large_map_is_searched_through_its_vector_index(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """400 places of ten images each; exact, the ten of a place are those nearest to its middle."""
    monkeypatch.setattr(vector_index, "_LARGE_ROWS", 2000)
    middles, spread = (_rows(count, seed, size=64) for count, seed in ((400, 1), (4000, 2)))
    index, rows = _open(tmp_path, size=64), []
    for i, row in enumerate(spread):
        rows.append(replace(row, descriptor=middles[i % 400].descriptor + np.float32(0.5) * row.descriptor))
    index.upsert(rows)
    index.optimize()
    assert any("descriptor" in found.columns for found in index._table().list_indices())
    found = [index.nearest(middle.descriptor, 10) for middle in middles[:100]]
    expected = [_by_hand(rows, middle.descriptor, 10) for middle in middles[:100]]
    shared = [len(set(f.keys) & {key for _, key in e}) for f, e in zip(found, expected, strict=True)]
    assert np.mean(shared) >= 9.9
    np.testing.assert_allclose(found[0].distances, [distance for distance, _ in expected[0]], atol=1e-5)


@pytest.mark.parametrize("size", [12, 100])
def test_any_size_can_be_optimized(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, size: int) -> None:
    monkeypatch.setattr(vector_index, "_LARGE_ROWS", 300)
    index, rows = _open(tmp_path, size=size), _rows(400, size=size)
    index.upsert(rows)
    index.optimize()
    assert index.nearest(rows[9].descriptor, 1).keys == (rows[9].key,)


def test_it_travels_to_other_processes_closed(filled: tuple[VectorIndex, list[IndexRow]]) -> None:
    index, rows = filled
    assert len(pickle.dumps(index)) < 1000
    assert pickle.loads(pickle.dumps(index)).keys() == {row.key for row in rows}


def _write_forever(folder: Path, acknowledged: Path, seed: int) -> None:
    """Upserts 50 rows at a time, and notes each time which are in; also replaces and optimizes."""
    index = _open(folder)
    with acknowledged.open("a", encoding="utf-8") as notes:
        for turn in range(10**6):
            prefix = f"{seed}-{turn % 40}-"
            index.upsert(_rows(50, turn % 40, prefix))
            notes.write(prefix + "\n")
            notes.flush()
            if turn % 8 == 7:
                index.optimize()


def test_killed_writers_lose_nothing_and_leave_nothing_half(tmp_path: Path) -> None:
    """Three write at once and are killed one after the other, in the middle of whatever they do."""
    notes = [tmp_path / f"acknowledged-{seed}" for seed in range(3)]
    writers = [SPAWN.Process(target=_write_forever, args=(tmp_path, note, i)) for i, note in enumerate(notes)]
    for writer in writers:
        writer.start()
    for seed, (writer, note) in enumerate(zip(writers, notes, strict=True)):
        _wait(lambda note=note, least=6 + 6 * seed: len(_noted([note])) >= least, writer)
        time.sleep(0.007 * seed)
        assert writer.pid is not None
        os.kill(writer.pid, signal.SIGKILL)
        writer.join()
        _check_acknowledged(tmp_path, _noted(notes))
    index = _open(tmp_path)
    index.upsert(_rows(50, prefix="after-0-"))
    index.optimize()
    _check_acknowledged(tmp_path, [*_noted(notes), "after-0-"], live=False)


def _noted(notes: list[Path]) -> list[str]:
    return [line for note in notes if note.is_file() for line in note.read_text(encoding="utf-8").split("\n")[:-1]]


def _check_acknowledged(folder: Path, prefixes: list[str], *, live: bool = True) -> None:
    index = _open(folder)
    keys = index.keys()
    assert live or len(keys) == len(index)
    assert len(keys) % 50 == 0  # each upsert is there as a whole or not at all
    assert {row.key for prefix in set(prefixes) for row in _rows(50, 0, prefix)} <= keys
    for prefix in sorted(set(prefixes))[-5:]:
        rows = _rows(50, int(prefix.split("-")[1]), prefix)
        assert index.nearest(rows[7].descriptor, 1, epochs=[rows[7].epoch]).distances[0] < 1e-6


def _wait(condition, process) -> None:
    end = time.monotonic() + 300  # a loaded machine may take long to start a process
    while not condition():
        assert time.monotonic() < end
        assert process.is_alive()
        time.sleep(0.01)


def _write_some(folder: Path, prefix: str, turns: int) -> None:
    index = _open(folder)
    for turn in range(turns):
        index.upsert(_rows(20, turn, f"{prefix}{turn}-"))
        index.upsert(_rows(20, turn, "shared-"))  # the same keys from every writer
        if turn % 5 == 4:
            index.optimize()


def test_readers_read_while_writers_write(tmp_path: Path) -> None:
    index, first = _open(tmp_path), _rows(60, prefix="first-")
    index.upsert(first)
    writers = [SPAWN.Process(target=_write_some, args=(tmp_path, f"w{i}-", 12)) for i in range(2)]
    for writer in writers:
        writer.start()
    sizes = []
    while any(writer.is_alive() for writer in writers):
        assert index.nearest(first[5].descriptor, 1).keys == (first[5].key,)
        sizes.append(len(index))
    assert [writer.exitcode for writer in writers] == [0, 0]
    assert sizes == sorted(sizes)
    assert len(set(sizes)) > 3  # it saw them grow
    assert len(index) == len(index.keys()) == 60 + 2 * 12 * 20 + 20
