"""LightGlue (Lindenberger et al. 2023): a transformer that matches two sets of local features."""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np
import torch
from torch import Tensor

from georef.errors import ConfigError
from georef.features.device import choose_device
from georef.features.lightglue_network import LightGlueNetwork
from georef.features.weights import load_state_dict, version_tag
from georef.types.features import Features, Matches

Precision = Literal["auto", "float32", "bfloat16"]


class LightGlue:
    """LightGlue for the descriptors of one extractor: all layers for all keypoints, no early stop, no pruning.

    max_keypoints: only that many best keypoints of each image are matched; the cost grows with the square.
    min_score: matches that do not exceed it are dropped. precision: "bfloat16" takes a third of the time where the
    processor knows it, and finds nearly the same matches (1,350 of 1,352 on a castle pair); "auto" takes it there
    alone. device: "cpu", "cuda", or "auto".
    Raises ConfigError for an unknown precision, WeightsError where the weights are not in the cache.
    """

    name: str
    extractors: tuple[str, ...]  # whose descriptors the weights are made for
    weights: str

    def __init__(
        self,
        *,
        max_keypoints: int | None = None,
        min_score: float = 0.1,
        precision: Precision = "auto",
        device: str = "cpu",
    ) -> None:
        if precision not in get_args(Precision):
            known = ", ".join(get_args(Precision))
            raise ConfigError(f"There is no precision '{precision}'.\nExpected one of: {known}.")
        self._max_keypoints = max_keypoints
        self._min_score = min_score
        self._device = choose_device(device)
        self._precision = _best_precision(self._device) if precision == "auto" else precision
        dtype = torch.bfloat16 if self._precision == "bfloat16" else torch.float32
        self._network = LightGlueNetwork(load_state_dict(self.weights), dtype=dtype, device=self._device)

    def version(self) -> str:
        weights = version_tag(self.weights)
        settings = f"keypoints={self._max_keypoints} min_score={self._min_score} precision={self._precision}"
        return f"{self.name}-1 torch={torch.__version__} weights={weights} {settings}"

    def match(self, a: Features, b: Features) -> Matches:
        """Matches of features of one of `extractors`; scores are the network's, in (0, 1]."""
        if self._max_keypoints is not None:
            a, b = a.head(self._max_keypoints), b.head(self._max_keypoints)
        if len(a) == 0 or len(b) == 0:
            return Matches.empty()
        with torch.inference_mode():
            return _mutual_matches(self._network.log_assignment(*self._inputs(a), *self._inputs(b)), self._min_score)

    def _inputs(self, features: Features) -> tuple[Tensor, Tensor]:
        """Places (N, 2) from the centre in units of half the longest side of the picture, as it was turned when they
        were found, and descriptors (N, D), float32."""
        keypoints_px, image_size = features.as_found
        size = np.array(image_size, np.float32)
        places = (keypoints_px - size / 2) / (size.max() / 2)
        return (
            torch.from_numpy(places).to(self._device),
            torch.from_numpy(features.descriptors.astype(np.float32)).to(self._device),
        )


class LightGlueAliked(LightGlue):
    name = "lightglue-aliked"
    extractors = ("aliked-n16",)
    weights = "aliked_lightglue"


class LightGlueDisk(LightGlue):
    name = "lightglue-disk"
    extractors = ("disk",)
    weights = "disk_lightglue"


class LightGlueSuperPoint(LightGlue):
    """The matcher's weights are free; those of SuperPoint are not."""

    name = "lightglue-superpoint"
    extractors = ("superpoint",)
    weights = "superpoint_lightglue"


class LighterGlue(LightGlue):
    """A sixth of LightGlue in width and depth, trained with XFeat (Potje et al. 2024)."""

    name = "lighterglue-xfeat"
    extractors = ("xfeat",)
    weights = "xfeat-lighterglue"


class LightGlueRdd(LightGlue):
    name = "lightglue-rdd"
    extractors = ("rdd",)
    weights = "rdd_lightglue-v2"


def _best_precision(device: torch.device) -> Precision:
    """bfloat16 where it is faster: on GPUs, and on processors with matrix units for it."""
    if device.type == "cuda":
        return "bfloat16" if torch.cuda.is_bf16_supported(including_emulation=False) else "float32"
    has_units = getattr(torch.cpu, "_is_amx_tile_supported", None)  # not public yet
    return "bfloat16" if has_units is not None and has_units() else "float32"


def _mutual_matches(log_scores: Tensor, min_score: float) -> Matches:
    best, column = log_scores.max(1)
    row = torch.arange(len(column), device=column.device)
    keep = (log_scores.argmax(0)[column] == row) & (best.exp() > min_score)
    indices = torch.stack([row[keep], column[keep]], 1).int().cpu().numpy()
    return Matches(indices, best[keep].exp().clamp(max=1).cpu().numpy())
