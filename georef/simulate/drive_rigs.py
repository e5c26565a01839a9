"""Rigs of 5 and of 11 cameras for simulated drives: front pair, sides, rear, and a panorama of five fisheye heads."""

from __future__ import annotations

from typing import Literal, cast

import numpy as np

from georef.geometry.camera import Camera
from georef.geometry.poses import Poses
from georef.simulate.rigs import Head, LensDesign

Cameras = Literal[5, 11]
ANTENNA_M = (0.3, -0.6, 2.1)  # in the rig frame
ESTIMATED = ("focal", "cx", "cy", "k1", "k2")

_STEREO, _PANO = ("stereo", 4096, 3000, 79.0), ("pano", 2448, 2048, 112.0)
_BROWN = (-0.06, 0.015, 0.0, 0.0)  # no decentring: every program can then estimate the same parameters
_HEADS = 5


def rig_heads(cameras: Cameras) -> tuple[Head, ...]:
    """The heads, the first of which the mountings of the others refer to."""
    sides = (
        ("left_front", -90.0, 0.9),
        ("right_front", 90.0, 0.9),
        ("left_rear", -91.0, -0.5),
        ("right_rear", 89.0, -0.5),
    )
    heads = [
        _head("front_left", _STEREO, (-0.55, 1.6, 2.3), (-2.0, 2.0, 0.3), 0),
        _head("front_right", _STEREO, (0.55, 1.6, 2.3), (2.0, 2.0, -0.2), 1),
    ]
    for number, (name, yaw, forward) in enumerate(sides[: 2 if cameras == 5 else 4], start=2):
        heads.append(_head(name, _STEREO, (0.6 * np.sign(yaw), forward, 2.2), (yaw, 3.0, 0.1 * number), number))
    if cameras == 5:
        return (*heads, _head("rear", _STEREO, (0.0, -1.4, 2.2), (180.0, 2.0, 0.2), 4))
    for i in range(_HEADS):
        yaw = 36.0 + 360.0 / _HEADS * i
        x, y = 0.06 * np.sin(np.radians(yaw)), 0.06 * np.cos(np.radians(yaw))
        heads.append(_head(f"pano_{i}", _PANO, (x, y + 0.2, 3.0), (yaw, 4.0, 0.3 * (i - 2)), 6 + i))
    return tuple(heads)


def mountings(heads: tuple[Head, ...]) -> Poses:
    """rig_from_cam of each head."""
    return Poses.of(head.rig_from_cam for head in heads)


def cameras_of(heads: tuple[Head, ...]) -> tuple[Camera, ...]:
    """The true calibration of each head."""
    return tuple(_camera(head) for head in heads)


def _camera(head: Head) -> Camera:
    lens = head.design.lens()
    if lens.camera is not None:
        return lens.camera
    fisheye = lens.fisheye
    assert fisheye is not None
    k = (*fisheye.coefficients, 0.0, 0.0, 0.0, 0.0)[:4]
    focal, centre = fisheye.focal_px, (fisheye.cx, fisheye.cy)
    return Camera(head.name, lens.width, lens.height, focal, focal, *centre, distortion=k, model="fisheye")


def _head(
    name: str,
    design: tuple[str, int, int, float],
    position_m: tuple[float, float, float],
    angles_deg: tuple[float, float, float],
    number: int,
) -> Head:
    _, width, height, view_deg = design
    offset = (0.002 * (number % 5 - 2), 0.0015 * ((2 * number) % 5 - 2))
    fisheye = design is _PANO
    lens = LensDesign(name, width, height, view_deg, () if fisheye else _BROWN, offset, fisheye)
    return Head(name, lens, cast("tuple[float, float, float]", tuple(float(v) for v in position_m)), angles_deg)
