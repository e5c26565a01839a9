"""The light of an epoch: sun or overcast, the sky's colours, and how much of the sky a point sees."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from georef.geometry.rigid import Array
from georef.simulate.noise import clip, kernel, octaves


@dataclass(frozen=True)
class Light:
    """Irradiances are relative to a horizontal surface under the open sky of an average day."""

    weather: Literal["sun", "overcast"]
    sun_direction: tuple[float, float, float]  # towards the sun, unit
    sun_colour: tuple[float, float, float]
    sky_colour: tuple[float, float, float]  # irradiance of the whole sky on a level surface
    bounce_colour: tuple[float, float, float]  # from streets and walls, wherever the sky is hidden
    damp: float  # 0 dry, 1 wet

    @property
    def has_sun(self) -> bool:
        return max(self.sun_colour) > 0


def _unit(azimuth_deg: float, elevation_deg: float) -> tuple[float, float, float]:
    azimuth, elevation = np.radians(azimuth_deg), np.radians(elevation_deg)
    flat = np.cos(elevation)
    return float(flat * np.sin(azimuth)), float(flat * np.cos(azimuth)), float(np.sin(elevation))


SUNNY = Light("sun", _unit(152.0, 47.0), (1.05, 0.98, 0.86), (0.34, 0.40, 0.50), (0.19, 0.175, 0.155), 0.0)
OVERCAST = Light("overcast", _unit(250.0, 30.0), (0.0, 0.0, 0.0), (0.86, 0.90, 0.95), (0.16, 0.16, 0.155), 0.8)

SKY_SAMPLES = 26


def sky_directions() -> NDArray[np.float32]:
    """Directions (k, 3) evenly spread over the upper hemisphere."""
    k = np.arange(SKY_SAMPLES) + 0.5
    up = k / SKY_SAMPLES
    turn = np.pi * (1 + 5**0.5) * k
    flat = np.sqrt(1 - up * up)
    return np.stack([flat * np.cos(turn), flat * np.sin(turn), up], axis=1).astype(np.float32)


def sky_share(normals: Array, blocked: NDArray[np.bool_]) -> Array:
    """Irradiance (N,) from the sky, 1 for an open level surface; blocked (N, k) says which directions are hidden."""
    directions = sky_directions()
    cosine = np.clip(normals @ directions.T, 0.0, None)
    level = directions[:, 2].sum()
    return np.where(blocked, 0.0, cosine).sum(axis=1) / level


@kernel
def sky_radiance(directions, overcast, out):
    """Linear colour (N, 3) of the sky: a gradient with clouds, at infinity."""
    for n in range(len(directions)):
        x, y, z = directions[n, 0], directions[n, 1], max(directions[n, 2], 0.02)
        u, v = x / (z + 0.18), y / (z + 0.18)
        cloud = octaves(u, v, 0.003, 77, 1.7, 7, 0.55) + 0.25
        haze = (1.0 - z) ** 4
        if overcast:
            tone = 0.78 + 0.10 * cloud - 0.06 * haze
            out[n, 0], out[n, 1], out[n, 2] = tone, tone * 1.01, tone * 1.03
        else:
            c = clip(1.3 * cloud) * 0.75
            r, g, b = 0.20 + 0.42 * haze, 0.36 + 0.34 * haze, 0.66 + 0.16 * haze
            out[n, 0], out[n, 1], out[n, 2] = r + (0.92 - r) * c, g + (0.92 - g) * c, b + (0.93 - b) * c
