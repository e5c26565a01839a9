"""DINOv2-SALAD (Izquierdo and Civera 2024) and MegaLoc (Berton and Masone 2025), which puts a linear layer after it."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn.functional import normalize

from georef.features.globals.base import normalized, square_input
from georef.features.globals.loading import build, tensors_of
from georef.features.globals.pixels import PixelDescriptor
from georef.features.globals.vision_transformer import VIT_B14, VisionTransformer

_CLUSTERS, _TOKEN, _HIDDEN = 64, 256, 512
_ROUNDS = 3  # of Sinkhorn's normalisation
SALAD_SIZE = _TOKEN + _CLUSTERS * 128  # 8448
MEGALOC_SIZE = 8448


def dinov2_salad(*, device: str = "cpu") -> PixelDescriptor:
    """DINOv2-SALAD, rows (8448,), at 322 x 322. Raises WeightsError where the weights are not in the cache."""
    weights = "dinov2-salad"
    network = build(_SaladNetwork, tensors_of(weights), weights)
    return PixelDescriptor("dinov2-salad", SALAD_SIZE, network, square_input, [weights], device)


def megaloc(*, device: str = "cpu") -> PixelDescriptor:
    """MegaLoc, rows (8448,), at 322 x 322. Raises WeightsError where the weights are not in the cache.

    Its authors' repository has no licence file: the weights have to be accepted as they are.
    """
    weights = "megaloc"
    network = build(_MegaLocNetwork, tensors_of(weights), weights)
    return PixelDescriptor("megaloc", MEGALOC_SIZE, network, square_input, [weights], device)


class _SaladNetwork(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.backbone = _Backbone()
        self.aggregator = Salad(VIT_B14.width, 128)

    def forward(self, image: Tensor) -> Tensor:
        return self.aggregator(*self.backbone.model(normalized(image)))


class _MegaLocNetwork(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.backbone = _Backbone()
        self.aggregator = _MegaLocAggregator()

    def forward(self, image: Tensor) -> Tensor:
        features, token = self.backbone.model(normalized(image))
        return normalize(self.aggregator.linear(self.aggregator.agg(features, token)))


class _Backbone(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.model = VisionTransformer(VIT_B14)


class _MegaLocAggregator(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.agg = Salad(VIT_B14.width, 256)
        self.linear = nn.Linear(_TOKEN + _CLUSTERS * 256, MEGALOC_SIZE)


class Salad(nn.Module):
    """Assigns patches to clusters by optimal transport with a bin for what is of no use, and sums them by cluster."""

    def __init__(self, width: int, cluster_width: int) -> None:
        super().__init__()
        self.token_features = nn.Sequential(nn.Linear(width, _HIDDEN), nn.ReLU(), nn.Linear(_HIDDEN, _TOKEN))
        self.cluster_features = _two_layers(width, cluster_width)
        self.score = _two_layers(width, _CLUSTERS)
        self.dust_bin = nn.Parameter(torch.tensor(1.0))

    def forward(self, features: Tensor, token: Tensor) -> Tensor:
        """Unit rows (N, 256 + 64 x cluster width) of patches (N, width, h, w) and the image's token (N, width)."""
        local = self.cluster_features(features).flatten(2)
        share = transport(self.score(features).flatten(2), self.dust_bin)
        sums = normalize(torch.einsum("bln,bmn->blm", local, share), dim=1)
        return normalize(torch.cat([normalize(self.token_features(token)), sums.flatten(1)], 1))


def transport(scores: Tensor, bin_score: Tensor) -> Tensor:
    """Shares (B, m, n) of n patches in m clusters from scores (B, m, n), in the log domain (Cuturi 2013).

    Each cluster takes as much as one patch gives, the bin what remains; `_ROUNDS` of Sinkhorn, ending with the patches.
    """
    batch, clusters, patches = scores.shape
    filled = torch.cat([scores, bin_score.expand(batch, 1, patches)], 1)
    taken = scores.new_zeros(clusters + 1)  # logarithms, in units of what a patch gives
    taken[-1] = math.log(patches - clusters)
    by_cluster, by_patch = scores.new_zeros(batch, clusters + 1, 1), scores.new_zeros(batch, 1, patches)
    for _ in range(_ROUNDS):
        by_cluster = taken[:, None] - torch.logsumexp(filled + by_patch, 2, keepdim=True)
        by_patch = -torch.logsumexp(filled + by_cluster, 1, keepdim=True)
    return (filled + by_cluster + by_patch)[:, :-1].exp()


def _two_layers(width: int, out: int) -> nn.Sequential:
    # the second place is the training's dropout: the numbers of the places stand in the files
    return nn.Sequential(nn.Conv2d(width, _HIDDEN, 1), nn.Identity(), nn.ReLU(), nn.Conv2d(_HIDDEN, out, 1))
