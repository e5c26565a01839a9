"""Reading images: whole files only, the sensor's own pixels."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from georef.features.images import UnreadableImage, read_image


@pytest.fixture
def pixels() -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, (48, 64, 3), np.uint8)


def test_a_png_comes_back_as_it_was(tmp_path: Path, pixels: np.ndarray) -> None:
    Image.fromarray(pixels).save(tmp_path / "a.png")
    np.testing.assert_array_equal(read_image(tmp_path / "a.png"), pixels)


def test_the_orientation_tag_turns_nothing(tmp_path: Path, pixels: np.ndarray) -> None:
    exif = Image.Exif()
    exif[0x0112] = 6  # turn by 90 degrees for display
    Image.fromarray(pixels).save(tmp_path / "a.jpg", exif=exif)
    assert read_image(tmp_path / "a.jpg").shape == (48, 64, 3)


@pytest.mark.parametrize("part", [0.3, 0.9, 0.99])
@pytest.mark.parametrize("kind", ["jpg", "png"])
def test_a_truncated_file_is_refused(tmp_path: Path, pixels: np.ndarray, part: float, kind: str) -> None:
    path = tmp_path / f"a.{kind}"
    Image.fromarray(pixels).save(path)
    content = path.read_bytes()
    path.write_bytes(content[: int(part * len(content))])
    with pytest.raises(UnreadableImage, match="a complete JPEG"):
        read_image(path)


def test_a_copy_that_stopped_in_reserved_space_is_refused(tmp_path: Path, pixels: np.ndarray) -> None:
    path = tmp_path / "a.jpg"
    Image.fromarray(pixels).save(path)
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2].ljust(len(content), b"\0"))
    with pytest.raises(UnreadableImage):
        read_image(path)


def test_bytes_after_the_end_of_a_jpeg_do_no_harm(tmp_path: Path, pixels: np.ndarray) -> None:
    path = tmp_path / "a.jpg"
    Image.fromarray(pixels).save(path)
    for tail in (b"\0" * 100, b"some maker's own data"):
        (tmp_path / "b.jpg").write_bytes(path.read_bytes() + tail)
        np.testing.assert_array_equal(read_image(tmp_path / "b.jpg"), read_image(path))


def test_what_is_no_image_is_refused_with_its_path(tmp_path: Path) -> None:
    (tmp_path / "a.jpg").write_text("text")
    with pytest.raises(UnreadableImage, match=r"a\.jpg"):
        read_image(tmp_path / "a.jpg")
    with pytest.raises(UnreadableImage, match="does not exist"):
        read_image(tmp_path / "b.jpg")
    with pytest.raises(UnreadableImage):
        read_image(tmp_path)


@pytest.mark.parametrize("mode", ["L", "RGBA", "P", "CMYK", "LA"])
def test_other_kinds_of_pixels_become_rgb(tmp_path: Path, pixels: np.ndarray, mode: str) -> None:
    path = tmp_path / ("a.tif" if mode == "CMYK" else "a.png")
    Image.fromarray(pixels).convert(mode).save(path)
    image = read_image(path)
    assert image.shape == (48, 64, 3)
    assert image.dtype == np.uint8


def test_sixteen_bits_keep_their_upper_eight(tmp_path: Path) -> None:
    Image.fromarray(np.full((20, 30), 40000, np.uint16)).save(tmp_path / "a.png")
    assert (read_image(tmp_path / "a.png") == 40000 // 256).all()
