"""The feature store at the size of a survey, beside exact storage and numpy's archives: rates, memory, disk."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from georef.benchmarks.measure import Cost, disk_mb, measured, table
from georef.store.feature_store import FeatureStore
from georef.types.features import Features

_VARIANTS = 8  # different images; making them is not what is measured
_HEAD = 1024  # keypoints of the partial read
_ALTERNATIVE_IMAGES = 200  # enough for a rate; compressing takes a third of a second an image
_NAMES = ("keypoints_px", "scores", "scales_px", "descriptors", "colors_rgb")


@dataclass(frozen=True)
class Way:
    """How to write the features of image `number` into a folder, and to read the first `count` of them again."""

    write: Callable[[Path, int, Features], None]
    read: Callable[[Path, int, int | None], Features]
    alternative: bool = False


def run(images: int, keypoints: int, folder: Path, seed: int = 0) -> dict[str, Any]:
    """Writes and reads `images` images with `keypoints` ALIKED-like features each, in `folder`; the alternatives
    with 200 images at most.

    Reads come in random order and, where memory allows, from the system's file cache. Each step runs in a process of
    its own. Raises OSError where the disk refuses.
    """
    ways = {}
    for name, way in WAYS.items():
        place = folder / name.replace(" ", "_").replace(",", "")
        number = min(images, _ALTERNATIVE_IMAGES) if way.alternative else images
        written = measured(_write_all, name, place, number, keypoints, seed)
        ways[name] = {"images": number, "write": _rate(written, number), "disk_mb": disk_mb(place)}
        for label, count in (("read", None), ("read_head", _HEAD)):
            ways[name][label] = _rate(measured(_read_all, name, place, number, count, seed), number)
    return {"images": images, "keypoints": keypoints, "head": _HEAD, "ways": ways}


def describe(result: dict[str, Any]) -> list[str]:
    """The table for a terminal."""
    title = f"{result['images']:,} images of {result['keypoints']:,} features (128 values, float16 as extracted)"
    head = f"first {result['head']:,}/s"
    header = (
        "store",
        "images",
        "MB",
        "KB per 1,024",
        "write/s",
        "CPU ms",
        "read/s",
        "CPU ms",
        head,
        "CPU ms",
        "peak MB",
    )
    rows = []
    for name, way in result["ways"].items():
        each_kb = 1e3 * way["disk_mb"] / way["images"] / result["keypoints"] * 1024
        steps = [way[step] for step in ("write", "read", "read_head")]
        numbers = [text for step in steps for text in (f"{step['images_per_s']:,.0f}", f"{step['cpu_ms']:.1f}")]
        peak = max(step["peak_mb"] for step in steps)
        rows.append((name, f"{way['images']:,}", f"{way['disk_mb']:,.0f}", f"{each_kb:.1f}", *numbers, f"{peak:,.0f}"))
    return [title, "", *table(header, rows)]


def synthetic_features(keypoints: int, seed: int) -> Features:
    """Features of a 12 megapixel image with unit descriptors, scores in (0, 1) and one scale, as ALIKED gives them."""
    rng = np.random.default_rng(seed)
    descriptors = rng.standard_normal((keypoints, 128), np.float32)
    descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
    return Features(
        image_size=(4000, 3000),
        keypoints_px=rng.uniform(0, 3000, (keypoints, 2)).astype(np.float32),
        scores=np.sort(rng.random(keypoints, np.float32))[::-1],
        scales_px=np.full(keypoints, 1.95, np.float32),
        descriptors=descriptors.astype(np.float16),
        colors_rgb=rng.integers(0, 256, (keypoints, 3), np.uint8),
    )


def _write_all(name: str, folder: Path, images: int, keypoints: int, seed: int) -> dict[str, float]:
    folder.mkdir(parents=True, exist_ok=True)
    variants = [synthetic_features(keypoints, seed + i) for i in range(_VARIANTS)]
    write = WAYS[name].write
    wall, cpu = time.perf_counter(), time.process_time()
    for number in range(images):
        write(folder, number, variants[number % _VARIANTS])
    return {"wall_s": time.perf_counter() - wall, "cpu_s": time.process_time() - cpu}


def _read_all(name: str, folder: Path, images: int, count: int | None, seed: int) -> dict[str, float]:
    order, read = np.random.default_rng(seed).permutation(images), WAYS[name].read
    wall, cpu = time.perf_counter(), time.process_time()
    for number in order:
        read(folder, int(number), count)
    return {"wall_s": time.perf_counter() - wall, "cpu_s": time.process_time() - cpu}


def _rate(cost: Cost[dict[str, float]], images: int) -> dict[str, float]:
    done = cost.result
    each_ms = 1e3 * done["cpu_s"] / images
    return done | {"images_per_s": images / done["wall_s"], "cpu_ms": each_ms, "peak_mb": cost.peak_mb}


def _stored(quantize: bool) -> Way:
    def write(folder: Path, number: int, features: Features) -> None:
        FeatureStore(folder, quantize=quantize).write(f"city/{number:06d}.jpg", features, folder)

    def read(folder: Path, number: int, count: int | None) -> Features:
        return FeatureStore(folder, quantize=quantize).read(f"city/{number:06d}.jpg", count)

    return Way(write, read)


def _archived(save: Callable[..., None], *, full_float: bool) -> Way:
    def write(folder: Path, number: int, features: Features) -> None:
        arrays = {name: getattr(features, name) for name in _NAMES}
        if full_float:
            arrays["descriptors"] = features.descriptors.astype(np.float32)
        save(folder / f"{number:06d}.npz", image_size=features.image_size, **arrays)

    def read(folder: Path, number: int, count: int | None) -> Features:
        with np.load(folder / f"{number:06d}.npz", allow_pickle=False) as archive:
            width, height = archive["image_size"]
            return Features((int(width), int(height)), **{name: archive[name][:count] for name in _NAMES})

    return Way(write, read, alternative=True)


WAYS = {
    "georef, 7 bits": _stored(True),
    "georef, exact": _stored(False),
    "np.savez, float32": _archived(np.savez, full_float=True),
    "np.savez_compressed, float16": _archived(np.savez_compressed, full_float=False),
}
