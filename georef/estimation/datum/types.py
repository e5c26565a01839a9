"""Paired positions of two sources, and what is found to separate them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from georef.estimation.datum.fine import Shared
from georef.geometry.rigid import Array

Kind = Literal[
    "height offset",
    "height scale",
    "heights reversed",
    "axes swapped",
    "handedness",
    "axes turned",
    "feet",
    "wrong zone",
    "false origin",
    "antenna offset",
    "shift",
    "turn",
    "scale",
    "several",
    "unrelated",
    "undecided",
]


@dataclass(frozen=True, eq=False)
class Paired:
    """N positions of the same things by two sources, in one world frame, in the order of the drive.

    sigma_m (N, 3): of the difference, east, north, up, of errors that each pair has to itself. shared_m: sigma of
    errors that neighbours share, such as the drift of GNSS, over so many pairs (0: there are none). heading_rad (N,):
    of the vehicle, clockwise from north, where there is one. crs_origin_m: easting, northing of the world frame's
    origin, and its latitude, where they are known; geoid_m: height of the geoid above the ellipsoid there.
    """

    first_name: str
    second_name: str
    first: Array  # (N, 3) in world
    second: Array  # (N, 3) in world
    sigma_m: Array  # (N, 3)
    shared_m: float
    shared_over: float
    heading_rad: Array | None = None
    crs_origin_m: tuple[float, float] | None = None
    latitude_rad: float | None = None
    geoid_m: float | None = None

    def __post_init__(self) -> None:
        n = len(self.first)
        shapes = [self.first.shape, self.second.shape, self.sigma_m.shape]
        if shapes != [(n, 3)] * 3 or (self.heading_rad is not None and self.heading_rad.shape != (n,)):
            raise ValueError(f"paired positions of shapes {shapes}: all must be (N, 3), headings (N,)")
        if not (np.isfinite(self.first).all() and np.isfinite(self.second).all() and (self.sigma_m > 0).all()):
            raise ValueError("paired positions must be finite, and their sigmas positive")

    @property
    def shared(self) -> Shared:
        return Shared(self.shared_m, max(self.shared_over, 1e-9))


@dataclass(frozen=True, eq=False)
class Finding:
    """A fault. value and sigma (q,): its size, metres, or radians, or parts; what they are is said in the text.

    alternatives: other faults that would look the same in these positions.
    """

    kind: Kind
    text: str
    remedy: str
    value: Array
    sigma: Array
    alternatives: tuple[str, ...] = ()
