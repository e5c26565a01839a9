"""Published networks: layouts and counts as their authors have them, loading, and what each of them computes."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import nn

from georef.errors import ConfigError, WeightsError
from georef.features.globals import salad
from georef.features.globals.anyloc import hard_vlad, load_centres
from georef.features.globals.cosplace import Gem, GemNetwork
from georef.features.globals.efficientnet import EfficientNetLite
from georef.features.globals.loading import build, tensors_of
from georef.features.globals.netvlad import matlab_tensors, netvlad, vgg16_trunk
from georef.features.globals.salad import transport
from georef.features.globals.vision_transformer import VIT_B14, VIT_G14, VisionTransformer, VitSize
from georef.features.registry import GLOBAL_DESCRIPTORS, load_component
from tests.worlds.global_weights import (
    Layout,
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

CASES: list[tuple[str, Callable[[], nn.Module], Layout, int]] = [
    # parameters as published: DINOv2's model card (86 M, 1,100 M), SALAD's paper (88 M), MegaLoc's card (228.6 M)
    ("ViT-B/14", lambda: VisionTransformer(VIT_B14), dinov2_layout(), 86_580_480),
    ("ViT-g/14", lambda: VisionTransformer(VIT_G14), dinov2_layout(1536, 40, gated=True), 1_136_480_768),
    ("SALAD", salad._SaladNetwork, dinov2_salad_layout(), 87_991_489),
    ("MegaLoc", salad._MegaLocNetwork, megaloc_layout(), 228_640_321),
    # torchvision's counts less the classifier: ResNet-18 11,689,512 - 513,000; ResNet-50 25,557,032 - 2,049,000
    ("ResNet18-512", partial(GemNetwork, "ResNet18", 512), gem_layout("ResNet18", 512), 11_176_512 + 1 + 262_656),
    ("ResNet50-512", partial(GemNetwork, "ResNet50", 512), gem_layout("ResNet50", 512), 23_508_032 + 1 + 1_049_088),
    ("ResNet50-2048", partial(GemNetwork, "ResNet50", 2048), gem_layout("ResNet50", 2048), 23_508_032 + 1 + 4_196_352),
]


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    unpinned(monkeypatch, tmp_path / "cache")
    return tmp_path


@pytest.mark.parametrize(("make", "layout", "parameters"), [case[1:] for case in CASES], ids=[c[0] for c in CASES])
def test_the_layout_is_the_published_one(make: Callable[[], nn.Module], layout: Layout, parameters: int) -> None:
    with torch.device("meta"):
        module = make()
    assert {key: tuple(value.shape) for key, value in module.state_dict().items()} == layout
    assert sum(p.numel() for p in module.parameters()) == parameters


def test_other_published_counts() -> None:
    with torch.device("meta"):
        assert sum(p.numel() for p in EfficientNetLite().parameters()) == 4_652_008
        assert sum(p.numel() for p in vgg16_trunk().parameters()) == 14_714_688


@pytest.mark.parametrize(
    ("descriptor", "weights", "layout", "size"),
    [
        ("dinov2-salad", "dinov2-salad", dinov2_salad_layout(), 8448),
        ("eigenplaces-2048", "eigenplaces-resnet50-2048", gem_layout("ResNet50", 2048), 2048),
        ("cosplace-512", "cosplace-resnet50-512", gem_layout("ResNet50", 512), 512),
    ],
)
def test_a_file_of_full_size_is_loaded_and_describes(
    cache: Path, descriptor: str, weights: str, layout: Layout, size: int
) -> None:
    install_tensors(weights, random_tensors(layout), cache)
    loaded = load_component(GLOBAL_DESCRIPTORS, descriptor)
    image = np.random.default_rng(0).integers(0, 256, (120, 200, 3), np.uint8)
    row = loaded.describe(image, None)
    assert (loaded.name, loaded.size, row.shape, row.dtype) == (descriptor, size, (size,), np.float32)
    assert np.linalg.norm(row) == pytest.approx(1, abs=1e-5)
    assert "weights=" in loaded.version()


def test_a_training_checkpoint_is_opened(cache: Path) -> None:
    tensors = random_tensors({"a.weight": (2, 3)})
    install_tensors("dinov2-salad", {"epoch": 3, "state_dict": tensors}, cache)
    assert list(tensors_of("dinov2-salad")) == ["a.weight"]


def test_a_file_that_is_no_table_of_tensors_is_refused(cache: Path) -> None:
    install_tensors("dinov2-salad", [1, 2, 3], cache)
    with pytest.raises(WeightsError, match="not a table of tensors, but list"):
        load_component(GLOBAL_DESCRIPTORS, "dinov2-salad")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t: t.pop("aggregation.3.bias"), "missing: aggregation.3.bias"),
        (lambda t: t.update({"head.weight": torch.zeros(1)}), "left over: head.weight"),
        (lambda t: t.update({"aggregation.1.p": torch.zeros(2)}), r"aggregation.1.p \(2,\) instead of \(1,\)"),
    ],
)
def test_tensors_that_do_not_fit_are_named(cache: Path, change: Callable[[dict], object], message: str) -> None:
    tensors = random_tensors(gem_layout("ResNet18", 512))
    change(tensors)
    install_tensors("eigenplaces-resnet18-512", tensors, cache)
    with pytest.raises(WeightsError, match=message):
        load_component(GLOBAL_DESCRIPTORS, "eigenplaces-512", backbone="ResNet18")


def test_weights_that_are_not_there_say_how_to_get_them(cache: Path) -> None:
    with pytest.raises(WeightsError, match=r"georef weights fetch megaloc --accept-licence"):
        load_component(GLOBAL_DESCRIPTORS, "megaloc")


def test_an_unknown_backbone_is_refused() -> None:
    with pytest.raises(ConfigError, match="ResNet34"):
        load_component(GLOBAL_DESCRIPTORS, "cosplace-512", backbone="ResNet34")


def test_netvlad_comes_from_the_matlab_file(cache: Path) -> None:
    arrays = write_netvlad(cache / "net.mat", size=24)
    tensors = matlab_tensors(cache / "net.mat")
    assert tensors["backbone.5.weight"].shape == (128, 64, 3, 3)
    np.testing.assert_array_equal(tensors["backbone.5.weight"][7, 3, 0, 2], arrays["5"][0, 2, 3, 7])
    np.testing.assert_array_equal(tensors["netvlad.score_proj.weight"][9, 11, 0], arrays["scores"][11, 9])
    np.testing.assert_array_equal(tensors["netvlad.centers"], -arrays["centres"])
    np.testing.assert_array_equal(tensors["whiten.weight"], arrays["whitening"][0, 0].T)
    np.testing.assert_allclose(tensors["mean"], [123.7, 116.8, 103.9])
    install("netvlad-pitts30k", cache / "net.mat")
    image = np.random.default_rng(0).integers(0, 256, (90, 70, 3), np.uint8)
    whole, part = (netvlad(size=size).describe(image, None) for size in (24, 16))
    np.testing.assert_allclose(part, whole[:16] / np.linalg.norm(whole[:16]), atol=1e-6)


def test_netvlad_refuses_more_than_the_file_has_and_other_files(cache: Path) -> None:
    write_netvlad(cache / "net.mat", size=24)
    install("netvlad-pitts30k", cache / "net.mat")
    with pytest.raises(WeightsError, match=r"\(24, 32768\) instead of \(4096, 32768\)"):
        netvlad()
    (cache / "bad.mat").write_bytes(b"not a Matlab file at all, but long enough to be looked at" * 10)
    with pytest.raises(WeightsError, match="not the exported NetVLAD network"):
        matlab_tensors(cache / "bad.mat")


def test_centres_of_another_shape_are_refused(cache: Path) -> None:
    install_tensors("anyloc-urban", torch.zeros(32, 10), cache)
    with pytest.raises(WeightsError, match=r"\(32, 10\), expected a tensor \(32, 1536\)"):
        load_centres("anyloc-urban", 1536)


def test_attention_is_that_of_the_library() -> None:
    """One block against torch's own multi-head attention with the same weights."""
    size = VitSize(48, 1, 4)
    model = build(lambda: VisionTransformer(size), random_tensors(dinov2_layout(48, 1)), "test")
    block: Any = model.blocks[0]
    x = torch.randn(2, 7, 48, generator=torch.Generator().manual_seed(1))
    reference = nn.MultiheadAttention(48, 4, batch_first=True)
    reference.load_state_dict(
        {
            "in_proj_weight": block.attn.qkv.weight,
            "in_proj_bias": block.attn.qkv.bias,
            "out_proj.weight": block.attn.proj.weight,
            "out_proj.bias": block.attn.proj.bias,
        }
    )
    torch.testing.assert_close(block.attn(x), reference(x, x, x)[0], atol=1e-5, rtol=1e-5)


def test_values_are_the_last_third_of_the_chosen_block() -> None:
    size = VitSize(48, 3, 4)
    model = build(lambda: VisionTransformer(size), random_tensors(dinov2_layout(48, 3)), "test")
    image = torch.rand(1, 3, 28, 42, generator=torch.Generator().manual_seed(2))
    caught: list[torch.Tensor] = []
    block: Any = model.blocks[1]
    handle = block.attn.qkv.register_forward_hook(lambda _m, _i, out: caught.append(out))
    features, token = model(image)
    handle.remove()
    assert features.shape == (1, 48, 2, 3)
    assert token.shape == (1, 48)
    torch.testing.assert_close(model.values(image, 1), caught[0][:, 1:, 96:])


def test_positions_of_the_trained_grid_are_taken_as_they_are() -> None:
    model = build(lambda: VisionTransformer(VitSize(48, 0, 4)), random_tensors(dinov2_layout(48, 0)), "test")
    grid = model._positions(37, 37)
    torch.testing.assert_close(grid[0, :, 3, 5], model.pos_embed[0, 1 + 3 * 37 + 5])
    smooth = torch.linspace(0, 1, 37)[None, :, None].expand(37, 37, 48).reshape(1, -1, 48)
    model.pos_embed = nn.Parameter(torch.cat([torch.zeros(1, 1, 48), smooth], 1))
    resized = model._positions(23, 30)
    assert resized.shape == (1, 48, 23, 30)
    torch.testing.assert_close(resized[0, 0, 5, 1:-1].diff(), torch.full((27,), 37 / 30.1 / 36), atol=3e-3, rtol=0)


def test_transport_is_sinkhorns() -> None:
    """Against the plain iteration on probabilities, each patch's shares in clusters and bin summing to one."""
    scores = torch.randn(2, 4, 9, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    kernel = np.exp(np.concatenate([scores.numpy(), np.full((2, 1, 9), 0.7)], 1))
    plan = kernel / (4 + 9)
    rows = np.array([1.0] * 4 + [5.0])[:, None]
    for _ in range(3):
        plan = plan * rows / plan.sum(2, keepdims=True)
        plan = plan / plan.sum(1, keepdims=True)
    found = transport(scores, torch.tensor(0.7, dtype=torch.float64)).numpy()
    np.testing.assert_allclose(found, plan[:, :4], rtol=1e-10)


def test_generalised_mean_lies_between_mean_and_maximum() -> None:
    x = torch.rand(2, 5, 4, 6, generator=torch.Generator().manual_seed(4))
    expected = (x.double() ** 3).mean((2, 3)) ** (1 / 3)
    torch.testing.assert_close(Gem()(x).double(), expected, atol=1e-6, rtol=1e-5)
    assert (Gem()(x) > x.mean((2, 3))).all()
    assert (Gem()(x) < x.amax((2, 3))).all()


def test_hard_vlad_is_the_sum_of_residuals() -> None:
    generator = torch.Generator().manual_seed(5)
    rows = nn.functional.normalize(torch.randn(1, 20, 6, generator=generator), dim=-1)
    centres = torch.randn(3, 6, generator=generator)
    expected = torch.zeros(3, 6)
    for row in rows[0]:
        k = int(torch.stack([torch.cosine_similarity(row, c, dim=0) for c in centres]).argmax())
        expected[k] += row - centres[k]
    expected = nn.functional.normalize(nn.functional.normalize(expected, dim=1).flatten(), dim=0)
    torch.testing.assert_close(hard_vlad(rows, centres)[0], expected)


@pytest.mark.accuracy
def test_efficientnet_sees_a_palace(georef_data: Path) -> None:
    """The real weights tell what the castle's photographs show: class 698 of ImageNet."""
    from georef.features.globals.base import square_input
    from georef.features.images import read_image

    try:
        network = build(EfficientNetLite, tensors_of("efficientnet-lite0"), "efficientnet-lite0")
    except WeightsError as error:
        pytest.skip(str(error).splitlines()[0])
    image = read_image(georef_data / "castle" / "new_epoch" / "b0001.jpg")
    scores = network.classify(square_input(image, 224)[None]).softmax(1)[0]
    assert int(scores.argmax()) == 698
    assert float(scores[698]) > 0.5
