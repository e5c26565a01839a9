"""Which reference images can help to localize a query: by position, heading, common content and geometry."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from georef.config import CandidatesConfig
from georef.features.nearest import MutualNearest
from georef.geometry.projection import Views
from georef.geometry.rigid import Array
from georef.types.campaign import PositionPrior
from georef.types.features import Features

_VOTE_RATIO = 0.95
_MAX_VIEWING_ANGLE_DEG = 60.0


@dataclass(frozen=True, eq=False)
class Box:
    """The references inside the search box, nearest first; without a box all of them, in their own order."""

    indices: NDArray[np.int64]
    whole_reference: bool
    note: str = ""
    centre: Array | None = None  # (3,) m
    half_side_m: float | None = None


def search_box(
    positions: Array, prior: PositionPrior | None, config: CandidatesConfig, near: Array | None = None
) -> Box:
    """References (of positions (N, 3)) inside a square box about a position prior; widened until there are enough.

    near: (3,) the position to search about where there is no prior, one whose sigma nobody states.

    Half the side is the stated uncertainty ("published"), max(min_half_side, 3 sigma + viewing reach) ("reach"), or
    half_side_m ("fixed"); "none" takes the whole reference, as an image without a prior does. References whose
    position is NaN do not take part.
    """
    everything = np.flatnonzero(np.isfinite(positions[:, :2]).all(axis=1))
    if config.box == "none":
        return Box(everything, True)
    centre = near if prior is None else prior.position_in_world
    if centre is None:
        return Box(everything, True, "no position prior: searched the whole reference")
    offset = np.abs(positions[:, :2] - centre[:2]).max(axis=1)
    asked = _half_side(prior, config)
    half_side, needed = asked, min(config.count, int(np.isfinite(offset).sum()))
    while np.count_nonzero(offset <= half_side) < needed:
        half_side *= 2.0
    inside = np.flatnonzero(offset <= half_side)
    note = ""
    if half_side > asked:
        found = np.count_nonzero(offset <= asked)
        note = f"search box widened from {asked:.1f} to {half_side:.1f} m half side: {found} of {needed} references"
    order = np.argsort(offset[inside], kind="stable")
    return Box(inside[order], len(inside) == len(everything), note, centre, half_side)


def _half_side(prior: PositionPrior | None, config: CandidatesConfig) -> float:
    if config.box == "fixed":
        return config.half_side_m
    if prior is None:
        return config.unstated_half_side_m
    sigma = float(np.sqrt(np.linalg.eigvalsh(prior.cov[:2, :2])[-1]))
    if config.box == "published":
        return sigma
    return max(config.min_half_side_m, 3.0 * sigma + config.viewing_reach_m)


def in_heading_window(headings_rad: Array, heading_rad: float | None, window_deg: float) -> NDArray[np.bool_]:
    """References whose viewing direction is within a window of a known heading; all where none is known."""
    if heading_rad is None:
        return np.ones(len(headings_rad), bool)
    difference = np.angle(np.exp(1j * (headings_rad - heading_rad)))
    return np.abs(difference) <= np.radians(window_deg)


def vote(query: Features, references: Sequence[Features]) -> NDArray[np.int64]:
    """Mutual nearest neighbours that each reference has with the query: a cheap sign of common content."""
    matcher = MutualNearest(ratio=_VOTE_RATIO)
    return np.array([len(matcher.match(query, reference)) for reference in references], dtype=np.int64)


def overlap(points: Array, directions: Array, views: Views, sizes: Array) -> NDArray[np.int64]:
    """How many points (P, 3), seen by the query along unit directions (P, 3), each view can see from a similar side.

    sizes: (V, 2) image width and height.
    """
    count = len(points)
    out = np.zeros(len(views), np.int64)
    for index in range(len(views)):
        view = np.full(count, index)
        pixel = views.project(view, points)
        inside = ((pixel >= 0) & (pixel <= sizes[index])).all(axis=1)
        rays = points - views.centres[index]
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        similar = np.einsum("ni,ni->n", rays, directions) >= np.cos(np.radians(_MAX_VIEWING_ANGLE_DEG))
        out[index] = np.count_nonzero(inside & similar)
    return out
