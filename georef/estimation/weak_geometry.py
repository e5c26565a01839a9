"""Geometry that fixes a pose badly says so: in which direction, by how much, and what it is about the points.

A shift of the camera and a turn move the image alike where all rays are nearly parallel or all points equally far. The
ratio of the position's sigma to the one it would have were the rotation known tells how nearly: it is also by how much
what is systematic in the images (lens, detector) is magnified, which no covariance states.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from georef.estimation.first_pose import QueryImage
from georef.estimation.local_model import LocalModel
from georef.geometry.camera import rays_from_pixels
from georef.geometry.rigid import Array

_WEAK = 20.0  # times; photographs with points all over them have 5 to 15
_NARROW_DEG, _SMALL_SHARE, _FLAT = 12.0, 0.35, 0.01
_AXES = ("to the side", "up and down", "along the viewing direction")


@dataclass(frozen=True)
class Weakness:
    """The direction in which a position is known worst, in the camera frame."""

    direction_in_cam: tuple[float, float, float]  # unit
    sigma_m: float
    magnified: float  # sigma_m over the sigma there were the rotation known

    @property
    def text(self) -> str:
        axis = _AXES[int(np.argmax(np.abs(self.direction_in_cam)))]
        return (
            f"position {axis} known to {self.sigma_m:.3g} m by image noise alone, {self.magnified:.0f} times "
            "what it would be were the rotation known"
        )


def weakness(relative_cov: Array) -> Weakness:
    """The weakest direction of a pose covariance (6, 6) of image noise."""
    of_rotation, mixed, of_position = relative_cov[:3, :3], relative_cov[:3, 3:], relative_cov[3:, 3:]
    values, vectors = np.linalg.eigh(of_position)
    worst = vectors[:, -1]
    known_rotation = of_position - mixed.T @ np.linalg.solve(of_rotation, mixed)
    alone = 1.0 / float(worst @ np.linalg.solve(known_rotation, worst))
    x, y, z = (float(v) for v in worst)
    return Weakness((x, y, z), float(np.sqrt(values[-1])), float(np.sqrt(values[-1] / alone)))


def weak_geometry(relative_cov: Array, query: QueryImage, model: LocalModel) -> str:
    """What is weak about a pose from a model's points, in plain words; empty where nothing is."""
    found = weakness(relative_cov)
    if found.magnified < _WEAK:
        return ""
    return f"weak geometry: {found.text}; " + ", ".join(arrangement(query, model))


def arrangement(query: QueryImage, model: LocalModel) -> list[str]:
    """What of the arrangement of a model's points (at least one) makes a pose weak; how wide they stand if nothing."""
    rays = rays_from_pixels(query.camera, query.pixels[model.keypoint])
    rays = rays[np.isfinite(rays).all(axis=1)]
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    middle = rays.mean(axis=0) if len(rays) else np.array([0.0, 0.0, 1.0])
    cosine = rays @ (middle / max(float(np.linalg.norm(middle)), 1e-12))
    radius = float(np.degrees(np.arccos(np.clip(np.quantile(cosine, 0.1), -1.0, 1.0)))) if len(rays) else 0.0
    wide = f"90 % of {len(model)} points within {radius:.1f} deg of their middle"
    reasons = [wide] if radius < _NARROW_DEG else []
    reasons += _one_side(query, model)
    reasons += _flat(model)
    return reasons or [wide]


def _one_side(query: QueryImage, model: LocalModel) -> list[str]:
    """Whether 90 % of the points lie in a small strip of the image."""
    share = query.pixels[model.keypoint] / [query.camera.width, query.camera.height]
    low, high = np.quantile(share, [0.05, 0.95], axis=0)
    axis = int(np.argmin(high - low))
    if high[axis] - low[axis] >= _SMALL_SHARE:
        return []
    side = ("left", "right") if axis == 0 else ("upper", "lower")
    where = side[0] if high[axis] <= 0.5 else side[1] if low[axis] >= 0.5 else "middle"
    return [f"all in {100 * (high[axis] - low[axis]):.0f} % of the image's {('width', 'height')[axis]} ({where} part)"]


def _flat(model: LocalModel) -> list[str]:
    """Whether the points lie on one plane, or on one line, against how far they are from the references."""
    obs = model.observations
    distance = np.linalg.norm(model.points[obs.point] - model.views.centres[obs.view], axis=1)
    spread = np.linalg.svd(model.points - model.points.mean(axis=0), compute_uv=False) / np.sqrt(max(len(model), 1))
    limit = _FLAT * float(np.median(distance)) if len(distance) else 0.0
    if len(spread) < 3 or spread[1] <= limit:
        return ["all on one line" if len(spread) > 0 and spread[0] > limit else "all in one place"]
    return [f"all on one plane, {np.median(distance):.3g} m away"] if spread[2] <= limit else []
