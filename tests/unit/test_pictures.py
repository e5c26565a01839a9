"""Opening image files: large panoramas are read, what is beyond all measure is refused, Pillow's limit stays."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from PIL import Image as PillowImage

from georef import pictures
from georef.features.images import UnreadableImage, read_image
from georef.io.exif import image_size, size_and_focal
from georef.pictures import open_picture
from georef.stages.cameras import unknown_camera


def write_header(path: Path, width: int, height: int) -> None:
    """A PNG of one bit a pixel that has a header and the first of its pixels."""
    header = struct.pack(">IIBBBBB", width, height, 1, 0, 0, 0, 0)
    chunks = [_chunk(b"IHDR", header), _chunk(b"IDAT", zlib.compress(b"\0")), _chunk(b"IEND", b"")]
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(chunks))


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


@pytest.fixture
def panorama(tmp_path: Path) -> Path:
    """20,000 x 10,000 pixels, above the limit that Pillow has for a whole process."""
    with PillowImage.new("1", (20000, 10000)) as image:
        image.save(tmp_path / "panorama.png")
    return tmp_path / "panorama.png"


def test_a_panorama_of_200_megapixels_is_opened(panorama: Path) -> None:
    with pytest.raises(PillowImage.DecompressionBombError):
        PillowImage.open(panorama)
    assert image_size(panorama) == (20000, 10000)
    assert size_and_focal(panorama) == ((20000, 10000), None)
    with open_picture(panorama) as image:
        image.load()
        assert image.size == (20000, 10000)
    with pytest.raises(PillowImage.DecompressionBombError):  # for others it is what it was
        PillowImage.open(panorama)


def test_an_image_above_pillows_limit_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pixels = np.random.default_rng(0).integers(0, 256, (48, 64, 3), np.uint8)
    PillowImage.fromarray(pixels).save(tmp_path / "a.png")
    monkeypatch.setattr(PillowImage, "MAX_IMAGE_PIXELS", 100)
    np.testing.assert_array_equal(read_image(tmp_path / "a.png"), pixels)
    assert PillowImage.MAX_IMAGE_PIXELS == 100


@pytest.mark.filterwarnings("ignore::PIL.Image.DecompressionBombWarning")
@pytest.mark.parametrize("height", [40_000, 90_000])  # Pillow warns of the first and refuses the second
def test_more_than_a_gigapixel_is_refused(tmp_path: Path, height: int) -> None:
    write_header(tmp_path / "a.png", 40_000, height)
    with pytest.raises(OSError, match=f"{height}|{40_000 * height}"):
        image_size(tmp_path / "a.png")
    with pytest.raises(UnreadableImage, match="at most 1074 megapixels"):
        read_image(tmp_path / "a.png")
    assert unknown_camera(tmp_path / "a.png", ("focal",)).width == 65536  # of any size: it is rejected where it is read


def test_other_errors_while_a_picture_is_used_are_of_the_file(tmp_path: Path) -> None:
    PillowImage.new("L", (4, 4)).save(tmp_path / "a.png")
    for error in (SyntaxError("broken"), struct.error("broken"), KeyError("broken")):
        with pytest.raises(OSError, match="broken"), open_picture(tmp_path / "a.png"):
            raise error
    with pytest.raises(FileNotFoundError), open_picture(tmp_path / "none.png"):
        pass
    with pytest.raises(MemoryError), open_picture(tmp_path / "a.png"):
        raise MemoryError
    assert pictures.LARGEST_PX > 200e6
