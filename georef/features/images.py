"""Reading photographs as they left the sensor, and refusing files that are not whole."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from georef.errors import InputError
from georef.pictures import LARGEST_PX, open_picture

_JPEG_END = b"\xff\xd9"


class UnreadableImage(InputError):
    """An image file that is missing, not an image, or incomplete."""


def read_image(path: Path) -> NDArray[np.uint8]:
    """The image (H, W, 3), RGB, uint8, in the sensor's own pixels.

    The EXIF orientation is not applied: exterior orientation and calibration refer to the sensor's rows and columns,
    and a picture that turns itself would swap them without a word. Grey images are repeated to three channels, 16-bit
    grey is brought down to its upper 8 bits, transparency is dropped.

    Raises UnreadableImage for a missing file, something that is not an image, a truncated file (OpenCV would fill the
    missing part with grey and say nothing), and one of more than `LARGEST_PX` pixels.
    """
    try:
        with open_picture(path) as image:
            image.load()  # Pillow raises for a truncated file as long as ImageFile.LOAD_TRUNCATED_IMAGES is False
            pixels = _rgb(image)
            is_jpeg = image.format in ("JPEG", "MPO")
    except FileNotFoundError as error:
        raise UnreadableImage("The image file does not exist.", path=path) from error
    except OSError as error:
        raise UnreadableImage(
            f"The image cannot be read: {error}.",
            expected=f"a complete JPEG, PNG or TIFF file of at most {LARGEST_PX * 1e-6:.0f} megapixels",
            remedy="Copy the file again from its source.",
            path=path,
        ) from error
    if is_jpeg and _has_zero_tail(path):
        raise UnreadableImage(
            "The JPEG ends in zero bytes instead of its end marker.",
            expected="a complete file; an interrupted copy into reserved space looks like this",
            remedy="Copy the file again from its source.",
            path=path,
        )
    return pixels


def turned(pixels: NDArray[np.uint8], quarter_turns: int) -> NDArray[np.uint8]:
    """The image (H, W, 3) turned clockwise."""
    return np.ascontiguousarray(np.rot90(pixels, -quarter_turns))


def _rgb(image: Image.Image) -> NDArray[np.uint8]:
    if image.mode.startswith("I;16"):
        grey = (np.asarray(image).astype(np.uint16) >> 8).astype(np.uint8)
        return np.repeat(grey[:, :, None], 3, axis=2)
    if image.mode in ("I", "F"):
        raise ValueError(f"pixels of type '{image.mode}' have no known range")
    return np.array(image if image.mode == "RGB" else image.convert("RGB"))


def _has_zero_tail(path: Path) -> bool:
    with path.open("rb") as stream:
        size = stream.seek(0, 2)
        stream.seek(max(0, size - 65536))
        tail = stream.read()
    content = tail.rstrip(b"\0")
    return len(tail) - len(content) >= 16 and not content.endswith(_JPEG_END)
