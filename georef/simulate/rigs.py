"""Camera systems: what is mounted where on a vehicle or carried by hand, and how it is triggered.

The frame `rig` has its origin on the road below the middle of the system, x right, y forward, z up. A head is turned
by yaw (clockwise from forward), pitch (up) and roll about its optical axis.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np

from georef.geometry.angles import rotation_from_yaw_pitch_roll
from georef.geometry.camera import Camera
from georef.geometry.rigid import Array, Rigid3
from georef.simulate.lenses import Fisheye, Lens

RigSize = Literal["small", "large"]
_PANORAMA_HEADS, _PANORAMA_RADIUS_M, _PANORAMA_HEIGHT_M = 5, 0.06, 3.0
_FISHEYE_K1 = -0.01


@dataclass(frozen=True)
class LensDesign:
    """A lens by what a data sheet says of it; principal point and distortion as a calibration finds them."""

    name: str
    width: int
    height: int
    view_deg: float  # across the width; of a fisheye across the diagonal
    distortion: tuple[float, ...] = ()  # k1, k2, p1, p2 of Brown's model; none: delivered undistorted
    principal_offset: tuple[float, float] = (0.0, 0.0)  # from the middle, as shares of width and height
    fisheye: bool = False

    def scaled(self, scale: float) -> LensDesign:
        """The same lens on a sensor of other resolution."""
        width, height = max(16, round(self.width * scale)), max(16, round(self.height * scale))
        return replace(self, width=width, height=height)

    @property
    def centre(self) -> tuple[float, float]:
        return self.width * (0.5 + self.principal_offset[0]), self.height * (0.5 + self.principal_offset[1])

    @property
    def focal_px(self) -> float:
        half = np.radians(self.view_deg) / 2.0
        if not self.fisheye:
            return float(self.width / 2.0 / np.tan(half))
        return float(np.hypot(self.width, self.height) / 2.0 / (half * (1.0 + _FISHEYE_K1 * half**2)))

    def lens(self) -> Lens:
        """The exact projection."""
        cx, cy = self.centre
        if self.fisheye:
            fisheye = Fisheye(self.focal_px, cx, cy, (_FISHEYE_K1,), float(np.radians(self.view_deg)) * 0.52)
            return Lens(self.name, self.width, self.height, fisheye=fisheye)
        f = self.focal_px
        camera = Camera(self.name, self.width, self.height, f, f, cx, cy, self.distortion)
        return Lens(self.name, self.width, self.height, camera=camera)


@dataclass(frozen=True)
class Head:
    """One camera of a rig."""

    name: str
    design: LensDesign
    position_in_rig_m: tuple[float, float, float]
    yaw_pitch_roll_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @property
    def rig_from_cam(self) -> Rigid3:
        rotation = rotation_from_yaw_pitch_roll(np.radians(self.yaw_pitch_roll_deg))
        return Rigid3(rotation, np.array(self.position_in_rig_m))


@dataclass(frozen=True)
class Rig:
    """Heads that are triggered together, the antenna whose position is measured, and how the rig is moved."""

    name: str
    heads: tuple[Head, ...]
    antenna_in_rig_m: tuple[float, float, float]
    spacing_m: float  # between triggers
    lateral_m: float  # of the path from the street's axis, to the right
    start_m: float = 4.0  # first trigger, along the axis
    handheld: bool = False  # walks: sways more than a vehicle

    @cached_property
    def lenses(self) -> dict[str, Lens]:
        """Lens of each head."""
        return {head.name: head.design.lens() for head in self.heads}

    @property
    def antenna(self) -> Array:
        return np.array(self.antenna_in_rig_m)


def first_rig(size: RigSize = "small", scale: float = 1.0) -> Rig:
    """The reference survey: undistorted images of calibrated cameras. large: 11 heads a station; small: three."""
    wide = LensDesign("front", 1440, 1024, 79.0)
    if size == "small":
        heads = (
            _head("front_left", wide, scale, (-0.55, 1.6, 2.3), (-2.0, 2.0, 0.3), (0.004, -0.003)),
            _head("front_right", wide, scale, (0.55, 1.6, 2.3), (2.0, 2.0, -0.2), (-0.003, 0.002)),
            _head("side", wide, scale, (0.06, 0.2, _PANORAMA_HEIGHT_M), (72.0, 5.0, 0.2), (0.002, 0.004)),
        )
        return Rig("first", heads, (0.3, -0.6, 2.1), 4.0, 1.7)
    design = LensDesign("stereo", 4096, 3000, 79.0)
    heads = (
        _head("front_left", design, scale, (-0.55, 1.6, 2.3), (-2.0, 2.0, 0.3), (0.004, -0.003)),
        _head("front_right", design, scale, (0.55, 1.6, 2.3), (2.0, 2.0, -0.2), (-0.003, 0.002)),
        _head("right_front", design, scale, (0.6, 0.9, 2.2), (90.0, 3.0, 0.1), (0.001, 0.003)),
        _head("right_rear", design, scale, (0.6, -0.5, 2.2), (90.0, 3.0, -0.3), (-0.002, -0.001)),
        _head("rear_left", design, scale, (-0.5, -1.4, 2.2), (178.0, 2.0, 0.2), (0.003, 0.001)),
        _head("rear_right", design, scale, (0.5, -1.4, 2.2), (182.0, 2.0, -0.1), (-0.001, 0.002)),
        *_panorama(scale, ()),
    )
    return Rig("first", heads, (0.3, -0.6, 2.1), 4.0, 1.7)


def second_rig(size: RigSize = "small", scale: float = 1.0) -> Rig:
    """The new epoch, cameras with distortion. large: a front camera and the panorama; small: two heads of one kind."""
    brown = (-0.06, 0.015, 2e-4, -1e-4)
    if size == "small":
        design = LensDesign("second", 1440, 1024, 76.0, brown, (0.004, -0.006))
        heads = (
            _head("front", design, scale, (0.1, 1.5, 2.2), (1.5, 1.0, 0.4)),
            _head("side", design, scale, (0.05, 0.1, _PANORAMA_HEIGHT_M), (66.0, 4.0, -0.3)),
        )
        return Rig("second", heads, (-0.2, -0.4, 2.05), 4.0, 0.2, start_m=5.5)
    front = LensDesign("front", 4096, 3000, 76.0, brown)
    heads = (
        _head("front", front, scale, (0.1, 1.5, 2.2), (1.5, 1.0, 0.4), (0.004, -0.006)),
        *_panorama(scale, (-0.02, 0.004, -1e-4, 1e-4)),
    )
    return Rig("second", heads, (-0.2, -0.4, 2.05), 4.0, 0.2, start_m=5.5)


def handheld_rigs(scale: float = 1.0) -> tuple[Rig, ...]:
    """A pedestrian with a 24 mm and a 35 mm lens on a full-frame body, an action camera, and a phone held downward."""
    brown = (-0.08, 0.03, 3e-4, -2e-4)
    views = {mm: float(np.degrees(2.0 * np.arctan(18.0 / mm))) for mm in (24, 35)}
    mm24 = LensDesign("mm24", 6000, 4000, views[24], brown, (0.003, 0.002))
    mm35 = LensDesign("mm35", 6000, 4000, views[35], brown, (-0.002, 0.003))
    action = LensDesign("action", 4000, 3000, 120.0, (), (0.002, -0.002), fisheye=True)
    phone = LensDesign("phone", 1920, 1440, 66.8, (), (0.004, -0.002))
    carried = (
        ("pedestrian_24", mm24, (35.0, 4.0, 0.0)),
        ("pedestrian_35", mm35, (-40.0, 5.0, 0.0)),
        ("action", action, (0.0, 0.0, 0.0)),
        ("phone", phone, (20.0, -15.0, 1.0)),
    )
    return tuple(
        Rig(name, (_head(name, design, scale, (0.0, 0.25, 1.6), angles),), (0.0, 0.25, 1.6), 1.5, 7.2, handheld=True)
        for name, design, angles in carried
    )


def _head(
    name: str,
    design: LensDesign,
    scale: float,
    position_m: tuple[float, float, float],
    angles_deg: tuple[float, float, float],
    offset: tuple[float, float] | None = None,
) -> Head:
    """A head; with an offset of its principal point it has a calibration, and so a lens, of its own name."""
    if offset is None:
        return Head(name, design.scaled(scale), position_m, angles_deg)
    own = replace(design, name=name, principal_offset=offset)
    return Head(name, own.scaled(scale), position_m, angles_deg)


def _panorama(scale: float, distortion: tuple[float, ...]) -> tuple[Head, ...]:
    """Five upright heads, 72 degrees apart, above the roof."""
    design = LensDesign("pano", 2048, 2448, 80.0, distortion)
    out = []
    for i in range(_PANORAMA_HEADS):
        yaw = 360.0 / _PANORAMA_HEADS * i
        x, y = _PANORAMA_RADIUS_M * np.sin(np.radians(yaw)), _PANORAMA_RADIUS_M * np.cos(np.radians(yaw))
        offset = (0.002 * (i - 2), 0.0015 * ((2 * i) % 5 - 2))
        position = (float(x), float(y) + 0.2, _PANORAMA_HEIGHT_M)
        out.append(_head(f"pano_{i}", design, scale, position, (yaw, 4.0, 0.3 * (i - 2)), offset))
    return tuple(out)
