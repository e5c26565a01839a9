"""The rewritten passes through ALIKED and LightGlue against kornia's modules with the same weights."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest
import torch

from georef.errors import WeightsError
from georef.features.aliked_network import AlikedNetwork
from georef.features.disk_network import DiskNetwork
from georef.features.lightglue_network import LightGlueNetwork, _current_name
from georef.features.peaks import find_peaks, pixels_of, strict_maxima
from georef.features.weights import load_state_dict
from georef.features.xfeat_network import XFeatNetwork, sample_cells

CPU = torch.device("cpu")


def _weights(name: str) -> dict[str, Any]:
    try:
        return load_state_dict(name)
    except WeightsError as error:
        pytest.skip(f"weights are not in the cache: {str(error).splitlines()[0]}")


def _texture(width: int, height: int, seed: int = 0) -> torch.Tensor:
    noise = np.random.default_rng(seed).normal(size=(height, width, 3)).astype(np.float32)
    smooth = sum(scale * cv2.GaussianBlur(noise, (0, 0), scale) for scale in (1.0, 2.0, 5.0, 12.0))
    return torch.from_numpy(np.clip(0.5 + 0.4 * np.asarray(smooth), 0, 1)).permute(2, 0, 1).float()


@pytest.mark.parametrize("size", [(320, 256), (333, 251), (70, 40)])
@pytest.mark.parametrize("model", ["aliked-n16", "aliked-n16rot", "aliked-n32"])
def test_aliked_equals_kornias(model: str, size: tuple[int, int]) -> None:
    from kornia.feature.aliked.aliked import ALIKED

    weights, image = _weights(model), _texture(*size)
    reference = ALIKED(model, max_num_keypoints=500, detection_threshold=0.0)
    assert reference.load_state_dict(weights, strict=False).missing_keys == ["dkd.hw_grid"]
    with torch.inference_mode():
        expected = reference.eval()(image[None])[0]
        network = AlikedNetwork(weights, CPU)
        levels, score_map = network.dense(image)
        keypoints, scores = find_peaks(score_map, 0.0, 500)
        descriptors = network.describe(levels, keypoints)
    assert score_map.shape == (size[1], size[0])
    assert len(keypoints) == expected.n > 0
    distance, index = torch.cdist(keypoints.double(), expected.keypoints.double()).min(1)
    assert len(index.unique()) == len(index)
    assert distance.max() < 1e-3
    torch.testing.assert_close(scores, expected.keypoint_scores[index], atol=1e-4, rtol=0)
    torch.testing.assert_close(descriptors, expected.descriptors[index], atol=1e-4, rtol=0)


def _score_map(peaks: np.ndarray, width: int = 90, height: int = 61) -> torch.Tensor:
    x, y = np.meshgrid(np.arange(width), np.arange(height))
    values = [0.9 * np.exp(-((x - px) ** 2 + (y - py) ** 2) / (2 * 0.7**2)) for px, py in peaks]
    return torch.from_numpy(np.max(values, axis=0)).float()


def test_peaks_are_placed_within_the_pixel() -> None:
    """In the network's pixels, the top-left one's centre at (0, 0); the extractor adds the half."""
    columns, rows = np.meshgrid(np.arange(8, 82, 9), np.arange(8, 53, 9))
    peaks = np.stack([columns.ravel(), rows.ravel()], 1) + np.random.default_rng(0).uniform(
        -0.4, 0.4, (columns.size, 2)
    )
    keypoints, scores = find_peaks(_score_map(peaks), 0.3, 1000)
    distance, _ = torch.cdist(torch.from_numpy(peaks).float(), keypoints).min(1)
    assert len(keypoints) == len(peaks)
    assert distance.max() < 0.35  # the soft maximum leans towards the middle of the pixel
    assert np.abs(keypoints.numpy().mean(0) - peaks.mean(0)).max() < 0.03
    assert (scores > 0.3).all()


@pytest.mark.parametrize("axis", [0, 1])
def test_a_mirrored_score_map_has_mirrored_peaks(axis: int) -> None:
    score_map = torch.sigmoid(3 * (_texture(91, 60)[0] - 0.5))
    straight, _ = find_peaks(score_map, 0.1, 500)
    turned, _ = find_peaks(score_map.flip(axis), 0.1, 500)
    turned[:, 1 - axis] = score_map.shape[axis] - 1 - turned[:, 1 - axis]
    assert len(straight) == len(turned) > 20
    assert torch.cdist(straight.double(), turned.double()).min(1).values.max() < 1e-4


def test_peaks_of_flat_and_small_maps() -> None:
    assert len(find_peaks(torch.full((30, 40), 0.5), 0.1, 10)[0]) == 0
    assert len(find_peaks(torch.rand(4, 40), 0.1, 10)[0]) == 0
    assert len(find_peaks(_score_map(np.array([[20, 20], [50, 20], [70, 40]])), 0.1, 2)[0]) == 2


@pytest.mark.parametrize("name", ["aliked_lightglue", "disk_lightglue", "xfeat-lighterglue"])
def test_lightglue_equals_kornias(name: str) -> None:
    from kornia.feature.lightglue import LightGlue, filter_matches

    weights, lighter = _weights(name), "lighter" in name
    shape = {"descriptor_dim": 96, "n_layers": 6, "num_heads": 1} if lighter else {}
    reference = LightGlue(
        features=None,  # pyright: ignore[reportArgumentType]
        input_dim=64 if lighter else 128,
        depth_confidence=-1,
        width_confidence=-1,
        **shape,
    ).eval()
    renamed = {_current_name(key): tensor for key, tensor in weights.items()}
    assert reference.load_state_dict(renamed, strict=False).missing_keys == ["confidence_thresholds"]
    generator = torch.Generator().manual_seed(0)
    size = torch.tensor([[640, 480]])
    keypoints = torch.rand((300, 2), generator=generator) * size
    rows = torch.nn.functional.normalize(torch.randn((300, 64 if lighter else 128), generator=generator), dim=1)
    other_keypoints, other_rows = keypoints.flip(0)[:250] + 0.5, rows.flip(0)[:250]
    other_rows = torch.nn.functional.normalize(other_rows + 0.03 * torch.randn(other_rows.shape, generator=generator))
    images = [(keypoints, rows), (other_keypoints.clamp(max=640), other_rows)]
    data = {
        f"image{i}": {"keypoints": k[None], "descriptors": r[None], "image_size": size}
        for i, (k, r) in enumerate(images)
    }
    with torch.inference_mode():
        expected = reference(data)
        network = LightGlueNetwork(weights, dtype=torch.float32, device=CPU)
        (places_a, rows_a), (places_b, rows_b) = (((k - size / 2) / 320, r) for k, r in images)
        log_scores = network.log_assignment(places_a, rows_a, places_b, rows_b)
    torch.testing.assert_close(log_scores, expected["log_assignment"][0, :-1, :-1], atol=5e-3, rtol=1e-3)
    padded = torch.nn.functional.pad(log_scores, (0, 1, 0, 1))[None]
    assert (filter_matches(padded, 0.1)[0] == expected["matches0"]).all()
    assert (expected["matches0"] >= 0).sum() > (40 if lighter else 200)  # random descriptors suit none of them


def test_older_names_of_lightglues_layers_are_understood() -> None:
    weights = _weights("aliked_lightglue")
    older = {}
    for key, tensor in weights.items():
        parts = key.split(".")
        named = parts[0] == "transformers"
        older[".".join([parts[2], parts[1], *parts[3:]]) if named else key] = tensor
    assert any(key.startswith("self_attn.0.") for key in older)
    LightGlueNetwork(older, dtype=torch.float32, device=CPU)


@pytest.mark.parametrize("size", [(320, 256), (333, 251), (70, 40), (96, 200)])
def test_disk_equals_kornias(size: tuple[int, int]) -> None:
    from kornia.feature import DISK

    weights, image = _weights("disk-depth-save")["extractor"], _texture(*size)
    reference = DISK().eval()
    reference.load_state_dict(weights)
    with torch.inference_mode():
        expected = reference(image[None], n=500, pad_if_not_divisible=True)[0]
        network = DiskNetwork(weights, CPU)
        features, score_map = network.dense(image)
        index = strict_maxima(score_map, 0.0, 500)
        order = index.argsort()
        descriptors = network.describe(features, pixels_of(index[order], size[0]))
    assert score_map.shape == (size[1], size[0])
    assert len(index) == expected.n > 0
    torch.testing.assert_close(pixels_of(index[order], size[0]), expected.keypoints)
    torch.testing.assert_close(score_map.reshape(-1)[index[order]], expected.detection_scores, atol=2e-3, rtol=1e-3)
    torch.testing.assert_close(descriptors, expected.descriptors, atol=1e-3, rtol=0)


@pytest.mark.parametrize("size", [(320, 256), (96, 64)])
def test_xfeat_equals_kornias(size: tuple[int, int]) -> None:
    from kornia.feature.xfeat import XFeat

    weights, image = _weights("xfeat"), _texture(*size)
    reference = XFeat(top_k=300, detection_threshold=0.0).eval()
    reference.net.load_state_dict(weights)
    with torch.inference_mode():
        expected_cells, _, expected_reliability = reference.net(image[None])
        expected = reference.detectAndCompute(image[None])[0]
        network = XFeatNetwork(weights, CPU)
        cells, reliability, score_map = network.dense(image)
        index = strict_maxima(score_map, 0.0, score_map.numel())
        whole = pixels_of(index, size[0])
        scores = score_map.reshape(-1)[index] * sample_cells(reliability, whole, "bilinear")[:, 0]
        descriptors = torch.nn.functional.normalize(sample_cells(cells, whole, "bicubic"))
    assert score_map.shape == (size[1], size[0])
    torch.testing.assert_close(cells, torch.nn.functional.normalize(expected_cells, dim=1), atol=1e-4, rtol=0)
    torch.testing.assert_close(reliability, expected_reliability, atol=1e-4, rtol=0)
    distance, nearest = torch.cdist(expected["keypoints"].double(), whole.double()).min(1)
    assert len(nearest) >= min(300, len(index))
    assert distance.max() == 0
    torch.testing.assert_close(descriptors[nearest], expected["descriptors"], atol=1e-3, rtol=0)
    # its way to look a score up misses the pixel by one now and then
    assert (scores[nearest] - expected["scores"]).abs().median() < 1e-6


def test_xfeat_fills_odd_sides_up() -> None:
    network = XFeatNetwork(_weights("xfeat"), CPU)
    cells, reliability, score_map = network.dense(_texture(333, 251))
    assert score_map.shape == (251, 333)
    assert cells.shape[2:] == reliability.shape[2:] == (32, 44)
