"""Panoramas: pixels of equirectangular images and cube maps <-> directions, and the pinhole heads cut from them.

The frame `pano` is that of a camera which looks at the middle of the panorama: x right, y down, z forward. Pixels are
of the whole image, the centre of the top-left pixel is (0.5, 0.5).

- equirectangular: twice as wide as high. Longitude (u / width - 1/2) 2 pi to the right, latitude (v / height - 1/2) pi
  downwards; direction (sin lon cos lat, sin lat, cos lon cos lat).
- cube map: six square faces of 90 degrees in the order front, right, back, left, up, down, in one row of six or in two
  rows of three. Up and down adjoin the front face: its upper edge is the lower edge of up.

A panorama that was stitched from several heads shows what stood on a sphere about its origin as that head saw it. With
the radius of the sphere and the places of the heads, a head's own picture comes back without parallax.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from georef.geometry.angles import rotation_from_yaw_pitch_roll
from georef.geometry.camera import Camera
from georef.geometry.rigid import Array, Rigid3

Projection = Literal["equirectangular", "cube-map"]
FACES = ("front", "right", "back", "left", "up", "down")
RIG_FROM_PANO = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""Rig axes (x right, y forward, z up) from axes of the panorama (x right, y down, z forward)."""

_X, _Y, _Z = np.eye(3)
_FACE_AXES = np.array(  # pano_from_face: columns are the face's right, down and viewing direction
    [
        np.column_stack([_X, _Y, _Z]),
        np.column_stack([-_Z, _Y, _X]),
        np.column_stack([-_X, _Y, -_Z]),
        np.column_stack([_Z, _Y, -_X]),
        np.column_stack([_X, _Z, -_Y]),
        np.column_stack([_X, -_Z, _Y]),
    ]
)
_STANDARD_HEADS, _STANDARD_HALF_VIEW_RAD = 5, np.radians(45.0)


@dataclass(frozen=True, eq=False)
class PanoramaHead:
    """A pinhole picture that is cut from a panorama.

    stitching_radius_m: of the sphere onto which the panorama was stitched; inf: everything is taken as far away.
    """

    name: str
    camera: Camera
    pano_from_head: Rigid3
    stitching_radius_m: float = field(default=np.inf)


def head_pose(yaw_pitch_roll_rad: ArrayLike, position_in_pano_m: ArrayLike = (0.0, 0.0, 0.0)) -> Rigid3:
    """pano_from_head of angles against the panorama: yaw clockwise from its middle, pitch up, roll clockwise."""
    rotation = RIG_FROM_PANO.T @ rotation_from_yaw_pitch_roll(np.asarray(yaw_pitch_roll_rad, dtype=np.float64))
    return Rigid3(rotation, np.asarray(position_in_pano_m, dtype=np.float64))


def standard_heads(projection: Projection, size: tuple[int, int]) -> tuple[PanoramaHead, ...]:
    """Five level square heads of 90 degrees, 72 degrees apart, as finely resolved as the panorama (width, height)."""
    focal = size[0] / (2.0 * np.pi) if projection == "equirectangular" else face_size(size) / 2.0
    side = max(16, round(2.0 * focal * np.tan(_STANDARD_HALF_VIEW_RAD)))
    out = []
    for i in range(_STANDARD_HEADS):
        yaw_deg = 360 // _STANDARD_HEADS * i
        name = f"head_{yaw_deg:03d}"
        camera = Camera(name, side, side, float(focal), float(focal), side / 2.0, side / 2.0)
        out.append(PanoramaHead(name, camera, head_pose((np.radians(yaw_deg), 0.0, 0.0))))
    return tuple(out)


def expected_size(projection: Projection, size: tuple[int, int]) -> str:
    """What is wrong with the shape (width, height) of a panorama's image: an empty text where it is right."""
    width, height = size
    if projection == "equirectangular":
        return "" if width == 2 * height else "twice as wide as high"
    return "" if width == 6 * height or 2 * width == 3 * height else "six faces in a row, or two rows of three"


def face_size(size: tuple[int, int]) -> int:
    """Side in pixels of a cube map's faces, from its image's (width, height)."""
    width, height = size
    return height if width == 6 * height else height // 2


def face_corner(face: int, size: tuple[int, int]) -> tuple[int, int]:
    """Left and upper border of a face in the image of a cube map of (width, height)."""
    side = face_size(size)
    columns = size[0] // side
    return face % columns * side, face // columns * side


def directions_from_equirectangular(pixels: ArrayLike, size: tuple[int, int]) -> Array:
    """Unit directions (..., 3) in the panorama of pixels (..., 2)."""
    pixels = np.asarray(pixels, dtype=np.float64)
    longitude = (pixels[..., 0] / size[0] - 0.5) * 2.0 * np.pi
    latitude = (pixels[..., 1] / size[1] - 0.5) * np.pi
    flat = np.cos(latitude)
    return np.stack([np.sin(longitude) * flat, np.sin(latitude), np.cos(longitude) * flat], axis=-1)


def equirectangular_from_directions(directions: ArrayLike, size: tuple[int, int]) -> Array:
    """Pixels (..., 2), 0 <= u <= width, of directions (..., 3) of any length."""
    x, y, z = np.moveaxis(np.asarray(directions, dtype=np.float64), -1, 0)
    longitude, latitude = np.arctan2(x, z), np.arctan2(y, np.hypot(x, z))
    return np.stack([(longitude / (2.0 * np.pi) + 0.5) * size[0], (latitude / np.pi + 0.5) * size[1]], axis=-1)


def directions_from_face(face: int, pixels: ArrayLike, side: int) -> Array:
    """Unit directions (..., 3) in the panorama of pixels (..., 2) of one face; pixels beyond its border go on."""
    slopes = 2.0 * np.asarray(pixels, dtype=np.float64) / side - 1.0
    ways = np.concatenate([slopes, np.ones((*slopes.shape[:-1], 1))], axis=-1) @ _FACE_AXES[face].T
    return ways / np.linalg.norm(ways, axis=-1, keepdims=True)


def face_from_directions(directions: ArrayLike, side: int) -> tuple[NDArray[np.intp], Array]:
    """The face (...) that each direction (..., 3) meets, and the pixel (..., 2) in it."""
    ways = np.asarray(directions, dtype=np.float64)
    face = np.argmax(ways @ _FACE_AXES[:, :, 2].T, axis=-1)
    local = np.einsum("...ij,...i->...j", _FACE_AXES[face], ways)
    return face, (local[..., :2] / local[..., 2:] + 1.0) * (side / 2.0)


def directions_from_head(head: PanoramaHead, pixels: ArrayLike) -> Array:
    """Unit directions (..., 3) in the panorama of a head's pixels (..., 2): where it shows what the pixel shows."""
    camera = head.camera
    slopes = (np.asarray(pixels, dtype=np.float64) - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    rays = np.concatenate([slopes, np.ones((*slopes.shape[:-1], 1))], axis=-1) @ head.pano_from_head.rotation.T
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    if not np.isfinite(head.stitching_radius_m):
        return rays
    centre = head.pano_from_head.translation / head.stitching_radius_m
    along = rays @ centre
    reach = -along + np.sqrt(np.square(along) + 1.0 - centre @ centre)
    return centre + reach[..., None] * rays


def head_from_directions(head: PanoramaHead, directions: ArrayLike) -> Array:
    """Pixels (..., 2) of a head of unit directions (..., 3) in the panorama; NaN behind the head."""
    ways = np.asarray(directions, dtype=np.float64)
    if np.isfinite(head.stitching_radius_m):
        ways = ways - head.pano_from_head.translation / head.stitching_radius_m
    local = ways @ head.pano_from_head.rotation
    camera = head.camera
    with np.errstate(divide="ignore", invalid="ignore"):
        slopes = np.where(local[..., 2:] > 0, local[..., :2] / local[..., 2:], np.nan)
    return slopes * [camera.fx, camera.fy] + [camera.cx, camera.cy]


def pixel_grid(width: int, height: int, samples: int = 1) -> Array:
    """Pixels (height * samples, width * samples, 2): the centres of samples x samples equal parts of every pixel."""
    x = (np.arange(width * samples) + 0.5) / samples
    y = (np.arange(height * samples) + 0.5) / samples
    return np.stack(np.meshgrid(x, y), axis=-1)


def samples_needed(head: PanoramaHead, locate: Callable[[Array], Array]) -> int:
    """How many samples a pixel of the head needs along each axis, so that none of the panorama's pixels is passed by.

    locate gives panorama pixels (N, 2) of directions (N, 3). The finest place of the head counts; a step across the
    panorama's seam does not.
    """
    camera = head.camera
    across, down = np.linspace(0.5, camera.width - 0.5, 9), np.linspace(0.5, camera.height - 0.5, 9)
    pixels = np.stack(np.meshgrid(across, down), axis=-1).reshape(-1, 2)
    here = locate(directions_from_head(head, pixels))
    steps = []
    for step in ((0.5, 0.0), (0.0, 0.5)):
        moved = locate(directions_from_head(head, pixels + step)) - here
        steps.append(2.0 * np.linalg.norm(moved, axis=-1))
    largest = float(np.median(np.maximum(*steps)))  # a seam or a pole concerns few of the places
    return max(1, int(np.ceil(largest - 0.25)))
