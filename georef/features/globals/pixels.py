"""A global descriptor that a network computes from the pixels."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from georef.features.device import choose_device
from georef.features.globals.base import Image, Needs, Row, unit_or_even_rows
from georef.features.weights import version_tag
from georef.types.features import Features

_AT_ONCE = 8  # images of one input size in the network: 0.4 GB of activations for a ViT-B


class PixelDescriptor:
    """Prepares images, runs the network on those of equal size together, and brings rows to unit length.

    network: (N, 3, h, w) as `prepare` made them, on the device, to rows (N, size). prepare: an image (H, W, 3) uint8 to
    (3, h, w) float32 in [0, 1], or ValueError. weights: entries of the weights table behind it, for the version.
    device: "cpu", "cuda", or "auto".
    """

    needs: Needs = "pixels"

    def __init__(
        self,
        name: str,
        size: int,
        network: nn.Module,
        prepare: Callable[[Image | None], Tensor],
        weights: Sequence[str],
        device: str = "cpu",
        settings: str = "",
    ) -> None:
        self.name, self.size = name, size
        self._device = choose_device(device)
        self._network, self._prepare = network.to(self._device), prepare
        tags = ",".join(version_tag(entry) for entry in weights)
        parts = [f"{name}-1", f"torch={torch.__version__}", f"weights={tags}", settings, f"device={self._device.type}"]
        self._version = " ".join(part for part in parts if part)

    def version(self) -> str:
        return self._version

    def describe(self, image_rgb: Image | None, features: Features | None) -> Row:
        """The row (size,) of an image (H, W, 3) uint8 RGB. Raises ValueError for anything else."""
        del features
        return self._rows([self._prepare(image_rgb)])[0]  # which refuses None

    def describe_many(self, images_rgb: Sequence[Image]) -> NDArray[np.float32]:
        """Rows (N, size) of images; equal to those one by one but for rounding (1e-5)."""
        inputs = [self._prepare(image) for image in images_rgb]
        groups: dict[tuple[int, ...], list[int]] = defaultdict(list)
        for index, pixels in enumerate(inputs):
            groups[tuple(pixels.shape)].append(index)
        rows = np.zeros((len(inputs), self.size), np.float32)
        for group in groups.values():
            for start in range(0, len(group), _AT_ONCE):
                part = group[start : start + _AT_ONCE]
                rows[part] = self._rows([inputs[index] for index in part])
        return rows

    def _rows(self, inputs: Sequence[Tensor]) -> NDArray[np.float32]:
        with torch.inference_mode():
            rows = self._network(torch.stack(list(inputs)).to(self._device))
        return unit_or_even_rows(rows.float().cpu().numpy())
