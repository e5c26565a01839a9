"""What every global descriptor of the table must keep; the published ones with small random weights."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import torch
from synthetic import textured_image

from georef.errors import StageError
from georef.features.base import extract_features
from georef.features.globals import anyloc, efficientnet, netvlad, salad
from georef.features.globals.base import SIDE_PX
from georef.features.globals.efficientnet import EfficientNetLite
from georef.features.globals.vision_transformer import VitSize
from georef.features.registry import GLOBAL_DESCRIPTORS, load_component
from georef.features.sift import Sift
from georef.types.features import Features
from tests.worlds.global_weights import (
    dinov2_layout,
    dinov2_salad_layout,
    gem_layout,
    install,
    install_tensors,
    megaloc_layout,
    random_tensors,
    unpinned,
    write_netvlad,
)

SMALL = VitSize(48, 2, 4)
SMALL_GATED = VitSize(48, 3, 4, gated=True)
OPTIONS: dict[str, dict[str, Any]] = {"netvlad": {"size": 16}, "vlad": {"size": 32, "centres": 8}}
SQUARE = {"megaloc", "dinov2-salad", "anyloc"}
SIZES = [(1, 1), (3, 200), (161, 97), (97, 161)]  # width, height


@pytest.fixture(scope="module", autouse=True)
def local_weights(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """A cache of random weights for every descriptor that needs some, the transformers small."""
    folder = tmp_path_factory.mktemp("weights")
    with pytest.MonkeyPatch.context() as patch:
        unpinned(patch, folder / "cache")
        patch.setattr(salad, "VIT_B14", SMALL)
        patch.setattr(salad, "MEGALOC_SIZE", 64)
        patch.setattr(anyloc, "VIT_G14", SMALL_GATED)
        patch.setattr(anyloc, "LAYER", 1)
        with torch.device("meta"):
            lite = {key: tuple(value.shape) for key, value in EfficientNetLite().state_dict().items()}
        layouts = {
            "megaloc": megaloc_layout(48, 2, 64),
            "dinov2-salad": dinov2_salad_layout(48, 2),
            "dinov2-vitg14": dinov2_layout(48, 3, gated=True),
            "eigenplaces-resnet50-512": gem_layout("ResNet50", 512),
            "eigenplaces-resnet50-2048": gem_layout("ResNet50", 2048),
            "cosplace-resnet50-512": gem_layout("ResNet50", 512),
            "cosplace-resnet50-2048": gem_layout("ResNet50", 2048),
            efficientnet.WEIGHTS_NAME: lite,
        }
        for name, layout in layouts.items():
            install_tensors(name, random_tensors(layout), folder)
        install_tensors("anyloc-urban", torch.randn(32, 48, generator=torch.Generator().manual_seed(0)), folder)
        write_netvlad(folder / "net.mat", 16)
        install(netvlad.WEIGHTS_NAME, folder / "net.mat")
        yield


@pytest.fixture(scope="module", params=GLOBAL_DESCRIPTORS.names())
def descriptor(request: pytest.FixtureRequest, local_weights: None) -> Any:
    made = load_component(GLOBAL_DESCRIPTORS, request.param, **OPTIONS.get(request.param, {}))
    if hasattr(made, "learn"):
        images = [textured_image(320, 240, seed) for seed in range(4)]
        made = made.with_state(made.learn(images if made.needs == "pixels" else [local(image) for image in images]))
    return made


def local(image: np.ndarray) -> Features:
    return extract_features(Sift(), image, 1024, 200)


def describe(descriptor: Any, image: np.ndarray) -> np.ndarray:
    """With what it needs, and nothing else."""
    if descriptor.needs == "features":
        return descriptor.describe(None, local(image))
    return descriptor.describe(image, None)


@pytest.mark.parametrize("size", SIZES)
def test_any_size_has_a_unit_row(descriptor: Any, size: tuple[int, int]) -> None:
    row = describe(descriptor, textured_image(*size))
    assert row.shape == (descriptor.size,)
    assert row.dtype == np.float32
    assert np.linalg.norm(row) == pytest.approx(1, abs=1e-4)


@pytest.mark.parametrize("value", [0, 128, 255])
def test_a_uniform_image_has_a_unit_row(descriptor: Any, value: int) -> None:
    row = describe(descriptor, np.full((120, 160, 3), value, np.uint8))
    assert np.isfinite(row).all()
    assert np.linalg.norm(row) == pytest.approx(1, abs=1e-4)


def test_twice_the_same(descriptor: Any) -> None:
    image = textured_image(200, 150)
    np.testing.assert_array_equal(describe(descriptor, image), describe(descriptor, image))


def test_different_images_differ(descriptor: Any) -> None:
    first, second = (describe(descriptor, textured_image(200, 150, seed)) for seed in (1, 2))
    assert first @ second < 1 - 1e-6


def test_many_at_once_are_as_one_by_one(descriptor: Any) -> None:
    if not hasattr(descriptor, "describe_many"):
        pytest.skip(f"{descriptor.name} describes images one at a time")
    images = [textured_image(*size, seed=i) for i, size in enumerate([(200, 150), (150, 200), (200, 150), (64, 64)])]
    rows = descriptor.describe_many(images)
    assert rows.shape == (4, descriptor.size)
    np.testing.assert_allclose(rows, [describe(descriptor, image) for image in images], atol=2e-5)
    assert descriptor.describe_many([]).shape == (0, descriptor.size)


def test_the_network_sees_the_stated_size(descriptor: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    if descriptor.needs != "pixels":
        pytest.skip(f"{descriptor.name} does not look at pixels")
    inner = descriptor if hasattr(descriptor, "_network") else descriptor._rows
    for (width, height), expected in {(800, 400): (161, 322), (400, 800): (322, 161), (90, 60): (215, 322)}.items():
        pixels = inner._prepare(textured_image(width, height))
        assert tuple(pixels.shape[1:]) == ((SIDE_PX, SIDE_PX) if descriptor.name in SQUARE else expected)
        assert pixels.dtype == torch.float32
        assert 0 <= float(pixels.min()) < float(pixels.max()) <= 1


def test_what_it_needs_is_asked_for(descriptor: Any) -> None:
    with pytest.raises(ValueError, match="expected"):
        descriptor.describe(None, None)
    if descriptor.needs == "pixels":
        for wrong in (np.zeros((5, 5), np.uint8), np.zeros((5, 5, 3), np.float32), np.zeros((0, 5, 3), np.uint8)):
            with pytest.raises(ValueError, match="expected"):
                descriptor.describe(wrong, None)


def test_the_version_says_what_decides_the_result(descriptor: Any) -> None:
    assert descriptor.version() == descriptor.version()
    assert descriptor.version().startswith(descriptor.name)


def test_what_learns_says_so_before(descriptor: Any) -> None:
    if not hasattr(descriptor, "learn"):
        pytest.skip(f"{descriptor.name} has nothing to learn")
    fresh = load_component(GLOBAL_DESCRIPTORS, descriptor.name, **OPTIONS.get(descriptor.name, {}))
    assert fresh.version() != descriptor.version()
    with pytest.raises(StageError, match="learned nothing yet"):
        describe(fresh, textured_image(100, 80))


def test_devices_agree(descriptor: Any) -> None:
    if descriptor.needs == "features" or hasattr(descriptor, "learn"):
        pytest.skip(f"{descriptor.name} is learned, and networks are tested in the others")
    if not torch.cuda.is_available():
        pytest.skip("no GPU here")
    there = load_component(GLOBAL_DESCRIPTORS, descriptor.name, device="auto", **OPTIONS.get(descriptor.name, {}))
    assert "device=cuda" in there.version()
    image = textured_image(200, 150)
    assert describe(there, image) @ describe(descriptor, image) > 1 - 1e-3
