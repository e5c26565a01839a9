"""CosPlace (Berton et al. 2022) and EigenPlaces (Berton et al. 2023): a ResNet, GeM pooling and a linear layer."""

from __future__ import annotations

from functools import partial

import torch
from torch import Tensor, nn
from torch.nn.functional import normalize

from georef.errors import ConfigError
from georef.features.globals.base import longest_side_input, normalized
from georef.features.globals.loading import build, tensors_of
from georef.features.globals.pixels import PixelDescriptor
from georef.features.globals.residual_network import residual_trunk


def cosplace_512(*, backbone: str = "ResNet50", device: str = "cpu") -> PixelDescriptor:
    """CosPlace, rows (512,), longest side 322; backbone "ResNet18" or "ResNet50"."""
    return _descriptor("cosplace", backbone, 512, device)


def cosplace_2048(*, device: str = "cpu") -> PixelDescriptor:
    """CosPlace with ResNet-50, rows (2048,), longest side 322."""
    return _descriptor("cosplace", "ResNet50", 2048, device)


def eigenplaces_512(*, backbone: str = "ResNet50", device: str = "cpu") -> PixelDescriptor:
    """EigenPlaces, rows (512,), longest side 322; backbone "ResNet18" or "ResNet50"."""
    return _descriptor("eigenplaces", backbone, 512, device)


def eigenplaces_2048(*, device: str = "cpu") -> PixelDescriptor:
    """EigenPlaces with ResNet-50, rows (2048,), longest side 322."""
    return _descriptor("eigenplaces", "ResNet50", 2048, device)


def _descriptor(method: str, backbone: str, size: int, device: str) -> PixelDescriptor:
    if backbone not in ("ResNet18", "ResNet50"):
        raise ConfigError(f"There is no backbone '{backbone}' of {method}.\nExpected ResNet18 or ResNet50.")
    weights = f"{method}-{backbone.lower()}-{size}"
    network = build(partial(GemNetwork, backbone, size), tensors_of(weights), weights)
    return PixelDescriptor(f"{method}-{size}", size, network, longest_side_input, [weights], device)


class GemNetwork(nn.Module):
    """Rows (N, size): feature vectors of unit length, generalised mean over the image, linear layer, unit length."""

    def __init__(self, backbone: str, size: int) -> None:
        super().__init__()
        self.backbone, channels = residual_trunk(backbone)
        # the numbers of the places stand in the files: unit length, mean, flattening, linear layer, unit length
        self.aggregation = nn.ModuleList([nn.Identity(), Gem(), nn.Identity(), nn.Linear(channels, size)])

    def forward(self, image: Tensor) -> Tensor:
        x = normalize(self.backbone(normalized(image)), dim=1)
        return normalize(self.aggregation[3](self.aggregation[1](x)))


class Gem(nn.Module):
    """Generalised mean (Radenovic et al. 2018) over the pixels of (N, C, h, w): rows (N, C)."""

    def __init__(self) -> None:
        super().__init__()
        self.p = nn.Parameter(3 * torch.ones(1))

    def forward(self, x: Tensor) -> Tensor:
        return x.clamp(min=1e-6).pow(self.p).mean((2, 3)).pow(1 / self.p)
