"""SIFT's scales and orientations, and the matcher that looks at them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
import torch
from scipy.spatial import KDTree

from georef.features.base import extract_features
from georef.features.lightglue import LightGlueSift
from georef.features.lightglue_network import _current_name
from georef.features.sift import Sift
from georef.types.features import Features
from tests.contracts.made_weights import lightglue_weights, put_into_cache
from tests.contracts.synthetic import textured_image


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("made")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("GEOREF_CACHE", str(folder / "cache"))
        put_into_cache(folder, ["sift_lightglue"])
    return folder / "cache"


@pytest.fixture
def matcher(cache: Path, monkeypatch: pytest.MonkeyPatch) -> LightGlueSift:
    monkeypatch.setenv("GEOREF_CACHE", str(cache))
    return LightGlueSift(precision="float32", min_score=0.0)


def _sift(count: int, seed: int = 0) -> Features:
    found = extract_features(Sift(), textured_image(640, 480, seed), 640, count)
    assert len(found) == count
    return found


def _turns(features: Features) -> np.ndarray:
    assert features.orientations_rad is not None
    return features.orientations_rad


def test_scales_orientations_and_descriptors_are_colmaps() -> None:
    """LightGlue was trained with COLMAP's, whose histograms of directions are other ones: 0.05 rad in the median."""
    image = textured_image(640, 480, seed=1)
    options = pycolmap.FeatureExtractionOptions()
    options.use_gpu = False
    options.sift.normalization = pycolmap.Normalization.L2
    keypoints, descriptors = pycolmap.FeatureExtractor.create(options, pycolmap.Device.cpu).extract_from_uint8_array(
        np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))
    )
    ours = extract_features(Sift(), image, 640, 4000)
    theirs = np.array([(k.x, k.y, k.compute_scale(), k.compute_orientation()) for k in keypoints])
    rows = np.asarray(descriptors.data, np.float64)
    near = KDTree(ours.keypoints_px).query_ball_point(theirs[:, :2], 0.2)
    angle = [np.abs(np.angle(np.exp(1j * (_turns(ours)[i] - t)))) for i, t in zip(near, theirs[:, 3], strict=True)]
    pairs = np.array([(i[a.argmin()], k) for k, (i, a) in enumerate(zip(near, angle, strict=True)) if len(i)])
    apart = np.array([a.min() for a in angle if len(a)])
    assert len(pairs) > 1500
    assert np.mean(apart < 0.1) > 0.65  # a wrong sign or origin: 0.05
    ratio = ours.scales_px[pairs[:, 0]] / theirs[pairs[:, 1], 2]
    assert np.median(np.abs(np.log(ratio))) < 0.001
    root = ours.descriptors[pairs[:, 0]].astype(float) ** 2
    cosine = (
        (root * rows[pairs[:, 1]]).sum(1) / np.linalg.norm(root, axis=1) / np.linalg.norm(rows[pairs[:, 1]], axis=1)
    )
    assert np.median(cosine[apart < 0.1]) > 0.99


def test_the_matcher_equals_kornias(matcher: LightGlueSift) -> None:
    from kornia.feature.lightglue import LightGlue

    reference = LightGlue(
        features=None,  # pyright: ignore[reportArgumentType]
        input_dim=128,
        add_scale_ori=True,
        depth_confidence=-1,
        width_confidence=-1,
    ).eval()
    renamed = {_current_name(key): tensor for key, tensor in lightglue_weights(descriptor_size=128, places=4).items()}
    assert reference.load_state_dict(renamed, strict=False).missing_keys == ["confidence_thresholds"]
    pair = [_one_a_place(_sift(300, seed)) for seed in (0, 1)]
    pair[1] = pair[1].head(len(pair[1]) - 7)
    data = {f"image{i}": _kornias(features) for i, features in enumerate(pair)}
    with torch.inference_mode():
        expected = reference(data)
        found = matcher._network.log_assignment(*matcher._inputs(pair[0]), *matcher._inputs(pair[1]))
    torch.testing.assert_close(found, expected["log_assignment"][0, :-1, :-1], atol=5e-3, rtol=1e-3)
    assert found.std() > 0.1


def _one_a_place(features: Features) -> Features:
    return features.take(np.sort(np.unique(features.keypoints_px, axis=0, return_index=True)[1]))


def _kornias(features: Features) -> dict[str, torch.Tensor]:
    """Of an image of 640 px: the network was trained with images of 1024 px, whose pixels are 640/1024 of these."""
    rows = torch.nn.functional.normalize(torch.from_numpy(features.descriptors.astype(np.float32)), dim=1)
    return {
        "keypoints": torch.from_numpy(features.keypoints_px)[None],
        "scales": torch.from_numpy(features.scales_px)[None] * 1024 / 640,
        "oris": torch.from_numpy(_turns(features))[None],
        "descriptors": rows[None],
        "image_size": torch.tensor([[640, 480]]),
    }


def test_full_resolution_does_not_count(matcher: LightGlueSift) -> None:
    features = _sift(100)
    larger = replace(
        features,
        image_size=(2560, 1920),
        keypoints_px=4 * features.keypoints_px,
        scales_px=4 * features.scales_px,
    )
    torch.testing.assert_close(matcher._inputs(larger), matcher._inputs(features))


def test_one_orientation_a_place_is_matched(matcher: LightGlueSift) -> None:
    """The one nearest to zero, wherever it stands; indices are those of all features."""
    single, other = _one_a_place(_sift(200)), _one_a_place(_sift(200, seed=1))
    single = replace(single, orientations_rad=np.linspace(-1, 1, len(single)).astype(np.float32))
    twice = single.take(np.repeat(np.arange(len(single)), 2))
    turns = _turns(twice).copy()
    worse = np.arange(len(single)) * 2 + np.random.default_rng(0).integers(0, 2, len(single))
    turns[worse] = np.where(turns[worse] > 0, -3.0, 3.0)
    twice = replace(twice, orientations_rad=turns)
    better = np.setdiff1d(np.arange(len(twice)), worse)
    alone, found = matcher.match(single, other), matcher.match(twice, other)
    assert len(alone) > 3
    np.testing.assert_array_equal(found.indices[:, 0], better[alone.indices[:, 0]])
    np.testing.assert_array_equal(found.indices[:, 1], alone.indices[:, 1])
    turned = matcher.match(other, twice)
    assert set(turned.indices[:, 1]) <= set(better)


def test_the_budget_counts_places(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GEOREF_CACHE", str(cache))
    few = LightGlueSift(max_keypoints=50, precision="float32", min_score=0.0)
    features, other = _one_a_place(_sift(200)), _one_a_place(_sift(200, seed=1))
    twice = features.take(np.repeat(np.arange(len(features)), 2))
    found, expected = few.match(twice, other), few.match(features.head(50), other.head(50))
    np.testing.assert_array_equal(found.indices, expected.indices * [2, 1])


def test_features_without_orientations_are_refused(matcher: LightGlueSift) -> None:
    features = replace(_sift(10), orientations_rad=None)
    with pytest.raises(ValueError, match="with orientations"):
        matcher.match(features, _sift(10))
