"""What an image file says of itself: its size, the focal length, and which way up the camera was held, by EXIF."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np

from georef.pictures import open_picture

log = logging.getLogger(__name__)

_EXIF_SECTION, _FOCAL_35MM, _FOCAL_MM = 0x8769, 0xA405, 0x920A
_PLANE_X_RESOLUTION, _PLANE_UNIT, _PIXEL_WIDTH = 0xA20E, 0xA210, 0xA002
_ORIENTATION = 0x0112
_TURNS = {6: 1, 3: 2, 8: 3}  # quarter turns clockwise by the tag
_DIAGONAL_35MM = float(np.hypot(36.0, 24.0))  # CIPA DCG-001: the equivalent focal length goes by the diagonal
_UNIT_MM = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}
_SHORTEST, _LONGEST = 0.2, 30.0  # of the longer side; beyond, the tags are wrong


def image_size(path: Path) -> tuple[int, int]:
    """Width and height of the picture as it is stored.

    Raises OSError for a file that is missing, no image, or too large.
    """
    with open_picture(path) as image:
        return image.size


def size_and_focal(path: Path) -> tuple[tuple[int, int], float | None]:
    """Width and height, and the focal length in pixels by EXIF: None where it says none that can be.

    From FocalLengthIn35mmFilm, else from FocalLength and the resolution of the focal plane, scaled where the picture
    was made smaller since. Raises OSError for a file that is missing, no image, or too large.
    """
    with open_picture(path) as image:
        size, tags = image.size, dict(image.getexif().get_ifd(_EXIF_SECTION))
    focal = _focal_px(tags, size)
    if focal is not None and not _SHORTEST * max(size) < focal < _LONGEST * max(size):
        log.warning("%s: EXIF states a focal length of %.0f px, which cannot be", path, focal)
        focal = None
    return size, focal


def stated_quarter_turns(path: Path) -> int:
    """Quarter turns clockwise that EXIF says make the picture upright: 0 where it says nothing, or a mirror image.

    Raises OSError for a file that is missing, no image, or too large.
    """
    with open_picture(path) as image:
        orientation = image.getexif().get(_ORIENTATION)
    return _TURNS.get(orientation, 0) if isinstance(orientation, int) else 0


def _focal_px(tags: dict[int, object], size: tuple[int, int]) -> float | None:
    equivalent = _number(tags.get(_FOCAL_35MM))
    if equivalent:
        return equivalent / _DIAGONAL_35MM * float(np.hypot(*size))
    focal_mm, resolution = _number(tags.get(_FOCAL_MM)), _number(tags.get(_PLANE_X_RESOLUTION))
    unit_mm = _UNIT_MM.get(int(_number(tags.get(_PLANE_UNIT)) or 2))
    if not focal_mm or not resolution or unit_mm is None:
        return None
    taken_width = _number(tags.get(_PIXEL_WIDTH)) or size[0]
    return focal_mm / unit_mm * resolution * size[0] / taken_width


def _number(value: object) -> float | None:
    """A positive finite number, or None."""
    try:
        number = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return number if np.isfinite(number) and number > 0 else None
