"""Levels, their budgets, and levels that are looked at in tiles."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import NDArray

from georef.features.base import extract_features, level_budget
from georef.features.detections import Detections, Image
from georef.features.tiling import ALIGNMENT_PX, OVERLAP_PX, detect_in_tiles, spans


class Bright:
    """Finds single bright pixels; the score is the red value, the descriptor the colour."""

    name = "bright"
    descriptor_size = 3
    descriptor_dtype = np.dtype(np.uint8)
    largest_side_px = 100
    tile_side_px = 100

    def __init__(self, shift_px: float = 0.0) -> None:
        self.seen: list[tuple[int, int]] = []
        self._shift_px = shift_px  # of keypoints, alternating between tiles

    def version(self) -> str:
        return "bright-1"

    def detect(self, image_rgb: Image, max_keypoints: int) -> Detections:
        self.seen.append((image_rgb.shape[1], image_rgb.shape[0]))
        row, column = np.nonzero(image_rgb[:, :, 0] > 100)
        scores = image_rgb[row, column, 0].astype(np.float32)
        best = np.argsort(-scores, kind="stable")[:max_keypoints]
        shift = self._shift_px * (-1) ** len(self.seen)
        keypoints = np.stack([column + 0.5 + shift, row + 0.5], 1).astype(np.float32)
        return Detections(keypoints[best], scores[best], np.ones(len(best), np.float32), image_rgb[row, column][best])


def dots(width: int, height: int, count: int, seed: int = 0) -> Image:
    rng = np.random.default_rng(seed)
    image = np.zeros((height, width, 3), np.uint8)
    image[rng.integers(0, height, count), rng.integers(0, width, count), 0] = rng.integers(101, 256, count)
    return image


def _sorted(keypoints: NDArray) -> NDArray:
    return keypoints[np.lexsort(keypoints.T)]


@pytest.mark.parametrize("length", [101, 132, 150, 200, 333, 1000, 1024])
def test_spans_cover_an_axis_and_overlap(length: int) -> None:
    tiles = spans(length, 100)
    assert tiles[0].begin == 0
    assert tiles[-1].end == length
    for tile in tiles:
        assert tile.begin % ALIGNMENT_PX == 0
        assert 0 < tile.end - tile.begin <= 100
    for left, right in pairwise(tiles):
        assert left.end - right.begin >= OVERLAP_PX
        assert left.keep_to == right.keep_from
        assert right.begin + OVERLAP_PX / 2 <= left.keep_to <= left.end - OVERLAP_PX / 2


def test_what_fits_is_one_tile() -> None:
    assert [(tile.begin, tile.end) for tile in spans(100, 100)] == [(0, 100)]


@pytest.mark.parametrize("size", [(333, 251), (101, 99), (640, 100)])
def test_tiles_find_what_the_whole_has_once(size: tuple[int, int]) -> None:
    image, extractor = dots(*size, 400), Bright()
    whole = Bright().detect(image, 10_000)
    tiled = detect_in_tiles(extractor.detect, image, 100, 10_000)
    assert len(extractor.seen) > 1
    assert max(max(seen) for seen in extractor.seen) <= 100
    np.testing.assert_array_equal(_sorted(tiled.keypoints_px), _sorted(whole.keypoints_px))


def test_the_budget_is_that_of_the_whole_image() -> None:
    """Dots in one corner alone take it all; so do the best of everywhere."""
    image = np.zeros((300, 300, 3), np.uint8)
    image[:60, :60] = dots(60, 60, 300)
    assert len(detect_in_tiles(Bright().detect, image, 100, 150).scores) == 150
    image = dots(300, 300, 900)
    whole, tiled = Bright().detect(image, 10_000).scores, detect_in_tiles(Bright().detect, image, 100, 200).scores
    np.testing.assert_array_equal(tiled, np.sort(whole)[::-1][:200])


def test_two_tiles_views_of_one_place_on_a_seam_are_one_keypoint() -> None:
    """Tiles that disagree by 0.8 px about a dot on their seam both call it theirs: the better one stays."""
    tiles = spans(200, 100)
    image = np.zeros((90, 200, 3), np.uint8)
    image[10:80:10, int(tiles[0].keep_to), 0] = 200
    image[5:80:10, int(tiles[0].keep_to), 0] = 210
    found = detect_in_tiles(Bright(0.4).detect, image, 100, 1000)
    assert len(found.scores) <= 15
    gaps = np.abs(found.keypoints_px[:, None] - found.keypoints_px[None]).max(2) + 9 * np.eye(len(found.scores))
    assert gaps.min() > 1


def test_nothing_in_any_tile() -> None:
    assert len(detect_in_tiles(Bright().detect, np.zeros((250, 250, 3), np.uint8), 100, 10).scores) == 0


def test_levels_decide_between_whole_and_tiles() -> None:
    image, extractor = dots(400, 300, 300), Bright()
    small = extract_features(extractor, image, 100, 50)
    assert extractor.seen == [(100, 75)]
    assert small.image_size == (400, 300)
    extractor.seen.clear()
    full = extract_features(extractor, image, None, None)
    assert len(extractor.seen) > 4
    row, column = np.nonzero(image[:, :, 0])
    np.testing.assert_array_equal(_sorted(full.keypoints_px), _sorted(np.stack([column, row], 1) + np.float32(0.5)))


@pytest.mark.parametrize(
    ("size", "budget"),
    [((1024, 683), 4096), ((300, 1000), 4096), ((2048, 1365), 6144), ((3072, 2048), 6442), ((4096, 2730), 11450)],
)
def test_the_budget_of_a_level(size: tuple[int, int], budget: int) -> None:
    assert level_budget(size) == budget


def test_sift_in_tiles_equals_sift() -> None:
    """A real extractor finds the same in tiles: SIFT, whose large scales alone see farther than a tile."""
    from georef.features.sift import Sift
    from tests.contracts.synthetic import textured_image

    image = textured_image(700, 500, seed=2)
    whole = Sift().detect(image, 3000)
    tiled = detect_in_tiles(Sift().detect, image, 400, 3000)
    fine = whole.scales_px < 4
    distance = np.linalg.norm(whole.keypoints_px[fine][:, None] - tiled.keypoints_px[None], axis=2).min(1)
    assert fine.sum() > 500
    assert np.mean(distance < 0.01) > 0.97
