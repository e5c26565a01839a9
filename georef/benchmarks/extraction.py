"""What it costs to extract local features: every extractor with weights at hand, and ALIKED beside kornia's module."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from georef.benchmarks.measure import measured, table
from georef.errors import WeightsError
from georef.features.base import extract_features, level_budget, resize_image
from georef.features.images import read_image
from georef.features.registry import EXTRACTORS, load_component
from georef.geometry.pixels import level_size

LEVELS_PX = (1024, 2048)
Detect = Callable[[np.ndarray, int], np.ndarray]
SHIPPED = "aliked-n16, kornia's module"
_SAME_PX = 0.01  # keypoints nearer to each other are the same


@dataclass(frozen=True)
class ExtractionCost:
    """One extractor at one level, means over the images; memory includes the process and its imports."""

    name: str
    longest_side_px: int
    images: int
    keypoints: float
    cpu_s: float  # of one image: reading and resizing included, loading of weights and a first small image not
    peak_mb: float


@dataclass(frozen=True)
class Comparison:
    """ALIKED at one level, as it is here and as kornia has it."""

    own: ExtractionCost
    shipped: ExtractionCost
    same_share: float  # of the shipped module's keypoints that are found here too, within 0.01 px of the level


def extraction_costs(
    images: Sequence[Path], names: Sequence[str] | None = None, levels_px: Sequence[int] = LEVELS_PX, threads: int = 1
) -> Iterator[ExtractionCost]:
    """Costs one by one, each extractor at each level in a fresh process. names: None for all of the table.

    Extractors whose weights are not in the cache are left out.
    """
    for name in EXTRACTORS.names() if names is None else names:
        if not _is_here(name):
            continue
        for level in levels_px:
            cost = measured(_extract_all, name, tuple(images), level, threads)
            counts, seconds = cost.result
            yield ExtractionCost(name, level, len(images), float(np.mean(counts)), seconds / len(images), cost.peak_mb)


def compared_with_kornia(images: Sequence[Path], level_px: int = 2048, threads: int = 1) -> Comparison:
    """ALIKED n16 here and by kornia's module with the same weights and no threshold, in fresh processes of one run.

    Raises WeightsError where the weights are not in the cache.
    """
    own = measured(_detect_all, "georef", tuple(images), level_px, threads)
    shipped = measured(_detect_all, "kornia", tuple(images), level_px, threads)
    costs = []
    for name, cost in (("aliked-n16", own), (SHIPPED, shipped)):
        found, seconds = cost.result
        mean = float(np.mean([len(keypoints) for keypoints in found]))
        costs.append(ExtractionCost(name, level_px, len(images), mean, seconds / len(images), cost.peak_mb))
    pairs = zip(own.result[0], shipped.result[0], strict=True)
    return Comparison(costs[0], costs[1], float(np.mean([_same_share(a, b) for a, b in pairs])))


def as_table(costs: Sequence[ExtractionCost]) -> list[str]:
    """Lines of a table."""
    header = ("extractor", "level px", "keypoints", "CPU-s an image", "peak MB")
    rows = [
        (cost.name, str(cost.longest_side_px), f"{cost.keypoints:.0f}", f"{cost.cpu_s:.2f}", f"{cost.peak_mb:.0f}")
        for cost in costs
    ]
    return table(header, rows)


def _is_here(name: str) -> bool:
    try:
        load_component(EXTRACTORS, name)
    except WeightsError:
        return False
    return True


def _set_threads(threads: int) -> None:
    import cv2
    import torch

    torch.set_num_threads(threads)
    cv2.setNumThreads(threads)


def _extract_all(name: str, images: tuple[Path, ...], level_px: int, threads: int) -> tuple[list[int], float]:
    """Keypoints of each image at the level's budget, and CPU seconds of all."""
    _set_threads(threads)
    extractor = load_component(EXTRACTORS, name)
    extractor.detect(np.zeros((64, 64, 3), np.uint8), 1)
    begin = time.process_time()
    counts = [len(extract_features(extractor, read_image(path), level_px, None)) for path in images]
    return counts, time.process_time() - begin


def _detect_all(whose: str, images: tuple[Path, ...], level_px: int, threads: int) -> tuple[list[np.ndarray], float]:
    """ALIKED's keypoints (N, 2) of each image's level, the top-left pixel's centre at (0.5, 0.5), and CPU seconds."""
    _set_threads(threads)
    detect = _own_detector() if whose == "georef" else _kornias_detector()
    detect(np.zeros((64, 64, 3), np.uint8), 1)
    found, begin = [], time.process_time()
    for path in images:
        pixels = read_image(path)
        size = level_size((pixels.shape[1], pixels.shape[0]), level_px)
        found.append(detect(resize_image(pixels, size), level_budget(size)))
    return found, time.process_time() - begin


def _own_detector() -> Detect:
    extractor = load_component(EXTRACTORS, "aliked-n16", detection_threshold=0.0)
    return lambda image, budget: extractor.detect(image, budget).keypoints_px


def _kornias_detector() -> Detect:
    import torch
    from kornia.feature.aliked.aliked import ALIKED

    from georef.features.weights import load_state_dict

    weights = load_state_dict("aliked-n16")

    def detect(image: np.ndarray, budget: int) -> np.ndarray:
        network = ALIKED("aliked-n16", max_num_keypoints=budget, detection_threshold=0.0).eval()
        network.load_state_dict(weights, strict=False)
        with torch.inference_mode():
            pixels = torch.from_numpy(image).permute(2, 0, 1)[None].float() / 255
            return network(pixels)[0].keypoints.numpy() + 0.5

    return detect


def _same_share(own: np.ndarray, shipped: np.ndarray) -> float:
    from scipy.spatial import KDTree

    return float(np.mean(KDTree(own).query(shipped)[0] < _SAME_PX))
