"""Tables of what variants cost: processor time by step, and what they keep on disk."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from georef.comparison.run import LOCALIZE, StageCost, VariantRun
from georef.evaluation.tables import Cell, Column, Table
from georef.stages.base import open_features

_COUNTED = 100  # images whose keypoints are counted
_RUNTIME = (
    Column("name", ""),
    Column("step", "step"),
    Column("cpu_each", "of each image", "s", 2, shown_unit="CPU-s"),
    Column("images", "images"),
    Column("cpu", "together", "s", 1, shown_unit="CPU-s"),
    Column("wall", "wall time", "s", 1),
    Column("memory", "peak memory", "MB", 0),
)
_STORAGE = (
    Column("name", ""),
    Column("what", "store"),
    Column("images", "images"),
    Column("bytes_each", "of each image", "bytes", 1, 1e-3, "kB"),
    Column("keypoints", "keypoints an image", "", 0),
    Column("bytes_1024", "of 1,024 keypoints", "bytes", 1, 1e-3, "kB"),
    Column("bytes", "together", "bytes", 2, 1e-6, "MB"),
)


def runtime_table(runs: Mapping[str, VariantRun]) -> Table:
    """Processor time by step: of the stages before localization, and of the steps of each query. Runs by their name."""
    rows: list[dict[str, Cell]] = []
    seen: set[str] = set()
    for name, run in runs.items():
        for cost in run.costs:
            if _new(cost.run, seen):
                rows += _queries(name, run, cost) if cost.stage == LOCALIZE else [_stage(name, cost)]
    return Table(
        "runtime",
        "Runtime by step",
        _RUNTIME,
        tuple(rows),
        "CPU seconds as measured when results were computed; a stage that several variants share is listed with the "
        "first. Steps of localization: mean over all queries. A stage that was interrupted states its last part alone.",
    )


def storage_table(runs: Mapping[str, VariantRun]) -> Table:
    """Bytes an image of the features and of what each stage leaves behind. Runs by their name."""
    seen: set[str] = set()
    rows = [row for name, run in runs.items() for row in _storage(name, run, seen)]
    caption = f"File sizes; keypoints are counted in {_COUNTED} images at most. Shared stores are listed once."
    return Table("storage", "Memory of descriptors, features and maps", _STORAGE, tuple(rows), caption)


def _new(key: str, seen: set[str]) -> bool:
    is_new = key not in seen
    seen.add(key)
    return is_new


def _stage(name: str, cost: StageCost) -> dict[str, Cell]:
    row: dict[str, Cell] = {"name": name, "step": cost.stage, "cpu": cost.cpu_s, "wall": cost.wall_s}
    if cost.computed:
        row |= {"cpu_each": cost.cpu_s / cost.computed, "images": cost.computed}
    return {**row, "memory": cost.peak_memory_mb}


def _queries(name: str, run: VariantRun, cost: StageCost) -> Iterator[dict[str, Cell]]:
    count = max(len(run.outcomes), 1)
    steps = list(dict.fromkeys(step for outcome in run.outcomes for step in outcome.cpu_s))
    times = {step: sum(outcome.cpu_s.get(step, 0.0) for outcome in run.outcomes) for step in steps}
    for step, cpu_s in times.items():
        each = cpu_s / count
        yield {"name": name, "step": f"{LOCALIZE}: {step}", "cpu_each": each, "images": count, "cpu": cpu_s}
    total = sum(times.values())
    yield {
        "name": name,
        "step": f"{LOCALIZE}: all",
        "cpu_each": total / count,
        "images": count,
        "cpu": total,
        "wall": cost.wall_s,
        "memory": cost.peak_memory_mb,
    }


def _storage(name: str, run: VariantRun, seen: set[str]) -> Iterator[dict[str, Cell]]:
    context = run.context
    assert context is not None
    references = len(context.survey.reference.images)
    for what, folder in {**context.before, LOCALIZE: context.folder}.items():
        if what == "features" or not _new(str(folder), seen):  # a summary alone: the features are in the store
            continue
        size = _bytes(folder)
        if what == "store":
            yield {"name": name, "what": "local features", **_feature_sizes(folder, size)}
        else:
            images = len(run.outcomes) if what == LOCALIZE else references
            yield {"name": name, "what": what, "images": images, "bytes_each": size / max(images, 1), "bytes": size}


def _feature_sizes(folder: Path, size: int) -> dict[str, Cell]:
    store = open_features(folder)
    ids = store.ids()
    some = sorted({ids[int(i)] for i in np.linspace(0, len(ids) - 1, min(_COUNTED, len(ids)))})
    keypoints = float(np.mean([len(store.read(name)) for name in some]))
    each = size / len(ids)
    by_keypoint = 1024.0 * each / keypoints if keypoints else None
    return {
        "images": len(ids),
        "bytes_each": each,
        "bytes": size,
        "keypoints": keypoints,
        "bytes_1024": by_keypoint,
    }


def _bytes(folder: Path) -> int:
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
