"""Opening image files with Pillow, panoramas of hundreds of megapixels among them."""

from __future__ import annotations

import struct
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from PIL import Image as PillowImage

LARGEST_PX = 2**30  # pixels of an image: 3 GiB in memory; a stitched panorama of 20,000 x 10,000 has 2e8
_limit = threading.Lock()
_OF_PILLOW = (  # its kinds of error for a damaged file, beside OSError
    *(ArithmeticError, EOFError, LookupError, SyntaxError, TypeError, ValueError, struct.error),
    *(PillowImage.DecompressionBombError, PillowImage.DecompressionBombWarning),
)


@contextmanager
def open_picture(path: Path) -> Iterator[PillowImage.Image]:
    """The picture, its header read and its pixels not yet.

    Raises FileNotFoundError for a file that is missing, OSError for one that is no image, is damaged where its header
    is read, or has more than `LARGEST_PX` pixels. What Pillow raises of other kinds, here or while the picture is used
    inside the block, comes as OSError too.
    """
    try:
        with _open(path) as image:
            width, height = image.size
            if width * height > LARGEST_PX:
                raise OSError(f"it has {width} x {height} pixels, more than {LARGEST_PX:,} in all")
            yield image
    except _OF_PILLOW as error:
        raise OSError(str(error)) from error


def _open(path: Path) -> PillowImage.Image:
    """Pillow refuses 179 megapixels and more by a limit of the whole process, which is raised for this call alone."""
    with _limit:
        before = PillowImage.MAX_IMAGE_PIXELS
        PillowImage.MAX_IMAGE_PIXELS = LARGEST_PX
        try:
            return PillowImage.open(path)
        finally:
            PillowImage.MAX_IMAGE_PIXELS = before
