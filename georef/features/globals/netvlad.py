"""NetVLAD (Arandjelovic et al. 2016) with VGG-16 and its authors' whitening, from the Matlab file that carries them."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.io import loadmat
from scipy.io.matlab import MatReadError
from torch import Tensor, nn
from torch.nn.functional import normalize

from georef.errors import WeightsError
from georef.features.globals.base import longest_side_input
from georef.features.globals.loading import build, tensors_of
from georef.features.globals.pixels import PixelDescriptor
from georef.features.weights import locate

WEIGHTS_NAME = "netvlad-pitts30k"
SIZE = 4096
_CENTRES, _CHANNELS = 64, 512
_BLOCKS = ((64, 2), (128, 2), (256, 3), (512, 3), (512, 3))  # channels and convolutions of VGG-16
_POOLING_PLACE, _WHITENING_PLACE = 30, 33  # of the file's layers, counted from 0


def netvlad(*, size: int = SIZE, device: str = "cpu") -> PixelDescriptor:
    """NetVLAD trained on Pittsburgh, rows (size,), longest side 322.

    size: the first components of the whitened row, which its principal axes come in order of; at most 4096.
    Raises WeightsError where the weights are not in the cache, or hold fewer components.
    """
    path = locate(WEIGHTS_NAME)
    tensors = matlab_tensors(path) if path.suffix == ".mat" else tensors_of(WEIGHTS_NAME)
    if 0 < size < len(tensors.get("whiten.weight", ())):
        tensors |= {key: tensors[key][:size] for key in ("whiten.weight", "whiten.bias")}
    network = build(partial(NetVladNetwork, size), tensors, WEIGHTS_NAME)
    return PixelDescriptor("netvlad", size, network, longest_side_input, [WEIGHTS_NAME], device, f"size={size}")


class NetVladNetwork(nn.Module):
    """Rows (N, size) of images in [0, 1]."""

    def __init__(self, size: int) -> None:
        super().__init__()
        self.backbone = vgg16_trunk()
        self.netvlad = _Pooling()
        self.whiten = nn.Linear(_CENTRES * _CHANNELS, size)
        self.register_buffer("mean", torch.zeros(3))  # RGB in 0 to 255
        self.mean: Tensor

    def forward(self, image: Tensor) -> Tensor:
        x = self.backbone(image * 255 - self.mean[:, None, None])
        return normalize(self.whiten(self.netvlad(x)))


class _Pooling(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.score_proj = nn.Conv1d(_CHANNELS, _CENTRES, 1, bias=False)
        self.centers = nn.Parameter(torch.zeros(_CHANNELS, _CENTRES))

    def forward(self, x: Tensor) -> Tensor:
        """Unit rows (N, 512 x 64), components before centres, of features (N, 512, h, w)."""
        x = normalize(x, dim=1).flatten(2)
        share = self.score_proj(x).softmax(1)
        sums = torch.einsum("ndp,nkp->ndk", x, share) - self.centers * share.sum(2)[:, None]
        return normalize(normalize(sums, dim=1).flatten(1))


def vgg16_trunk() -> nn.Sequential:
    """VGG-16 (Simonyan and Zisserman 2015) up to its last convolution, without the activation after it."""
    layers: list[nn.Module] = []
    channels = 3
    for width, count in _BLOCKS:
        for _ in range(count):
            layers += [nn.Conv2d(channels, width, 3, padding=1), nn.ReLU(inplace=True)]
            channels = width
        layers.append(nn.MaxPool2d(2, 2))
    return nn.Sequential(*layers[:-2])


def matlab_tensors(path: Path) -> dict[str, Tensor]:
    """Tensors by the names of `NetVladNetwork` from the exported Matlab file. Raises WeightsError for another file.

    The file keeps convolutions as (height, width, in, out) and the centres with the opposite sign.
    """
    try:
        net = loadmat(path, struct_as_record=False, squeeze_me=True)["net"]
        layers = net.layers
        trunk = vgg16_trunk()
        places = [place for place, layer in enumerate(trunk) if isinstance(layer, nn.Conv2d)]
        tensors = {f"backbone.{place}.weight": _tensor(layers[place].weights[0], (3, 2, 0, 1)) for place in places}
        tensors |= {f"backbone.{place}.bias": _tensor(layers[place].weights[1]) for place in places}
        scores, centres = layers[_POOLING_PLACE].weights
        whitening, offset = layers[_WHITENING_PLACE].weights
        mean = np.asarray(net.meta.normalization.averageImage)
    except (MatReadError, NotImplementedError, KeyError, AttributeError, IndexError, TypeError, ValueError) as error:
        raise WeightsError(
            f"Weights '{WEIGHTS_NAME}' are not the exported NetVLAD network: {type(error).__name__}: {error}.\n"
            f"Fetch the file that the table of weights names.\nIn {path}"
        ) from error
    return tensors | {
        "netvlad.score_proj.weight": _tensor(scores, (1, 0))[:, :, None],
        "netvlad.centers": -_tensor(centres),
        "whiten.weight": _tensor(np.squeeze(whitening), (1, 0)),
        "whiten.bias": _tensor(np.squeeze(offset)),
        "mean": _tensor(mean.reshape(-1, 3)[0]),
    }


def _tensor(values: Any, order: tuple[int, ...] | None = None) -> Tensor:
    array: NDArray[np.float32] = np.asarray(values, np.float32)
    return torch.from_numpy(np.ascontiguousarray(array if order is None else array.transpose(order)))
