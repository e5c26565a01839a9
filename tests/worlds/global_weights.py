"""Files of random weights with the layouts that the authors of global descriptors publish.

The layouts are written down here as the published files have them, independently of the modules that load them.
"""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.io import savemat

from georef.features import weights
from georef.features.weights import WEIGHTS, fetch

Layout = dict[str, tuple[int, ...]]


def dinov2_layout(width: int = 768, depth: int = 12, gated: bool = False) -> Layout:
    """A DINOv2 transformer of 14-pixel patches, trained at 518 pixels, without registers."""
    layout: Layout = {
        "cls_token": (1, 1, width),
        "pos_embed": (1, 1370, width),
        "mask_token": (1, width),
        "patch_embed.proj.weight": (width, 3, 14, 14),
        "patch_embed.proj.bias": (width,),
        "norm.weight": (width,),
        "norm.bias": (width,),
    }
    hidden = {1536: 4096, 48: 128}[width] if gated else 4 * width
    for i in range(depth):
        block: Layout = {
            "norm1.weight": (width,),
            "norm1.bias": (width,),
            "attn.qkv.weight": (3 * width, width),
            "attn.qkv.bias": (3 * width,),
            "attn.proj.weight": (width, width),
            "attn.proj.bias": (width,),
            "ls1.gamma": (width,),
            "norm2.weight": (width,),
            "norm2.bias": (width,),
            "ls2.gamma": (width,),
        }
        first, second = ("w12", "w3") if gated else ("fc1", "fc2")
        block |= _linear(f"mlp.{first}", width, 2 * hidden if gated else hidden) | _linear(
            f"mlp.{second}", hidden, width
        )
        layout |= _under(f"blocks.{i}", block)
    return layout


def salad_layout(width: int = 768, cluster: int = 128) -> Layout:
    """SALAD's aggregation: 64 clusters, a token of 256, hidden layers of 512; the dropouts take place 1."""
    layout = _linear("token_features.0", width, 512) | _linear("token_features.2", 512, 256)
    for name, out in (("cluster_features", cluster), ("score", 64)):
        layout |= {f"{name}.0.weight": (512, width, 1, 1), f"{name}.0.bias": (512,)}
        layout |= {f"{name}.3.weight": (out, 512, 1, 1), f"{name}.3.bias": (out,)}
    return layout | {"dust_bin": ()}


def dinov2_salad_layout(width: int = 768, depth: int = 12) -> Layout:
    return _under("backbone.model", dinov2_layout(width, depth)) | _under("aggregator", salad_layout(width))


def megaloc_layout(width: int = 768, depth: int = 12, size: int = 8448) -> Layout:
    return (
        _under("backbone.model", dinov2_layout(width, depth))
        | _under("aggregator.agg", salad_layout(width, 256))
        | _linear("aggregator.linear", 64 * 256 + 256, size)
    )


def gem_layout(backbone: str, size: int) -> Layout:
    """CosPlace and EigenPlaces: the children of torchvision's ResNet in a row, then the aggregation."""
    layout: Layout = {"backbone.0.weight": (64, 3, 7, 7)} | _batch_norm("backbone.1", 64)
    channels, bottleneck = 64, backbone == "ResNet50"
    for i, count in enumerate((3, 4, 6, 3) if bottleneck else (2, 2, 2, 2)):
        width = 64 * 2**i
        out = 4 * width if bottleneck else width
        for k in range(count):
            if bottleneck:
                convolutions = [(width, channels, 1, 1), (width, width, 3, 3), (out, width, 1, 1)]
            else:
                convolutions = [(width, channels, 3, 3), (width, width, 3, 3)]
            block: Layout = {}
            for number, shape in enumerate(convolutions, 1):
                block |= {f"conv{number}.weight": shape} | _batch_norm(f"bn{number}", shape[0])
            if k == 0 and (i > 0 or bottleneck):
                block |= {"downsample.0.weight": (out, channels, 1, 1)} | _batch_norm("downsample.1", out)
            layout |= _under(f"backbone.{i + 4}.{k}", block)
            channels = out
    return layout | {"aggregation.1.p": (1,)} | _linear("aggregation.3", channels, size)


VGG16_PLACES = {0: (3, 64), 2: (64, 64), 5: (64, 128), 7: (128, 128), 10: (128, 256), 12: (256, 256), 14: (256, 256)}
VGG16_PLACES |= {17: (256, 512), 19: (512, 512), 21: (512, 512), 24: (512, 512), 26: (512, 512), 28: (512, 512)}


def random_tensors(layout: Mapping[str, tuple[int, ...]], seed: int = 0) -> dict[str, torch.Tensor]:
    """Tensors of a layout that keep activations in bounds; the rows of a matrix share memory, so files are small."""
    generator = torch.Generator().manual_seed(seed)
    return {key: _random(key, shape, generator) for key, shape in layout.items()}


def install(name: str, path: Path) -> None:
    """Put a local file into the cache as the weights of that name, the way a user does with `--file`."""
    sha256 = hashlib.sha256(path.read_bytes()).hexdigest()
    fetch([name], file=path, sha256=sha256, accept_licence=True)


def install_tensors(name: str, tensors: object, folder: Path) -> None:
    path = folder / f"local-{name}.pth"
    torch.save(tensors, path)
    install(name, path)


def write_netvlad(path: Path, size: int, seed: int = 0) -> dict[str, np.ndarray]:
    """The exported Matlab network with a whitening to `size`; returns its arrays by place."""
    random = np.random.default_rng(seed)

    def array(*shape: int, fan_in: int) -> np.ndarray:
        return (random.normal(size=shape) / np.sqrt(fan_in)).astype(np.float32)

    kept: dict[str, np.ndarray] = {}
    layers = np.empty(35, object)
    for place in range(35):
        layers[place] = {"type": "other", "weights": np.empty(0, object)}
    for place, (channels, out) in VGG16_PLACES.items():
        pair = array(3, 3, channels, out, fan_in=4 * channels), array(out, fan_in=100)
        layers[place], kept[str(place)] = _layer(*pair), pair[0]
    scores, centres = array(512, 64, fan_in=4), array(512, 64, fan_in=512)
    whitening, offset = array(1, 1, 32768, size, fan_in=1), array(1, size, fan_in=10_000)
    layers[30], layers[33] = _layer(scores, centres), _layer(whitening, offset)
    mean = np.broadcast_to(np.array([123.7, 116.8, 103.9], np.float32), (4, 4, 3)).copy()
    net = {"layers": layers, "meta": {"normalization": {"averageImage": mean}}}
    savemat(path, {"net": net})
    return kept | {"scores": scores, "centres": centres, "whitening": whitening, "offset": offset}


def unpinned(patch: pytest.MonkeyPatch, folder: Path) -> None:
    """An empty cache in `folder`, and a table without pinned hashes: local files may stand in for published ones."""
    patch.setenv("GEOREF_CACHE", str(folder))
    table = {name: dataclasses.replace(entry, sha256=None, wheel=None) for name, entry in WEIGHTS.items()}
    patch.setattr(weights, "WEIGHTS", table)


def _layer(first: np.ndarray, second: np.ndarray) -> dict[str, object]:
    pair = np.empty(2, object)
    pair[0], pair[1] = first, second
    return {"type": "conv", "weights": pair}


def _random(key: str, shape: tuple[int, ...], generator: torch.Generator) -> torch.Tensor:
    if key.endswith("num_batches_tracked"):
        return torch.zeros((), dtype=torch.int64)
    if key.endswith((".p", "dust_bin")):
        return torch.full(shape, 3.0 if key.endswith(".p") else 1.0)
    if len(shape) < 2:
        values = 0.1 * torch.randn(shape, generator=generator)
        return 1 + values if key.endswith(("weight", "running_var", "gamma")) else values
    inner = int(np.prod(shape[1:]))
    base = torch.randn(7 * shape[0] + inner, generator=generator) / inner**0.5
    strides = [7, *(int(np.prod(shape[i + 1 :])) for i in range(1, len(shape)))]
    return base.as_strided(shape, strides)


def _linear(name: str, into: int, out: int) -> Layout:
    return {f"{name}.weight": (out, into), f"{name}.bias": (out,)}


def _batch_norm(name: str, channels: int) -> Layout:
    parts = ("weight", "bias", "running_mean", "running_var")
    return {f"{name}.{part}": (channels,) for part in parts} | {f"{name}.num_batches_tracked": ()}


def _under(prefix: str, layout: Layout) -> Layout:
    return {f"{prefix}.{key}": shape for key, shape in layout.items()}
