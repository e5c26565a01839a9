"""Cuts pinhole heads out of panoramas: one resampling, averaged where the panorama is finer than the head."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from georef.geometry.panorama import (
    FACES,
    PanoramaHead,
    Projection,
    directions_from_face,
    directions_from_head,
    equirectangular_from_directions,
    face_corner,
    face_from_directions,
    face_size,
    pixel_grid,
    samples_needed,
)
from georef.geometry.rigid import Array

Rgb = NDArray[np.uint8]
_BORDER = 4  # pixels around a picture that the interpolation may reach for
_ROWS = 256  # of a head at a time: bounds the memory


def cut_head(panorama: Rgb, projection: Projection, head: PanoramaHead) -> Rgb:
    """The picture (H, W, 3) that a head shows of a panorama."""
    return cut_heads(panorama, projection, (head,))[0]


def cut_heads(panorama: Rgb, projection: Projection, heads: tuple[PanoramaHead, ...]) -> list[Rgb]:
    """The pictures of several heads; see cut_head."""
    source = _Equirectangular(panorama) if projection == "equirectangular" else _CubeMap(panorama)
    return [_cut(source, head) for head in heads]


def _cut(source: _Equirectangular | _CubeMap, head: PanoramaHead) -> Rgb:
    camera = head.camera
    samples = samples_needed(head, source.locate)
    out = np.empty((camera.height, camera.width, 3), np.uint8)
    for first in range(0, camera.height, _ROWS):
        rows = min(_ROWS, camera.height - first)
        pixels = pixel_grid(camera.width, rows, samples) + np.array([0.0, first])
        fine = source.sample(directions_from_head(head, pixels))
        out[first : first + rows] = _averaged(fine, samples)
    return out


def _averaged(fine: Rgb, samples: int) -> Rgb:
    if samples == 1:
        return fine
    rows, columns = fine.shape[0] // samples, fine.shape[1] // samples
    return cv2.resize(fine, (columns, rows), interpolation=cv2.INTER_AREA).astype(np.uint8)


class _Equirectangular:
    """Its picture, continued over the seam and over the poles."""

    def __init__(self, panorama: Rgb) -> None:
        self.size = panorama.shape[1], panorama.shape[0]
        half = self.size[0] // 2
        beyond_top = np.roll(panorama[:_BORDER][::-1], half, axis=1)  # over a pole, the other side comes down
        beyond_bottom = np.roll(panorama[-_BORDER:][::-1], half, axis=1)
        tall = np.concatenate([beyond_top, panorama, beyond_bottom])
        self.padded = np.concatenate([tall[:, -_BORDER:], tall, tall[:, :_BORDER]], axis=1)

    def locate(self, directions: Array) -> Array:
        return equirectangular_from_directions(directions, self.size)

    def sample(self, directions: Array) -> Rgb:
        return _sampled(self.padded, self.locate(directions) + _BORDER)


class _CubeMap:
    """Its six faces, each continued onto its neighbours."""

    def __init__(self, panorama: Rgb) -> None:
        self.size = panorama.shape[1], panorama.shape[0]
        self.side = face_size(self.size)
        corners = [face_corner(face, self.size) for face in range(len(FACES))]
        faces = [panorama[y : y + self.side, x : x + self.side] for x, y in corners]
        self.faces = [self._continued(face, faces) for face in range(len(FACES))]

    def _continued(self, face: int, faces: list[Rgb]) -> Rgb:
        """A face with a border, which is taken from its neighbours (bilinear: it only supports the interpolation)."""
        side = self.side + 2 * _BORDER
        out = np.zeros((side, side, 3), np.uint8)
        out[_BORDER:-_BORDER, _BORDER:-_BORDER] = faces[face]
        pixels = pixel_grid(side, side) - _BORDER
        outside = ~np.all((pixels > 0) & (pixels < self.side), axis=-1)
        neighbour, place = face_from_directions(directions_from_face(face, pixels[outside], self.side), self.side)
        colours = np.zeros((len(neighbour), 3), np.uint8)
        for other in np.unique(neighbour):
            here = neighbour == other
            colours[here] = _sampled(faces[other], place[here][None], cv2.INTER_LINEAR)[0]
        out[outside] = colours
        return out

    def locate(self, directions: Array) -> Array:
        face, place = face_from_directions(directions, self.side)
        return place + np.array([face_corner(k, self.size) for k in range(len(FACES))])[face]

    def sample(self, directions: Array) -> Rgb:
        face, place = face_from_directions(directions, self.side)
        out = np.zeros((*face.shape, 3), np.uint8)
        for k in np.unique(face):
            here = face == k
            out[here] = _sampled(self.faces[k], place[here][None] + _BORDER)[0]
        return out


def _sampled(picture: Rgb, places: Array, interpolation: int = cv2.INTER_CUBIC) -> Rgb:
    """Colours (h, w, 3) at places (h, w, 2), whose pixel centres are at halves; OpenCV's are at whole numbers.

    A long list of places is folded: OpenCV takes no picture of more than 32,767 columns.
    """
    count, columns = places.shape[0] * places.shape[1], 16384
    flat = places.reshape(-1, 2)
    rows = -(-count // columns)
    folded = np.full((rows * columns, 2), -_BORDER, np.float32)
    folded[:count] = flat - 0.5
    x, y = (np.ascontiguousarray(folded[:, k].reshape(rows, columns)) for k in (0, 1))
    colours = cv2.remap(picture, x, y, interpolation, borderMode=cv2.BORDER_REPLICATE)
    return colours.reshape(-1, 3)[:count].reshape(*places.shape[:2], 3).astype(np.uint8)
