"""The searches of the vector benchmark, and the two ways to answer them: the index, and numpy over a mapped file."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from georef.benchmarks.city import City
from georef.benchmarks.measure import Waiting
from georef.store.vector_index import VectorIndex
from georef.store.vector_rows import IndexRow

K = 10
VERSION = "synthetic-city-1"
_PRIOR_SIGMA_M = 5.0  # of the centre of the search box
_WINDOW_DEG = 90.0
_BLOCK = 65_536  # rows that numpy compares at once
FILTERS = ("box of about 50", "box of about 1,000", "box of 1 x 1 km", "the same, heading +-90 deg", "whole map")


@dataclass(frozen=True, eq=False)
class Search:
    """One query under one of `FILTERS`; centre None: no filter."""

    descriptor: NDArray[np.float32]
    centre: NDArray[np.float64] | None = None
    half_side_m: float | None = None
    heading_rad: float | None = None
    heading_window_deg: float | None = None


Answer = Callable[[Search], NDArray[np.int64]]


def searches(city: City, positions: NDArray[np.float64], count: int) -> dict[str, list[Search]]:
    """The same `count` queries under each filter; boxes of about n hold exactly n images."""
    queries = city.queries(count)
    rng = np.random.default_rng([city.seed, 9])
    found: dict[str, list[Search]] = {name: [] for name in FILTERS}
    for descriptor, position, heading in zip(queries.descriptors, queries.positions, queries.headings, strict=True):
        centre = position[:2] + rng.normal(0, _PRIOR_SIGMA_M, 2)
        away = np.abs(positions[:, :2] - centre).max(axis=1)
        halves = [float(np.partition(away, n - 1)[n - 1]) for n in (50, 1000) if n <= len(away)]
        for name, half in zip(FILTERS, [*halves, 500.0], strict=False):
            found[name].append(Search(descriptor, centre, half))
        found[FILTERS[3]].append(Search(descriptor, centre, 500.0, float(heading), _WINDOW_DEG))
        found[FILTERS[4]].append(Search(descriptor))
    return found


def fill_index(city: City, folder: Path) -> dict[str, float]:
    """All images into the index, one stream; seconds without those that it took to make the descriptors."""
    made = Waiting(_rows(city))
    wall, cpu = time.perf_counter(), time.process_time()
    count = VectorIndex(folder, version=VERSION, size=city.size).upsert(made)
    wall_s, cpu_s = time.perf_counter() - wall - made.wall_s, time.process_time() - cpu - made.cpu_s
    return {"rows": count, "wall_s": wall_s, "cpu_s": cpu_s}


def optimize_index(city: City, folder: Path) -> None:
    VectorIndex(folder, version=VERSION, size=city.size).optimize()


def fill_mapped(city: City, folder: Path) -> dict[str, float]:
    """Descriptors, positions and headings into plain files."""
    folder.mkdir(parents=True, exist_ok=True)
    made, positions, headings = Waiting(city.chunks()), [], []
    wall, cpu = time.perf_counter(), time.process_time()
    with (folder / "descriptors.bin").open("wb") as stream:
        for images in made:
            stream.write(images.descriptors.data)
            positions.append(images.positions)
            headings.append(images.headings)
    np.save(folder / "positions.npy", np.concatenate(positions))
    np.save(folder / "headings.npy", np.concatenate(headings))
    wall_s, cpu_s = time.perf_counter() - wall - made.wall_s, time.process_time() - cpu - made.cpu_s
    return {"rows": city.images, "wall_s": wall_s, "cpu_s": cpu_s}


def answer_all(open_: Callable[..., Answer], city: City, folder: Path, asked: list[Search]) -> dict[str, Any]:
    """Answers of all searches, in a process that does nothing else; the first one is asked twice, to warm up."""
    answer = open_(city, folder)
    start = time.perf_counter()
    answer(asked[0])
    first_ms = 1e3 * (time.perf_counter() - start)
    found, wall_ms, cpu = [], [], time.process_time()
    for search in asked:
        start = time.perf_counter()
        found.append(answer(search))
        wall_ms.append(1e3 * (time.perf_counter() - start))
    cpu_ms = 1e3 * (time.process_time() - cpu) / len(asked)
    return {"found": found, "wall_ms": wall_ms, "cpu_ms": cpu_ms, "first_ms": first_ms}


def open_index(city: City, folder: Path) -> Answer:
    index = VectorIndex(folder, version=VERSION, size=city.size)

    def answer(search: Search) -> NDArray[np.int64]:
        found = index.nearest(
            search.descriptor,
            K,
            centre=search.centre,
            half_side_m=search.half_side_m,
            heading_rad=search.heading_rad,
            heading_window_deg=search.heading_window_deg,
        )
        return np.array([int(key[-12:-4]) for key in found.keys], np.int64)

    return answer


def open_mapped(city: City, folder: Path) -> Answer:
    """Exact by brute force: a mask over all positions, then the dot product with what is left."""
    positions, headings = np.load(folder / "positions.npy"), np.load(folder / "headings.npy")
    shape = len(positions), city.size
    descriptors = np.memmap(folder / "descriptors.bin", np.float32, "r", shape=shape)

    def answer(search: Search) -> NDArray[np.int64]:
        if search.centre is None:
            blocks = range(0, len(descriptors), _BLOCK)
            similarity = np.concatenate([descriptors[i : i + _BLOCK] @ search.descriptor for i in blocks])
            return _best(similarity)
        inside = (np.abs(positions[:, :2] - search.centre) <= search.half_side_m).all(axis=1)
        if search.heading_rad is not None and search.heading_window_deg is not None:
            turn = (headings - search.heading_rad + np.pi) % (2 * np.pi) - np.pi
            inside &= np.abs(turn) <= math.radians(search.heading_window_deg)
        rows = np.flatnonzero(inside)
        return rows[_best(descriptors[rows] @ search.descriptor)]

    return answer


def _best(similarity: NDArray[np.float32]) -> NDArray[np.int64]:
    """The K largest of unit rows' similarities, which are those of the smallest distances, in their order."""
    some = np.argpartition(-similarity, min(K, len(similarity)) - 1)[:K]
    return some[np.argsort(-similarity[some], kind="stable")]


def _rows(city: City) -> Iterator[IndexRow]:
    number = 0
    for images in city.chunks():
        columns = (images.positions, images.headings, images.descriptors)
        for position, heading, descriptor in zip(*columns, strict=True):
            yield IndexRow(f"city/{number:08d}.jpg", position, float(heading), "city", f"c{number % 10}", descriptor)
            number += 1
