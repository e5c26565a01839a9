"""What every extractor of the table must keep, whatever it computes."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from synthetic import blobs_image, nearest_offsets, textured_image

from georef.features.base import Extractor, extract_features
from georef.features.registry import EXTRACTORS, ComponentTable
from georef.features.tiling import OVERLAP_PX, detect_in_tiles
from georef.types.features import Features

# The keypoints of these stand at what they detect. A learned detector is free to stand beside it, and ALIKED does (2 to
# 3 px, always on the same side, which a mirrored image turns round). The pixel origin of those is proved in
# tests/unit/test_features_networks.py against another implementation; comparing levels shows errors of a pixel alone.
CENTRED = {"sift"}


@pytest.fixture(params=EXTRACTORS.names())
def extractor(request: pytest.FixtureRequest, component: Callable[[ComponentTable, str], Extractor]) -> Extractor:
    return component(EXTRACTORS, request.param)


def _assert_valid(features: Features, extractor: Extractor, image_size: tuple[int, int], max_keypoints: int) -> None:
    count = len(features)
    assert features.image_size == image_size
    assert count <= max_keypoints
    assert features.keypoints_px.shape == (count, 2)
    assert features.keypoints_px.dtype == np.float32
    assert features.scores.shape == features.scales_px.shape == (count,)
    assert features.scores.dtype == features.scales_px.dtype == np.float32
    assert features.descriptors.shape == (count, extractor.descriptor_size)
    assert features.descriptors.dtype == extractor.descriptor_dtype
    assert features.colors_rgb.shape == (count, 3)
    assert features.colors_rgb.dtype == np.uint8
    assert (np.diff(features.scores) <= 0).all()
    assert (features.scales_px > 0).all()
    assert (features.keypoints_px >= 0).all()
    assert (features.keypoints_px <= np.array(image_size)).all()
    assert np.isfinite(features.descriptors.astype(np.float32)).all()
    if features.orientations_rad is not None:
        assert features.orientations_rad.shape == (count,)
        assert features.orientations_rad.dtype == np.float32
        assert (np.abs(features.orientations_rad) <= np.float32(np.pi)).all()


def test_a_textured_image_fills_the_budget(extractor: Extractor) -> None:
    features = extract_features(extractor, textured_image(400, 300), 1024, 100)
    _assert_valid(features, extractor, (400, 300), 100)
    assert len(features) == 100


def test_the_budget_keeps_the_best(extractor: Extractor) -> None:
    image = textured_image(400, 300)
    many, few = (extract_features(extractor, image, 1024, count) for count in (400, 50))
    np.testing.assert_allclose(few.keypoints_px[:25], many.keypoints_px[:25], atol=1e-3)


@pytest.mark.parametrize("value", [0, 128, 255])
def test_a_uniform_image_has_no_features(extractor: Extractor, value: int) -> None:
    features = extract_features(extractor, np.full((320, 480, 3), value, np.uint8), 1024, 100)
    _assert_valid(features, extractor, (480, 320), 100)
    assert len(features) == 0


@pytest.mark.parametrize("size", [(1, 1), (3, 200), (16, 16), (17, 33), (101, 67), (500, 16)])
def test_tiny_and_odd_sizes(extractor: Extractor, size: tuple[int, int]) -> None:
    _assert_valid(extract_features(extractor, textured_image(*size), 1024, 50), extractor, size, 50)


def test_no_budget_gives_nothing(extractor: Extractor) -> None:
    assert len(extract_features(extractor, textured_image(100, 100), 1024, 0)) == 0


def test_one_spot_on_a_plain_ground(extractor: Extractor) -> None:
    image = np.full((200, 200, 3), 90, np.uint8)
    image[96:104, 98:106] = 220
    features = extract_features(extractor, image, 1024, 1)
    _assert_valid(features, extractor, (200, 200), 1)
    assert len(features) == 0 or np.abs(features.keypoints_px - 101).max() < 25


def test_levels_beyond_what_it_takes_at_once(extractor: Extractor) -> None:
    assert extractor.tile_side_px > OVERLAP_PX
    assert extractor.largest_side_px is None or extractor.largest_side_px >= extractor.tile_side_px


def test_twice_the_same(extractor: Extractor) -> None:
    image = textured_image(333, 251)
    first, second = (extract_features(extractor, image, 1024, 200) for _ in range(2))
    for name in ("keypoints_px", "scores", "scales_px", "descriptors", "colors_rgb", "orientations_rad"):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))


def test_colours_are_those_of_the_image(extractor: Extractor) -> None:
    image = textured_image(400, 300)
    features = extract_features(extractor, image, 1024, 100)
    column, row = features.keypoints_px.astype(int).T
    np.testing.assert_array_equal(features.colors_rgb, image[row, column])


def test_a_level_reports_full_resolution_pixels(
    extractor: Extractor, with_trained_weights: Callable[[Any], None]
) -> None:
    """A wrong pixel origin shows as half a level pixel less half a full one: 0.5 px here, in both axes alike."""
    with_trained_weights(extractor)
    image = textured_image(768, 512, seed=3)
    fine = extract_features(extractor, image, 768, 800)
    coarse = extract_features(extractor, image, 384, 400)
    _assert_valid(coarse, extractor, (768, 512), 400)
    assert coarse.scales_px.min() >= 1.7 * fine.scales_px.min()
    offsets = nearest_offsets(coarse.keypoints_px, fine.keypoints_px, within_px=2)
    assert len(offsets) > 50
    limit_px = 0.05 if extractor.name in CENTRED else 0.6
    assert np.abs(np.median(offsets, axis=0)).max() < limit_px


def test_tiles_give_what_the_whole_gives(extractor: Extractor, with_trained_weights: Callable[[Any], None]) -> None:
    """Nearly: what a network sees of an image's far side, or of its statistics, differs between the two."""
    with_trained_weights(extractor)
    image = textured_image(704, 512, seed=6)
    whole = extractor.detect(image, 600)
    tiled = detect_in_tiles(extractor.detect, image, 448, 600)
    assert abs(len(tiled.scores) - len(whole.scores)) <= 60
    offsets = nearest_offsets(tiled.keypoints_px, whole.keypoints_px, within_px=0.5)
    assert len(offsets) > 0.8 * len(whole.scores)
    assert np.abs(np.median(offsets, axis=0)).max() < 0.02


def test_whole_pixel_shifts_move_keypoints_along(extractor: Extractor) -> None:
    image = textured_image(512, 384, seed=4)
    whole = extract_features(extractor, image, 1024, 400).keypoints_px
    part = extract_features(extractor, np.ascontiguousarray(image[32:, 64:]), 1024, 400).keypoints_px
    offsets = nearest_offsets(part + np.array([64, 32]), whole, within_px=1)
    assert len(offsets) > 100
    assert np.abs(np.median(offsets, axis=0)).max() < 0.05


def test_a_mirrored_image_has_mirrored_keypoints(extractor: Extractor) -> None:
    _only_centred(extractor)
    image = textured_image(401, 300, seed=5)
    straight = extract_features(extractor, image, 1024, 300).keypoints_px
    for axis, side in ((1, 401), (0, 300)):
        turned = extract_features(extractor, np.ascontiguousarray(np.flip(image, axis)), 1024, 300).keypoints_px
        turned[:, 1 - axis] = side - turned[:, 1 - axis]
        offsets = nearest_offsets(turned, straight, within_px=1)
        assert len(offsets) > 200
        assert np.abs(np.median(offsets, axis=0)).max() < 0.05


def test_orientations_turn_with_the_image(extractor: Extractor) -> None:
    """A quarter turn clockwise adds 90 degrees to angles from x towards y."""
    image = textured_image(400, 300, seed=7)
    straight = extract_features(extractor, image, 1024, 300)
    if straight.orientations_rad is None:
        pytest.skip(f"{extractor.name} detects no orientations")
    turned = extract_features(extractor, np.ascontiguousarray(np.rot90(image, -1)), 1024, 300)
    assert turned.orientations_rad is not None
    there = np.stack([300 - straight.keypoints_px[:, 1], straight.keypoints_px[:, 0]], 1)
    near = np.linalg.norm(there[:, None] - turned.keypoints_px[None], axis=2) < 0.5
    angles = turned.orientations_rad[None] - straight.orientations_rad[:, None] - np.pi / 2
    apart = np.where(near, np.abs(np.angle(np.exp(1j * angles))), np.inf).min(1)
    assert near.any(1).sum() > 200
    assert np.mean(apart[near.any(1)] < 0.1) > 0.9


@pytest.mark.parametrize("sigma_px", [1.5, 3.0])
def test_blobs_are_found_where_they_are(extractor: Extractor, sigma_px: float) -> None:
    _only_centred(extractor)
    image, centres = blobs_image(480, 360, sigma_px)
    features = extract_features(extractor, image, 1024, 1000)
    offsets = nearest_offsets(centres, features.keypoints_px, within_px=2)
    assert len(offsets) >= 0.95 * len(centres)
    assert np.abs(offsets.mean(axis=0)).max() < 0.05
    assert offsets.std(axis=0).max() < 0.1


def test_the_version_says_what_decides_the_result(extractor: Extractor) -> None:
    assert extractor.version() == extractor.version()
    assert extractor.version().startswith(extractor.name)


def _only_centred(extractor: Extractor) -> None:
    if extractor.name not in CENTRED:
        pytest.skip(f"{extractor.name} is trained to stand beside what it detects, always on the same side")
