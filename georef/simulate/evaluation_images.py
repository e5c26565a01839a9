"""The images of an evaluation: photographs as they are, undistorted ones, and panoramas stitched from their heads."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image as PillowImage

from georef.geometry.camera import Camera
from georef.geometry.panorama import (
    FACES,
    PanoramaHead,
    Projection,
    directions_from_equirectangular,
    directions_from_face,
    face_corner,
    face_size,
    head_from_directions,
    pixel_grid,
)
from georef.geometry.rigid import Array
from georef.io.files import write_bytes_atomically
from georef.simulate.evaluation import (
    FIRST_REFERENCE,
    PANORAMA_REFERENCE,
    PANORAMAS,
    EvaluationOptions,
    EvaluationWorld,
    panorama_heads,
    panorama_id,
)
from georef.simulate.lenses import Lens

Rgb = NDArray[np.uint8]
PHONES = ("phone",)  # whose files say the focal length in EXIF, and nothing else does
UNDISTORTED = "vehicle_undistorted"
_DISTORTED = "vehicle"
_JPEG_QUALITY = 95
_EXIF_SECTION, _FOCAL_35MM, _DIAGONAL_35MM = 0x8769, 0xA405, 43.2666


@dataclass(frozen=True)
class Product:
    """A file that is delivered: its epoch, its id there (below the epoch's folder), and its station and camera."""

    epoch: str
    image_id: str
    station: int
    camera: str

    @property
    def file(self) -> str:
        return f"{self.epoch}/{self.image_id}"


def products(world: EvaluationWorld) -> list[Product]:
    """All files, the undistorted ones last: they are made from others. Files of "2023" lie in folders by camera."""
    out = []
    for name in world.rigs:
        if name in PANORAMAS:
            stations = range(len(world.trajectories[name]))
            out += [Product(name, panorama_id(name, i), i, "panorama") for i in stations]
            continue
        for image in world.images_of(name):
            folder = f"{image.lens.name}/" if name == FIRST_REFERENCE else ""
            out.append(Product(name, folder + image.image_id, image.station, image.lens.name))
    vehicle = [product for product in out if product.epoch == _DISTORTED]
    return out + [Product(UNDISTORTED, p.image_id, p.station, p.camera) for p in vehicle]


def panorama_layout(campaign: str, heads: Sequence[PanoramaHead]) -> tuple[Projection, tuple[int, int]]:
    """How a campaign's panoramas are delivered: cube maps or equirectangular, a little finer than their heads."""
    focal = heads[0].camera.fx
    if campaign == PANORAMA_REFERENCE:
        side = int(np.ceil(1.15 * 2.0 * focal / 32.0)) * 32
        return "cube-map", (6 * side, side)
    height = int(np.ceil(1.15 * np.pi * focal / 32.0)) * 32
    return "equirectangular", (2 * height, height)


@dataclass(frozen=True)
class ProductTask:
    """Makes one file; from the options alone, so that it can travel to a process."""

    options: EvaluationOptions
    folder: Path

    @cached_property
    def world(self) -> EvaluationWorld:
        return EvaluationWorld(self.options)

    @cached_property
    def products(self) -> dict[str, Product]:
        return {product.file: product for product in products(self.world)}

    def __call__(self, file: str) -> str:
        product = self.products[file]
        data = _jpeg(self._pixels(product), self._focal_35mm(product))
        write_bytes_atomically(data, self.folder / file)
        return file

    def _pixels(self, product: Product) -> Rgb:
        if product.epoch == UNDISTORTED:
            lens = self.world.images[Path(product.image_id).name].lens
            assert lens.camera is not None
            with PillowImage.open(self.folder / _DISTORTED / product.image_id) as image:
                return undistorted(np.array(image.convert("RGB")), lens)
        if product.epoch in PANORAMAS:
            return self._panorama(product)
        return self.world.render_image(Path(product.image_id).name)

    def _panorama(self, product: Product) -> Rgb:
        images = self.world.images_of(product.epoch)
        pictures = {i.head.name: self.world.render_image(i.image_id) for i in images if i.station == product.station}
        return stitched(pictures, _stitching(self.options, product.epoch))

    def _focal_35mm(self, product: Product) -> int | None:
        if product.epoch not in PHONES:
            return None
        lens = self.world.images[Path(product.image_id).name].lens
        assert lens.camera is not None
        return round(lens.camera.fx / float(np.hypot(lens.width, lens.height)) * _DIAGONAL_35MM)

    def __getstate__(self) -> dict[str, Any]:
        return {"options": self.options, "folder": self.folder}


@lru_cache(maxsize=2)
def _stitching(options: EvaluationOptions, campaign: str) -> Stitching:
    heads = panorama_heads(EvaluationWorld(options).rigs[campaign])
    return stitching(heads, *panorama_layout(campaign, heads))


@dataclass(frozen=True, eq=False)
class Stitching:
    """For each pixel of a panorama: which head shows it (-1: none), and where (H, W, 2)."""

    heads: tuple[str, ...]
    source: NDArray[np.intp]
    pixels: NDArray[np.float32]


def stitching(heads: Sequence[PanoramaHead], projection: Projection, size: tuple[int, int]) -> Stitching:
    """Each direction is shown by the head that looks most nearly there."""
    directions = panorama_directions(projection, size)
    best = np.full(directions.shape[:2], -1)
    nearest = np.full(directions.shape[:2], -1.0)
    place = np.zeros((*directions.shape[:2], 2), np.float32)
    for number, head in enumerate(heads):
        pixels = head_from_directions(head, directions)
        cosine = directions @ head.pano_from_head.rotation[:, 2]
        with np.errstate(invalid="ignore"):
            inside = np.all((pixels > 0.5) & (pixels < [head.camera.width - 0.5, head.camera.height - 0.5]), axis=-1)
        better = inside & (cosine > nearest)
        best[better], nearest[better], place[better] = number, cosine[better], pixels[better]
    return Stitching(tuple(head.name for head in heads), best, place)


def stitched(pictures: Mapping[str, Rgb], plan: Stitching) -> Rgb:
    """The panorama (H, W, 3); black where no head sees anything."""
    out = np.zeros((*plan.source.shape, 3), np.uint8)
    for number, name in enumerate(plan.heads):
        shown = plan.source == number
        out[shown] = _sampled(pictures[name], plan.pixels)[shown]
    return out


def panorama_directions(projection: Projection, size: tuple[int, int]) -> Array:
    """Unit directions (H, W, 3) of all pixels of a panorama of (width, height)."""
    if projection == "equirectangular":
        return directions_from_equirectangular(pixel_grid(*size), size)
    side = face_size(size)
    out = np.zeros((size[1], size[0], 3))
    for face in range(len(FACES)):
        left, upper = face_corner(face, size)
        out[upper : upper + side, left : left + side] = directions_from_face(face, pixel_grid(side, side), side)
    return out


def undistorted(pixels: Rgb, lens: Lens) -> Rgb:
    """The picture as a pinhole of the same calibration matrix would have taken it."""
    plain = Lens(lens.name, lens.width, lens.height, pinhole_of(lens))
    grid = pixel_grid(lens.width, lens.height)
    observed = lens.project(plain.rays(grid.reshape(-1, 2))).reshape(grid.shape)
    return _sampled(pixels, np.nan_to_num(observed, nan=-10.0).astype(np.float32))


def pinhole_of(lens: Lens) -> Camera:
    """The camera of an undistorted picture."""
    c = lens.camera
    assert c is not None
    return Camera(c.camera_id, c.width, c.height, c.fx, c.fy, c.cx, c.cy)


def _sampled(pixels: Rgb, places: NDArray[np.float32]) -> Rgb:
    """Colours at places (H, W, 2), whose pixel centres are at halves; OpenCV's are at whole numbers."""
    x, y = np.ascontiguousarray(places[..., 0] - 0.5), np.ascontiguousarray(places[..., 1] - 0.5)
    return cv2.remap(pixels, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_CONSTANT).astype(np.uint8)


def _jpeg(pixels: Rgb, focal_35mm: int | None) -> bytes:
    buffer = io.BytesIO()
    exif = PillowImage.Exif()
    if focal_35mm is not None:
        exif.get_ifd(_EXIF_SECTION)[_FOCAL_35MM] = focal_35mm
    PillowImage.fromarray(pixels).save(buffer, "JPEG", quality=_JPEG_QUALITY, exif=exif)
    return buffer.getvalue()
