"""What a global descriptor is, and what is done once for all of them: sizes, colour normalisation, unit length."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any, Literal, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from georef.types.features import Features

if TYPE_CHECKING:
    import torch

    from georef.features.globals.state import LearnedState

Image = NDArray[np.uint8]  # (H, W, 3), RGB
Row = NDArray[np.float32]  # (size,) of unit length
Needs = Literal["pixels", "features"]
Self = TypeVar("Self", bound="LearnedDescriptor")

SIDE_PX = 322  # both sides for transformers (23 patches of 14), the longest side for convolutional networks
SMALLEST_SIDE_PX = 32  # of a network's input: below it nothing is left after five halvings
IMAGENET = ((0.485, 0.456, 0.406), (0.229, 0.224, 0.225))  # mean and standard deviation of RGB in [0, 1]


class GlobalDescriptor(Protocol):
    """Describes an image by one row of unit length; images of the same place have rows with a high dot product.

    needs: whether it looks at the pixels or at the local features; the other may be None.
    """

    @property
    def name(self) -> str: ...

    @property
    def size(self) -> int: ...

    @property
    def needs(self) -> Needs: ...

    def version(self) -> str:
        """What decides the result beside the input: library versions, weights hash, hash of what was learned."""
        ...

    def describe(self, image_rgb: Image | None, features: Features | None) -> Row:
        """The row (size,) float32 of an image (H, W, 3) uint8 RGB or of its local features."""
        ...


class LearnedDescriptor(GlobalDescriptor, Protocol):
    """A descriptor that is learned from the reference map before it can describe."""

    def learn(self, samples: Iterable[Any]) -> LearnedState:
        """What the samples teach: features or images of the reference, as `needs` says.

        The samples are gone through twice, one at a time; an iterator, which is empty after one pass, is refused.
        """
        ...

    def with_state(self: Self, state: LearnedState) -> Self:
        """The same descriptor with what was learned. Raises StageError for what another descriptor learned."""
        ...


class NetworkDescriptor(Protocol):
    """A descriptor of pixels that can take several images at once."""

    def describe_many(self, images_rgb: Sequence[Image]) -> NDArray[np.float32]:
        """Rows (N, size) of images (H, W, 3), those of equal input size together."""
        ...


def square_input(image_rgb: Image | None, side_px: int = SIDE_PX) -> torch.Tensor:
    """The image (H, W, 3) as (3, side, side), RGB in [0, 1]; its aspect is lost, as the transformers were trained."""
    return _resized(image_rgb, side_px, side_px)


def longest_side_input(image_rgb: Image | None, side_px: int = SIDE_PX) -> torch.Tensor:
    """The image (H, W, 3) as (3, h, w), RGB in [0, 1], its longest side `side_px` and its aspect kept.

    A very long image keeps at least `SMALLEST_SIDE_PX` across.
    """
    height, width = check_image(image_rgb).shape[:2]
    scale = side_px / max(height, width)
    return _resized(image_rgb, *(max(SMALLEST_SIDE_PX, round(side * scale)) for side in (height, width)))


def normalized(pixels: torch.Tensor, statistics: tuple[Sequence[float], Sequence[float]] = IMAGENET) -> torch.Tensor:
    """Pixels (N, 3, h, w) in [0, 1] less the mean, by the standard deviation, of each channel."""
    mean, deviation = (pixels.new_tensor(values)[:, None, None] for values in statistics)
    return (pixels - mean) / deviation


def unit_or_even_rows(rows: NDArray[np.floating] | NDArray[np.uint8]) -> NDArray[np.float32]:
    """Rows (N, D) scaled to unit length; a row of zeros becomes one of equal components, so that all have it."""
    rows = np.asarray(rows, np.float32)
    lengths = np.linalg.norm(rows, axis=1, keepdims=True)
    even = np.full_like(rows, rows.shape[1] ** -0.5)
    return np.where(lengths > 1e-12, rows / np.maximum(lengths, 1e-12), even).astype(np.float32)


def check_image(image_rgb: Image | None) -> Image:
    """The image itself. Raises ValueError where it is missing or no RGB image of bytes."""
    if image_rgb is None or image_rgb.ndim != 3 or image_rgb.shape[2] != 3 or image_rgb.dtype != np.uint8:
        found = "none" if image_rgb is None else f"{image_rgb.shape} of {image_rgb.dtype}"
        raise ValueError(f"expected an RGB image (H, W, 3) of uint8, got {found}")
    if image_rgb.size == 0:
        raise ValueError(f"expected an image with pixels, got {image_rgb.shape}")
    return image_rgb


def check_features(features: Features | None) -> Features:
    """The features themselves. Raises ValueError where they are missing."""
    if features is None:
        raise ValueError("expected the local features of the image, got none")
    return features


def check_repeatable(samples: Iterable[Any]) -> None:
    """Raises ValueError for an iterator, which would be empty in the second pass."""
    if iter(samples) is samples:
        raise ValueError("expected samples that can be gone through twice, such as a list, got an iterator")


def _resized(image_rgb: Image | None, height: int, width: int) -> torch.Tensor:
    """Bilinear with the triangle as wide as the reduction, and rounded to bytes, as the networks were trained."""
    import torch

    pixels = torch.from_numpy(np.array(check_image(image_rgb), order="C")).permute(2, 0, 1)[None]
    if pixels.shape[2:] != (height, width):
        pixels = torch.nn.functional.interpolate(pixels, (height, width), mode="bilinear", antialias=True)
    return pixels[0].float().div_(255)
