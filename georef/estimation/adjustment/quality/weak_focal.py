"""Focal lengths that images and constraints hardly determine: values to warn of, not errors.

Over flat ground, seen at right angles from one height, a longer focal length and a greater distance give the same
images; a constraint on either, however weak, keeps the network solvable. What image observations say of a focal length
where all else is known, against what the adjustment says of it, tells how much of it was lost to the rest.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from georef.estimation.adjustment.block import Block, Indices, State
from georef.estimation.adjustment.equations.reduced import Layout
from georef.geometry.camera import intrinsic_derivatives
from georef.geometry.rigid import Array

WEAK = 400.0
"""Loss from which on a focal length is called weak. Nine images of 40 points: 2,100 over flat ground, 600 with height
differences of 5 % of the distance, 130 with 20 %, 90 where half of the views slant by 0.4 rad (measured)."""
_SAMPLE = 20_000  # observations of a camera that are looked at


@dataclass(frozen=True)
class WeakFocal:
    camera_id: str
    sigma_px: float  # posterior
    loss: float  # posterior sigma over that with all else known

    def __str__(self) -> str:
        return (
            f"The focal length of camera {self.camera_id!r} is weak: its sigma of {self.sigma_px:.2g} px is "
            f"{self.loss:.0f} times what its images say where all else is known. It trades off with the distance to "
            "the scene, as over flat ground seen from one height.\nAdd views at a slant, from other heights or of "
            "relief, or control together with GNSS positions; or hold it."
        )


def weak_focals(block: Block, state: State, layout: Layout, border_cov: Array) -> tuple[WeakFocal, ...]:
    """Estimated focal lengths with a loss above WEAK. border_cov: (B, B) posterior covariance of the border."""
    of_camera = block.calibration[block.observations.view]
    found = []
    for i, calibration in enumerate(block.calibrations):
        names = calibration.camera.estimate
        if "focal" not in names:
            continue
        place = int(layout.calibration[i]) + names.index("focal")
        sigma = float(np.sqrt(border_cov[place, place]))
        known = 1.0 / np.sqrt(_information(block, state, i, np.flatnonzero(of_camera == i)))
        if sigma > WEAK * known:
            camera = state.cameras[i]
            found.append(WeakFocal(camera.camera_id, sigma * camera.unit("focal"), float(sigma / known)))
    return tuple(found)


def _information(block: Block, state: State, calibration: int, rows: Indices) -> float:
    """What image observations say of the logarithm of a focal length where all else is known."""
    if not len(rows):
        return float(np.finfo(float).tiny)
    sample = rows[:: max(1, len(rows) // _SAMPLE)]
    obs = block.observations.take(sample)
    in_cam = block.views(state).to_cam(obs.view, state.points[obs.point])
    by_focal = intrinsic_derivatives(state.cameras[calibration], in_cam, ("focal",))[:, :, 0] / obs.sigma_px[:, None]
    return float(np.nansum(np.square(by_focal))) * len(rows) / len(sample)
