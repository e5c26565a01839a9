"""Weights made here, of the layout that authors publish, for components whose real weights cannot be had freely."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from functools import partial
from pathlib import Path

import torch
from torch import Tensor

from georef.features.weights import fetch

_SUPERPOINT = {
    "conv1a": (64, 1, 3),
    "conv1b": (64, 64, 3),
    "conv2a": (64, 64, 3),
    "conv2b": (64, 64, 3),
    "conv3a": (128, 64, 3),
    "conv3b": (128, 128, 3),
    "conv4a": (128, 128, 3),
    "conv4b": (128, 128, 3),
    "convPa": (256, 128, 3),
    "convPb": (65, 256, 1),
    "convDa": (256, 128, 3),
    "convDb": (256, 256, 1),
}


class Maker:
    """Random tensors by name: the same for the same seed."""

    def __init__(self, seed: int = 0) -> None:
        self.made: dict[str, Tensor] = {}
        self._generator = torch.Generator().manual_seed(seed)

    def normal(self, name: str, *shape: int, scale: float | None = None) -> None:
        fan_in = max(1, torch.Size(shape[1:]).numel())
        spread = (2 / fan_in) ** 0.5 if scale is None else scale
        self.made[name] = spread * torch.randn(shape, generator=self._generator)

    def conv(self, name: str, out: int, inner: int, size: int, *, bias: bool) -> None:
        self.normal(f"{name}.weight", out, inner, size, size)
        if bias:
            self.normal(f"{name}.bias", out, scale=0.1)

    def linear(self, name: str, out: int, inner: int, scale: float | None = None) -> None:
        self.normal(f"{name}.weight", out, inner, scale=scale)
        self.normal(f"{name}.bias", out, scale=0.1)

    def norm(self, name: str, size: int, *, statistics: bool) -> None:
        self.made[f"{name}.weight"] = 1 + 0.1 * torch.randn(size, generator=self._generator)
        self.normal(f"{name}.bias", size, scale=0.1)
        if statistics:
            self.normal(f"{name}.running_mean", size, scale=0.1)
            self.made[f"{name}.running_var"] = 0.5 + torch.rand(size, generator=self._generator)


def superpoint_weights(seed: int = 0) -> dict[str, Tensor]:
    maker = Maker(seed)
    for name, (out, inner, size) in _SUPERPOINT.items():
        maker.conv(name, out, inner, size, bias=True)
    return maker.made


def rdd_weights(seed: int = 0, layers: int = 1) -> dict[str, Tensor]:
    """With fewer layers than the published four: a quarter of the time."""
    maker = Maker(seed)
    _rdd_detector(maker)
    _resnet50(maker, "descriptor.backbone.0.body")
    for level, width in enumerate((256, 512, 1024, 2048, 2048)):
        maker.conv(f"descriptor.input_proj.{level}.0", 256, width, 3 if level == 4 else 1, bias=True)
        maker.norm(f"descriptor.input_proj.{level}.1", 256, statistics=False)
    maker.normal("descriptor.transformer.level_embed", 5, 256, scale=1.0)
    for layer in range(layers):
        name = f"descriptor.transformer.encoder.layers.{layer}"
        maker.linear(f"{name}.self_attn.sampling_offsets", 8 * 5 * 8 * 2, 256)
        maker.linear(f"{name}.self_attn.attention_weights", 8 * 5 * 8, 256)
        for part in ("self_attn.value_proj", "self_attn.output_proj"):
            maker.linear(f"{name}.{part}", 256, 256)
        maker.linear(f"{name}.linear1", 1024, 256)
        maker.linear(f"{name}.linear2", 256, 1024)
        for norm in ("norm1", "norm2"):
            maker.norm(f"{name}.{norm}", 256, statistics=False)
    return maker.made


def lightglue_weights(seed: int = 0, *, descriptor_size: int = 256, places: int = 2) -> dict[str, Tensor]:
    """Descriptors of 256, the width of the layers, are not projected; places: 2 for x, y, 4 with scale, orientation."""
    maker = Maker(seed)
    maker.normal("posenc.Wr.weight", 32, places, scale=1.0)
    if descriptor_size != 256:
        maker.linear("input_proj", 256, descriptor_size)
    for layer in range(9):
        own, cross = f"self_attn.{layer}", f"cross_attn.{layer}"
        maker.linear(f"{own}.Wqkv", 768, 256, scale=0.06)
        maker.linear(f"{own}.out_proj", 256, 256, scale=0.06)
        for part in ("to_qk", "to_v", "to_out"):
            maker.linear(f"{cross}.{part}", 256, 256, scale=0.06)
        for name in (own, cross):
            maker.linear(f"{name}.ffn.0", 512, 512, scale=0.04)
            maker.norm(f"{name}.ffn.1", 512, statistics=False)
            maker.linear(f"{name}.ffn.3", 256, 512, scale=0.04)
        maker.linear(f"log_assignment.{layer}.matchability", 1, 256, scale=0.06)
        maker.linear(f"log_assignment.{layer}.final_proj", 256, 256, scale=0.06)
        if layer < 8:
            maker.linear(f"token_confidence.{layer}.token.0", 1, 256, scale=0.06)
    return maker.made


MADE = {
    "superpoint": superpoint_weights,
    "rdd-v2": rdd_weights,
    "superpoint_lightglue": lightglue_weights,
    "rdd_lightglue-v2": lightglue_weights,
    "sift_lightglue": partial(lightglue_weights, descriptor_size=128, places=4),
}


def put_into_cache(folder: Path, names: Iterable[str] = MADE) -> None:
    """Bring them into the cache that GEOREF_CACHE names, the way a user brings a file."""
    for name in names:
        path = folder / f"{name}.pth"
        torch.save(MADE[name](), path)
        sha256 = hashlib.sha256(path.read_bytes()).hexdigest()
        fetch([name], file=path, sha256=sha256, accept_licence=True)


def _rdd_detector(maker: Maker) -> None:
    widths = (3, 8, 16, 32, 64)
    for block in range(1, 5):
        inner, out = widths[block - 1], widths[block]
        maker.conv(f"detector.block{block}.conv1", out, inner, 3, bias=False)
        maker.conv(f"detector.block{block}.conv2", out, out, 3, bias=False)
        for norm in ("bn1", "bn2"):
            maker.norm(f"detector.block{block}.{norm}", out, statistics=True)
        if block > 1:
            maker.conv(f"detector.block{block}.downsample", out, inner, 1, bias=True)
        maker.conv(f"detector.conv{block}", 16, out, 1, bias=False)
    maker.conv("detector.convhead2.0", 1, 64, 1, bias=False)


def _resnet50(maker: Maker, body: str) -> None:
    maker.conv(f"{body}.conv1", 64, 3, 7, bias=False)
    maker.norm(f"{body}.bn1", 64, statistics=True)
    inner = 64
    for stage, blocks in enumerate((3, 4, 6, 3)):
        width = 64 * 2**stage
        for block in range(blocks):
            name = f"{body}.layer{stage + 1}.{block}"
            for number, (out, size) in enumerate(((width, 1), (width, 3), (4 * width, 1)), 1):
                maker.conv(f"{name}.conv{number}", out, (inner, width, width)[number - 1], size, bias=False)
                maker.norm(f"{name}.bn{number}", out, statistics=True)
            if block == 0:
                maker.conv(f"{name}.downsample.0", 4 * width, inner, 1, bias=False)
                maker.norm(f"{name}.downsample.1", 4 * width, statistics=True)
            inner = 4 * width
