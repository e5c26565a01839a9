"""Panoramas: directions, heads and what is cut from them."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from georef.features.panorama import cut_head
from georef.geometry.angles import rotation_from_yaw_pitch_roll
from georef.geometry.camera import Camera
from georef.geometry.panorama import (
    FACES,
    RIG_FROM_PANO,
    PanoramaHead,
    Projection,
    directions_from_equirectangular,
    directions_from_face,
    directions_from_head,
    equirectangular_from_directions,
    expected_size,
    face_corner,
    face_from_directions,
    face_size,
    head_from_directions,
    head_pose,
    pixel_grid,
    standard_heads,
)
from georef.geometry.rigid import Array

SIZES: dict[Projection, tuple[int, int]] = {"equirectangular": (2400, 1200), "cube-map": (3600, 600)}
RNG = np.random.default_rng(5)
HEAD_CAMERA = Camera("h", 500, 640, 420.0, 425.0, 251.3, 317.9)


def head(yaw: float, pitch: float, roll: float, place=(0.0, 0.0, 0.0), radius: float = np.inf) -> PanoramaHead:
    return PanoramaHead("h", HEAD_CAMERA, head_pose(np.radians([yaw, pitch, roll]), place), radius)


HEADS = [head(0, 0, 0), head(178, 5, 2), head(-100, -40, 90), head(72, 0, 1, (0.05, 0.0, 0.03), 12.0)]


@pytest.mark.parametrize("given", HEADS)
@pytest.mark.parametrize("projection", SIZES)
def test_a_pixel_goes_to_the_panorama_and_back(given: PanoramaHead, projection: Projection) -> None:
    size = SIZES[projection]
    pixels = RNG.uniform(0, 1, (500, 2)) * [HEAD_CAMERA.width, HEAD_CAMERA.height]
    directions = directions_from_head(given, pixels)
    if projection == "equirectangular":
        again = directions_from_equirectangular(equirectangular_from_directions(directions, size), size)
    else:
        side = face_size(size)
        face, place = face_from_directions(directions, side)
        assert np.all((place >= 0) & (place <= side))
        again = np.array([directions_from_face(int(f), p, side) for f, p in zip(face, place, strict=True)])
    assert np.abs(np.linalg.norm(directions, axis=1) - 1.0).max() < 1e-12
    assert np.abs(head_from_directions(given, again) - pixels).max() < 1e-6


def test_what_is_where_in_a_panorama() -> None:
    """Middle: ahead. A quarter to the right: right. Below the middle: down."""
    size = SIZES["equirectangular"]
    assert np.allclose(directions_from_equirectangular([1200, 600], size), [0, 0, 1])
    assert np.allclose(directions_from_equirectangular([1800, 600], size), [1, 0, 0])
    assert np.allclose(directions_from_equirectangular([600, 600], size), [-1, 0, 0])
    assert directions_from_equirectangular([1200, 700], size)[1] > 0
    looks = [directions_from_face(face, [300, 300], 600) for face in range(len(FACES))]
    assert np.allclose(looks, [[0, 0, 1], [1, 0, 0], [0, 0, -1], [-1, 0, 0], [0, -1, 0], [0, 1, 0]])


def test_faces_adjoin_without_a_step() -> None:
    """The right border of front is the left one of right, and so around; up and down adjoin front."""
    edge = np.linspace(0, 600, 13)
    for face in range(4):
        here = directions_from_face(face, np.column_stack([np.full(13, 600.0), edge]), 600)
        there = directions_from_face((face + 1) % 4, np.column_stack([np.zeros(13), edge]), 600)
        assert np.allclose(here, there)
    top, bottom = (directions_from_face(0, np.column_stack([edge, np.full(13, v)]), 600) for v in (0.0, 600.0))
    assert np.allclose(top, directions_from_face(4, np.column_stack([edge, np.full(13, 600.0)]), 600))
    assert np.allclose(bottom, directions_from_face(5, np.column_stack([edge, np.zeros(13)]), 600))


def test_a_head_is_turned_as_a_camera_on_a_rig() -> None:
    angles = np.radians([72.0, 10.0, -3.0])
    assert np.allclose(RIG_FROM_PANO @ head_pose(angles).rotation, rotation_from_yaw_pitch_roll(angles))
    assert head_pose(np.radians([90.0, 0.0, 0.0])).rotation[:, 2] == pytest.approx([1.0, 0.0, 0.0])


def test_stitching_is_undone_for_points_on_the_sphere() -> None:
    """A point on the sphere stands in the head's own picture where the head saw it, parallax included."""
    given = head(30, 4, 1, (0.06, -0.02, 0.01), 8.0)
    directions = directions_from_head(given, RNG.uniform(50, 450, (200, 2)))
    points = 8.0 * directions
    local = given.pano_from_head.inverse().apply(points)
    seen = local[:, :2] / local[:, 2:] * [420.0, 425.0] + [251.3, 317.9]
    assert np.abs(seen - head_from_directions(given, directions)).max() < 1e-9
    without = head_from_directions(head(30, 4, 1), directions)
    assert 1.0 < np.abs(seen - without).max() < 20.0


def checker(directions: Array) -> Array:
    """Grey values (...) of a smooth checker on the sphere, of no direction's own."""
    x, y, z = np.moveaxis(directions, -1, 0)
    return 128.0 + 100.0 * np.sin(53 * x + 3) * np.sin(59 * y - 1) * np.cos(56 * z + 2)


def painted(projection: Projection, size: tuple[int, int]) -> np.ndarray:
    if projection == "equirectangular":
        grey = checker(directions_from_equirectangular(pixel_grid(*size), size))
    else:
        side, grey = face_size(size), np.zeros((size[1], size[0]))
        for face in range(len(FACES)):
            x, y = face_corner(face, size)
            grey[y : y + side, x : x + side] = checker(directions_from_face(face, pixel_grid(side, side), side))
    return np.repeat(np.round(grey).astype(np.uint8)[..., None], 3, axis=2)


@pytest.mark.parametrize(("projection", "size"), [*SIZES.items(), ("cube-map", (1800, 1200))])
@pytest.mark.parametrize("given", HEADS[:3])
def test_a_cut_head_shows_each_thing_within_a_tenth_of_a_pixel(
    given: PanoramaHead, projection: Projection, size: tuple[int, int]
) -> None:
    """Grey values over slopes tell the shift, over the seam and the borders of faces too."""
    picture = cut_head(painted(projection, size), projection, given)[..., 0].astype(float)
    exact = checker(directions_from_head(given, pixel_grid(HEAD_CAMERA.width, HEAD_CAMERA.height)))
    down, across = np.gradient(exact)
    steep = np.hypot(across, down) > 3.0
    assert steep.mean() > 0.2
    assert np.percentile(np.abs(picture - exact)[steep] / np.hypot(across, down)[steep], 99.5) < 0.4  # rounding: 0.33
    error = picture - exact
    shift = np.linalg.lstsq(np.column_stack([across.ravel(), down.ravel()]), error.ravel(), rcond=None)[0]
    assert np.abs(shift).max() < 0.01  # half a pixel of a wrong convention would show at once
    blocks = [
        np.linalg.lstsq(np.column_stack([a.ravel(), d.ravel()]), e.ravel(), rcond=None)[0]
        for a, d, e in zip(*(tiles(np.asarray(v)) for v in (across, down, error)), strict=True)
    ]
    assert np.abs(blocks).max() < 0.1


def tiles(values: Array) -> list[Array]:
    return [values[y : y + 80, x : x + 80] for y in range(0, 560, 80) for x in range(0, 480, 80)]


def test_a_finer_panorama_is_averaged_not_sampled() -> None:
    """Lines of one pixel in a panorama four times as fine come out grey, without a pattern."""
    panorama = np.zeros((1200, 2400, 3), np.uint8)
    panorama[:, ::2] = 255
    small = PanoramaHead("h", Camera("h", 100, 100, 95.0, 95.0, 50.0, 50.0), head_pose((0.4, 0.0, 0.0)))
    picture = cut_head(panorama, "equirectangular", small)
    assert np.abs(picture.astype(float) - 127.5).max() < 45.0
    assert np.abs(cv2.blur(picture, (5, 5)).astype(float)[5:-5, 5:-5] - 127.5).max() < 12.0


def test_standard_heads_cover_the_horizon() -> None:
    for projection, size in SIZES.items():
        heads = standard_heads(projection, size)
        level = directions_from_equirectangular(
            np.column_stack([np.linspace(0, 2400, 99), np.full(99, 600.0)]), (2400, 1200)
        )
        seen = np.zeros(99, bool)
        for one in heads:
            pixels = head_from_directions(one, level)
            with np.errstate(invalid="ignore"):
                seen |= np.all((pixels >= 0) & (pixels <= [one.camera.width, one.camera.height]), axis=1)
        assert seen.all()
        assert len(heads) == 5


def test_shapes_that_are_no_panorama_are_named() -> None:
    assert expected_size("equirectangular", (2400, 1200)) == ""
    assert "twice as wide" in expected_size("equirectangular", (2400, 1201))
    assert expected_size("cube-map", (3600, 600)) == expected_size("cube-map", (1800, 1200)) == ""
    assert "six faces" in expected_size("cube-map", (2400, 1200))
