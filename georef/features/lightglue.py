"""LightGlue (Lindenberger et al. 2023): a transformer that matches two sets of local features."""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from georef.errors import ConfigError
from georef.features.device import choose_device
from georef.features.lightglue_network import LightGlueNetwork
from georef.features.nearest import unit_rows
from georef.features.weights import load_state_dict, version_tag
from georef.types.features import Features, Matches

Precision = Literal["auto", "float32", "bfloat16"]
SIFT_SIDE_PX = 1024  # longest side of the images that LightGlue for SIFT was trained with


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
        chosen_a, chosen_b = (self._suitable(features)[: self._max_keypoints] for features in (a, b))
        if len(chosen_a) == 0 or len(chosen_b) == 0:
            return Matches.empty()
        with torch.inference_mode():
            inputs = (*self._inputs(a.take(chosen_a)), *self._inputs(b.take(chosen_b)))
            found = _mutual_matches(self._network.log_assignment(*inputs), self._min_score)
        indices = np.stack([chosen_a[found.indices[:, 0]], chosen_b[found.indices[:, 1]]], 1)
        return Matches(indices, found.scores)

    def _suitable(self, features: Features) -> NDArray[np.int32]:
        """Indices of the features that may be matched, the best first."""
        return np.arange(len(features), dtype=np.int32)

    def _inputs(self, features: Features) -> tuple[Tensor, Tensor]:
        """Places (N, P) and descriptors (N, D), float32."""
        inputs = self._places(features), self._rows(features)
        return torch.from_numpy(inputs[0]).to(self._device), torch.from_numpy(inputs[1]).to(self._device)

    def _places(self, features: Features) -> NDArray[np.float32]:
        """Keypoints (N, 2) from the centre in units of half the longest side of the picture, as it was turned when they
        were found."""
        keypoints_px, image_size = features.as_found
        size = np.array(image_size, np.float32)
        return (keypoints_px - size / 2) / (size.max() / 2)

    def _rows(self, features: Features) -> NDArray[np.float32]:
        """Descriptors (N, D) as the weights were trained with them."""
        return features.descriptors.astype(np.float32)


class LightGlueAliked(LightGlue):
    name = "lightglue-aliked"
    extractors = ("aliked-n16",)
    weights = "aliked_lightglue"


class LightGlueDisk(LightGlue):
    name = "lightglue-disk"
    extractors = ("disk",)
    weights = "disk_lightglue"


class LightGlueSift(LightGlue):
    """Sees the scale and orientation of each keypoint too, as COLMAP has them, whose SIFT it was trained with: the
    sigma in pixels of an image with a longest side of 1024, and the angle from x towards y.

    Of several orientations at one place the one nearest to zero is matched: training knew one a place. `match` raises
    ValueError for features without orientations.
    """

    name = "lightglue-sift"
    extractors = ("sift",)
    weights = "sift_lightglue"

    def _suitable(self, features: Features) -> NDArray[np.int32]:
        if len(features) == 0:
            return super()._suitable(features)
        turned = np.abs(_orientations(features))
        order = np.lexsort((turned, *features.keypoints_px.T))
        places = features.keypoints_px[order]
        first = np.concatenate([[True], (places[1:] != places[:-1]).any(1)])
        return np.sort(order[first]).astype(np.int32)

    def _places(self, features: Features) -> NDArray[np.float32]:
        scales = features.scales_px * np.float32(SIFT_SIDE_PX / max(features.image_size))
        return np.column_stack([super()._places(features), scales, _orientations(features)])

    def _rows(self, features: Features) -> NDArray[np.float32]:
        return unit_rows(features.descriptors)


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


def _orientations(features: Features) -> NDArray[np.float32]:
    orientations = features.orientations_as_found
    if orientations is None:
        raise ValueError("expected features with orientations, as SIFT has them")
    return orientations


def _mutual_matches(log_scores: Tensor, min_score: float) -> Matches:
    best, column = log_scores.max(1)
    row = torch.arange(len(column), device=column.device)
    keep = (log_scores.argmax(0)[column] == row) & (best.exp() > min_score)
    indices = torch.stack([row[keep], column[keep]], 1).int().cpu().numpy()
    return Matches(indices, best[keep].exp().clamp(max=1).cpu().numpy())
