"""GeM of EfficientNet-Lite0 (Tan and Le 2019; ImageNet weights), whitened by the reference map's own images."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn.functional import conv2d, pad, relu6

from georef.errors import StageError
from georef.features.globals.base import Image, Needs, Row, longest_side_input, normalized
from georef.features.globals.loading import build, tensors_of
from georef.features.globals.pixels import PixelDescriptor
from georef.features.globals.sampling import Reservoir
from georef.features.globals.state import LearnedState
from georef.features.globals.whitening import Whitening, learn_whitening
from georef.types.features import Features

WEIGHTS_NAME = "efficientnet-lite0"
CHANNELS = 1280
_SAMPLED_ROWS = 16_384  # 84 MB
_CENTRED = ((0.5, 0.5, 0.5), (0.5, 0.5, 0.5))  # the Lite networks were trained on RGB in [-1, 1]
_STAGES = ((3, 1, 1, 16, 1), (3, 2, 6, 24, 2), (5, 2, 6, 40, 2), (3, 2, 6, 80, 3), (5, 1, 6, 112, 3), (5, 2, 6, 192, 4))
_STAGES += ((3, 1, 6, 320, 1),)  # kernel, stride of the first block, expansion, channels, blocks


class EfficientNetGem:
    """Generalised mean (p = 3) of the last feature map at longest side 322, whitened to rows (size,).

    device: "cpu", "cuda", or "auto". Raises WeightsError where the weights are not in the cache.
    """

    name = "efficientnet-gem"
    needs: Needs = "pixels"

    def __init__(self, *, size: int = 512, seed: int = 0, device: str = "cpu") -> None:
        self.size, self._seed, self._device = size, seed, device
        network = build(EfficientNetLite, tensors_of(WEIGHTS_NAME), WEIGHTS_NAME)
        self._rows = PixelDescriptor(self.name, CHANNELS, network, longest_side_input, [WEIGHTS_NAME], device)
        self._whitening: Whitening | None = None
        self._tag = "not-learned"

    def version(self) -> str:
        return f"{self._rows.version()} size={self.size} seed={self._seed} state={self._tag}"

    def learn(self, samples: Iterable[Image]) -> LearnedState:
        """Whitening of the reference's images (H, W, 3), in one pass. Raises StageError for fewer than two images."""
        rows = Reservoir(_SAMPLED_ROWS, self._seed)
        for image in samples:
            place = rows.places(1)
            if place[0] >= 0:
                rows.put(place, self._rows.describe(image, None)[None])
        try:
            whitening = learn_whitening(rows.rows, self.size)
        except ValueError as error:
            raise StageError(f"The reference images cannot teach a global descriptor: {error}.") from error
        return LearnedState(self._settings(), {"mean": whitening.mean, "axes": whitening.axes})

    def with_state(self, state: LearnedState) -> EfficientNetGem:
        state.check_learned_by(self._settings())
        made = EfficientNetGem(size=self.size, seed=self._seed, device=self._device)
        made._whitening = Whitening(state.arrays["mean"], state.arrays["axes"], self.size)
        made._tag = state.sha256[:12]
        return made

    def describe(self, image_rgb: Image | None, features: Features | None) -> Row:
        """The row (size,) of an image (H, W, 3). Raises StageError before anything was learned."""
        return self._whitened(self._rows.describe(image_rgb, features)[None])[0]

    def describe_many(self, images_rgb: Sequence[Image]) -> NDArray[np.float32]:
        """Rows (N, size) of images."""
        return self._whitened(self._rows.describe_many(images_rgb))

    def _whitened(self, rows: NDArray[np.float32]) -> NDArray[np.float32]:
        if self._whitening is None:
            raise StageError(
                f"The global descriptor '{self.name}' has learned nothing yet.\nLearn it from the reference."
            )
        return self._whitening.apply(rows)

    def _settings(self) -> str:
        return f"{self._rows.version()} size={self.size} seed={self._seed}"


class EfficientNetLite(nn.Module):
    """EfficientNet-Lite0: no squeeze and excitation, ReLU6. Forward: unit-free GeM rows (N, 1280).

    Padding is that of TensorFlow, where the network was trained: an odd one goes to the right and below.
    """

    def __init__(self) -> None:
        super().__init__()
        self._conv_stem = nn.Conv2d(3, 32, 3, 2, bias=False)
        self._bn0 = _normalisation(32)
        blocks, channels = [], 32
        for kernel, stride, expansion, out, count in _STAGES:
            for place in range(count):
                blocks.append(_InvertedResidual(channels, out, kernel, 1 if place else stride, expansion))
                channels = out
        self._blocks = nn.ModuleList(blocks)
        self._conv_head = nn.Conv2d(channels, CHANNELS, 1, bias=False)
        self._bn1 = _normalisation(CHANNELS)
        self._fc = nn.Linear(CHANNELS, 1000)  # the classifier: in the file

    def forward(self, image: Tensor) -> Tensor:
        return self.feature_map(image).clamp(min=1e-6).pow(3).mean((2, 3)).pow(1 / 3)

    def classify(self, image: Tensor) -> Tensor:
        """Scores (N, 1000) of ImageNet's classes for images (N, 3, h, w) in [0, 1]."""
        return self._fc(self.feature_map(image).mean((2, 3)))

    def feature_map(self, image: Tensor) -> Tensor:
        """The last feature map (N, 1280, h / 32, w / 32)."""
        x = relu6(self._bn0(_same_padded(self._conv_stem, normalized(image, _CENTRED))))
        for block in self._blocks:
            x = block(x)
        return relu6(self._bn1(self._conv_head(x)))


class _InvertedResidual(nn.Module):
    def __init__(self, channels: int, out: int, kernel: int, stride: int, expansion: int) -> None:
        super().__init__()
        wide = channels * expansion
        if expansion > 1:
            self._expand_conv = nn.Conv2d(channels, wide, 1, bias=False)
            self._bn0 = _normalisation(wide)
        self._depthwise_conv = nn.Conv2d(wide, wide, kernel, stride, groups=wide, bias=False)
        self._bn1 = _normalisation(wide)
        self._project_conv = nn.Conv2d(wide, out, 1, bias=False)
        self._bn2 = _normalisation(out)
        self._expands, self._keeps = expansion > 1, stride == 1 and channels == out

    def forward(self, x: Tensor) -> Tensor:
        inner = relu6(self._bn0(self._expand_conv(x))) if self._expands else x
        inner = relu6(self._bn1(_same_padded(self._depthwise_conv, inner)))
        inner = self._bn2(self._project_conv(inner))
        return x + inner if self._keeps else inner


def _normalisation(channels: int) -> nn.BatchNorm2d:
    return nn.BatchNorm2d(channels, eps=1e-3)


def _same_padded(layer: nn.Conv2d, x: Tensor) -> Tensor:
    kernel, stride = layer.kernel_size[0], layer.stride[0]
    missing = [max((-(-side // stride) - 1) * stride + kernel - side, 0) for side in (x.shape[3], x.shape[2])]
    left, top = (total // 2 for total in missing)
    x = pad(x, (left, missing[0] - left, top, missing[1] - top))
    return conv2d(x, layer.weight, None, layer.stride, 0, layer.dilation, layer.groups)
