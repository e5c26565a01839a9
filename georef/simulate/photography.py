"""From linear light to an 8-bit picture: exposure, white balance, vignetting, noise, the sRGB curve."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Photography:
    """How a picture is taken; everything random follows from the seed.

    exposure is a factor, 1 exposes a daylight street well; shot_noise and read_noise are shares of full scale, the
    former at full scale; vignetting is the loss of light in the corners; motion_blur_m the camera's way in world
    during the exposure.
    """

    exposure: float = 1.0
    white_balance: tuple[float, float, float] = (1.0, 1.0, 1.0)
    vignetting: float = 0.25
    shot_noise: float = 0.012
    read_noise: float = 0.002
    motion_blur_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    seed: int = 0


NOISELESS = Photography(vignetting=0.0, shot_noise=0.0, read_noise=0.0)

_FULL_SCALE, _CURVE_STEPS = 0.72, 4096


def develop(linear: NDArray[np.float32], photography: Photography) -> NDArray[np.uint8]:
    """The picture (H, W, 3), RGB, of linear light (H, W, 3)."""
    gain = np.array(photography.white_balance, np.float32) * np.float32(photography.exposure / _FULL_SCALE)
    light = linear * gain
    if photography.vignetting > 0:
        light *= _vignette(light.shape[0], light.shape[1], photography.vignetting)[..., None]
    light = light / (1.0 + 0.25 * light * light)  # a soft shoulder
    if photography.shot_noise > 0 or photography.read_noise > 0:
        rng = np.random.default_rng([photography.seed, 1])
        noise = rng.standard_normal(light.shape, dtype=np.float32)
        variance = np.maximum(light, 0) * np.float32(photography.shot_noise**2) + np.float32(photography.read_noise**2)
        light += noise * np.sqrt(variance)
    index = np.clip(light * (_CURVE_STEPS - 1) + 0.5, 0, _CURVE_STEPS - 1).astype(np.uint16)
    return _curve()[index]


def _vignette(height: int, width: int, loss: float) -> NDArray[np.float32]:
    x = (np.arange(width, dtype=np.float32) + 0.5 - 0.5 * width) / (0.5 * width)
    y = (np.arange(height, dtype=np.float32) + 0.5 - 0.5 * height) / (0.5 * height)
    radius2 = 0.5 * (x[None] ** 2 + y[:, None] ** 2)
    return (1.0 - loss * radius2).astype(np.float32)


def _curve() -> NDArray[np.uint8]:
    """The sRGB curve of 0..1 as a table."""
    x = np.linspace(0, 1, _CURVE_STEPS)
    y = np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.maximum(x, 1e-9) ** (1 / 2.4) - 0.055)
    return np.round(255 * y).astype(np.uint8)
