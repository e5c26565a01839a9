"""SuperPoint and RDD with weights made here, against the same layers written out the long way."""

from __future__ import annotations

import cv2
import numpy as np
import torch
from torch.nn import functional as F

from georef.features.folding import fold
from georef.features.peaks import pixels_of
from georef.features.rdd_network import RddNetwork, _encoding
from georef.features.superpoint import SuperPointNetwork, describe
from tests.contracts.made_weights import Maker, rdd_weights, superpoint_weights

CPU = torch.device("cpu")


def _image(width: int, height: int) -> torch.Tensor:
    noise = np.random.default_rng(0).random((height, width, 3)).astype(np.float32)
    return torch.from_numpy(cv2.GaussianBlur(noise, (0, 0), 1.5)).permute(2, 0, 1)


def test_superpoint_equals_its_layers_written_out() -> None:
    weights, image = superpoint_weights(), _image(64, 48)

    def conv(name: str, x: torch.Tensor) -> torch.Tensor:
        weight = weights[f"{name}.weight"]
        return F.conv2d(x, weight, weights[f"{name}.bias"], padding=weight.shape[-1] // 2)

    x = (0.299 * image[0] + 0.587 * image[1] + 0.114 * image[2])[None, None]
    for level in (1, 2, 3, 4):
        x = conv(f"conv{level}b", conv(f"conv{level}a", x).relu()).relu()
        x = F.max_pool2d(x, 2) if level < 4 else x
    scores = conv("convPb", conv("convPa", x).relu()).softmax(1)[0, :64]  # (row x 8 + column in the cell, h, w)
    expected = scores.reshape(8, 8, 6, 8).permute(2, 0, 3, 1).reshape(48, 64)
    cells, score_map = SuperPointNetwork(weights, CPU).dense(image)
    torch.testing.assert_close(score_map, expected)
    torch.testing.assert_close(cells, F.normalize(conv("convDb", conv("convDa", x).relu()), dim=1))


def test_superpoints_descriptors_come_from_the_middle_of_cells() -> None:
    """A ramp over the cells, read between the centres of first and last: (8 i + 3.5) is the middle of cell i."""
    ramp = torch.stack([torch.arange(8.0).expand(6, 8), 10 * torch.ones(6, 8)])[None]
    found = describe(ramp, torch.tensor([[3.5, 3.5], [30.0, 20.0]]))
    place = found[:, 0] / found[:, 1] * 10
    torch.testing.assert_close(place, torch.tensor([0.0, 26.5 / 59.5 * 7]), atol=1e-4, rtol=0)


def test_folded_normalisation_does_what_the_two_layers_do() -> None:
    maker = Maker()
    maker.conv("conv1", 5, 3, 3, bias=False)
    maker.norm("bn1", 5, statistics=True)
    made, image = maker.made, _image(20, 16)[None]
    x = F.conv2d(image, made["conv1.weight"])
    statistics = (made["bn1.running_mean"], made["bn1.running_var"], made["bn1.weight"], made["bn1.bias"])
    folded = fold(made, "conv1", "bn1")
    torch.testing.assert_close(
        F.conv2d(image, folded["conv1.weight"], folded["conv1.bias"]), F.batch_norm(x, *statistics)
    )


def test_rdds_attention_equals_sampling_level_by_level() -> None:
    """Against grid_sample, which is how the authors' own fallback looks values up."""
    weights, name = rdd_weights(), "descriptor.transformer.encoder.layers.0"
    network, sizes = RddNetwork(weights, CPU), [(12, 8), (6, 4), (3, 2), (2, 1), (1, 1)]
    generator = torch.Generator().manual_seed(1)
    count = sum(width * height for width, height in sizes)
    tokens, places = (torch.randn((count, 256), generator=generator) for _ in range(2))
    centres = torch.rand((count, 2), generator=generator)
    found = network._attend(name, tokens, places, centres, sizes)

    def linear(part: str, x: torch.Tensor) -> torch.Tensor:
        return F.linear(x, weights[f"{name}.self_attn.{part}.weight"], weights[f"{name}.self_attn.{part}.bias"])

    query = tokens + places
    shifts = linear("sampling_offsets", query).view(count, 8, 5, 8, 2)
    shares = linear("attention_weights", query).view(count, 8, 40).softmax(-1).view(count, 8, 5, 8)
    values = linear("value_proj", tokens).split([width * height for width, height in sizes])
    total = torch.zeros(count, 8, 32)
    for level, (width, height) in enumerate(sizes):
        maps = values[level].view(height, width, 8, 32).permute(2, 3, 0, 1)  # (head, 32, H, W)
        at = centres[:, None, None] + shifts[:, :, level] / torch.tensor([width, height])
        taken = F.grid_sample(maps, 2 * at.transpose(0, 1) - 1, align_corners=False)  # (head, 32, count, points)
        total += (taken * shares[:, :, level].transpose(0, 1)[:, None]).sum(-1).permute(2, 0, 1)
    torch.testing.assert_close(found, linear("output_proj", total.flatten(1)), atol=1e-4, rtol=1e-4)


def test_rdds_places_are_told_by_y_before_x_in_turns() -> None:
    code = _encoding((4, 2), CPU)  # row-major cells
    assert code.shape == (8, 256)
    y, x = 0.75 * 2 * np.pi, 0.375 * 2 * np.pi  # of the cell in column 1 of row 1
    np.testing.assert_allclose(code[5, [0, 1, 128, 129]], [np.sin(y), np.cos(y), np.sin(x), np.cos(x)], atol=1e-5)
    np.testing.assert_allclose(code[5, 2], np.sin(y / 10000 ** (2 / 128)), atol=1e-5)


def test_rdd_needs_every_tensor_of_the_layout_but_the_dense_matchers() -> None:
    weights, image = rdd_weights(), _image(50, 40)
    cells, score_map = RddNetwork(weights, CPU).dense(image)
    assert score_map.shape == (40, 50)
    assert cells.shape == (1, 256, 16, 16)
    changed = dict(weights)
    changed["descriptor.input_proj.4.0.weight"] = weights["descriptor.input_proj.4.0.weight"].flip(1)
    assert (RddNetwork(changed, CPU).dense(image)[0] - cells).abs().max() > 1e-4
    assert pixels_of(torch.tensor([51]), 50).tolist() == [[1.0, 1.0]]
