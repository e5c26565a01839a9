"""The vector index at the size of a city, beside brute force: time, recall, memory, disk."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from georef.benchmarks import vector_searches as ways
from georef.benchmarks.city import City
from georef.benchmarks.measure import Cost, disk_mb, measured, table

_OPENED = {"index": ways.open_index, "numpy": ways.open_mapped}


def run(images: int, size: int, queries: int, folder: Path, seed: int = 0) -> dict[str, Any]:
    """Builds both stores of `images` descriptors in `folder`, and asks both the same questions.

    Every step runs in a process of its own. Raises OSError where the disk refuses.
    """
    city = City(images, size, seed)
    folders = {name: folder / name for name in _OPENED}
    filled = {"index": measured(ways.fill_index, city, folders["index"])}
    sizes = {"index as written": disk_mb(folders["index"])}
    optimized = measured(ways.optimize_index, city, folders["index"])
    sizes["index with its replaced files"] = disk_mb(folders["index"])
    filled["numpy"] = measured(ways.fill_mapped, city, folders["numpy"])
    sizes["numpy"] = disk_mb(folders["numpy"])
    asked = ways.searches(city, np.load(folders["numpy"] / "positions.npy"), queries)
    answers = [_answered(city, folders, name, searches) for name, searches in asked.items()]
    return {
        "images": images,
        "size": size,
        "queries": queries,
        "k": ways.K,
        "fill": {name: _filling(cost) for name, cost in filled.items()},
        "optimize": {"wall_s": optimized.wall_s, "cpu_s": optimized.cpu_s, "peak_mb": optimized.peak_mb},
        "disk_mb": sizes,
        "searches": answers,
    }


def describe(result: dict[str, Any]) -> list[str]:
    """The tables for a terminal."""
    lines = [f"{result['images']:,} images, descriptors of {result['size']} float32, {result['queries']} queries, k 10"]
    fills = [
        (name, f"{fill['rows_per_s']:,.0f}", f"{fill['cpu_s']:.1f}", f"{fill['peak_mb']:,.0f}")
        for name, fill in result["fill"].items()
    ]
    optimize = result["optimize"]
    fills.append(("index: optimize", "", f"{optimize['cpu_s']:.1f}", f"{optimize['peak_mb']:,.0f}"))
    lines += ["", *table(("writing", "rows/s", "CPU-s", "peak MB"), fills)]
    lines += ["", *table(("on disk", "MB"), [(name, f"{mb:,.0f}") for name, mb in result["disk_mb"].items()])]
    header = ("search", "images", "by", "median ms", "95 % ms", "CPU ms", "first ms", "recall", "peak MB")
    rows = [_search_row(search, name) for search in result["searches"] for name in _OPENED]
    return [*lines, "", *table(header, rows)]


def _answered(city: City, folders: dict[str, Path], name: str, searches: list[ways.Search]) -> dict[str, Any]:
    costs = {by: measured(ways.answer_all, way, city, folders[by], searches) for by, way in _OPENED.items()}
    exact = costs["numpy"].result["found"]
    inside = _inside(np.load(folders["numpy"] / "positions.npy"), searches)
    return {"search": name, "images_median": inside} | {by: _answering(cost, exact) for by, cost in costs.items()}


def _inside(positions: NDArray[np.float64], searches: list[ways.Search]) -> int:
    """How many images are in the box, before the heading window; the median."""
    boxes = [(s.centre, s.half_side_m) for s in searches[:20] if s.centre is not None]
    if not boxes:
        return len(positions)
    return int(np.median([(np.abs(positions[:, :2] - at).max(axis=1) <= half).sum() for at, half in boxes]))


def _filling(cost: Cost[dict[str, float]]) -> dict[str, float]:
    done = cost.result
    return done | {"rows_per_s": done["rows"] / done["wall_s"], "peak_mb": cost.peak_mb}


def _answering(cost: Cost[dict[str, Any]], exact: list[NDArray[np.int64]]) -> dict[str, float]:
    found, wall_ms = cost.result["found"], cost.result["wall_ms"]
    shared = [len(np.intersect1d(a, b)) / max(len(b), 1) for a, b in zip(found, exact, strict=True)]
    return {
        "median_ms": float(np.median(wall_ms)),
        "p95_ms": float(np.quantile(wall_ms, 0.95)),
        "cpu_ms": cost.result["cpu_ms"],
        "first_ms": cost.result["first_ms"],
        "recall": float(np.mean(shared)),
        "peak_mb": cost.peak_mb,
    }


def _search_row(search: dict[str, Any], by: str) -> tuple[str, ...]:
    cost = search[by]
    times = (f"{cost[key]:,.1f}" for key in ("median_ms", "p95_ms", "cpu_ms", "first_ms"))
    recall, peak = f"{cost['recall']:.4f}", f"{cost['peak_mb']:,.0f}"
    return search["search"], f"{search['images_median']:,}", by, *times, recall, peak
