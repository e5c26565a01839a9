"""ResNet (He et al. 2016) without its classifier, with the places and names that the published files have."""

from __future__ import annotations

from torch import Tensor, nn


def residual_trunk(backbone: str) -> tuple[nn.Sequential, int]:
    """The layers of "ResNet18" or "ResNet50" up to the last feature map, and its channels.

    The stride of a bottleneck is in its 3 x 3 convolution. Places: 0 convolution, 1 normalisation, 4 to 7 the layers.
    """
    make, repeats, growth = {"ResNet18": (_Basic, (2, 2, 2, 2), 1), "ResNet50": (_Bottleneck, (3, 4, 6, 3), 4)}[
        backbone
    ]
    stem = [nn.Conv2d(3, 64, 7, 2, 3, bias=False), nn.BatchNorm2d(64), nn.ReLU(inplace=True), nn.MaxPool2d(3, 2, 1)]
    layers, channels = [], 64
    for index, count in enumerate(repeats):
        width = 64 << index
        blocks = []
        for place in range(count):
            blocks.append(make(channels, width, 2 if index and not place else 1))
            channels = width * growth
        layers.append(nn.Sequential(*blocks))
    return nn.Sequential(*stem, *layers), channels


class _Basic(nn.Module):
    def __init__(self, channels: int, width: int, stride: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(channels, width, 3, stride, 1, bias=False)
        self.bn1 = nn.BatchNorm2d(width)
        self.conv2 = nn.Conv2d(width, width, 3, 1, 1, bias=False)
        self.bn2 = nn.BatchNorm2d(width)
        self.downsample = _shortcut(channels, width, stride)

    def forward(self, x: Tensor) -> Tensor:
        out = self.bn2(self.conv2(self.bn1(self.conv1(x)).relu()))
        return (out + (x if self.downsample is None else self.downsample(x))).relu()


class _Bottleneck(nn.Module):
    def __init__(self, channels: int, width: int, stride: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(channels, width, 1, bias=False)
        self.bn1 = nn.BatchNorm2d(width)
        self.conv2 = nn.Conv2d(width, width, 3, stride, 1, bias=False)
        self.bn2 = nn.BatchNorm2d(width)
        self.conv3 = nn.Conv2d(width, 4 * width, 1, bias=False)
        self.bn3 = nn.BatchNorm2d(4 * width)
        self.downsample = _shortcut(channels, 4 * width, stride)

    def forward(self, x: Tensor) -> Tensor:
        out = self.bn2(self.conv2(self.bn1(self.conv1(x)).relu())).relu()
        return (self.bn3(self.conv3(out)) + (x if self.downsample is None else self.downsample(x))).relu()


def _shortcut(channels: int, out: int, stride: int) -> nn.Sequential | None:
    if channels == out and stride == 1:
        return None
    return nn.Sequential(nn.Conv2d(channels, out, 1, stride, bias=False), nn.BatchNorm2d(out))
