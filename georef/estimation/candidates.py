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
_ANY_HEADING_DEG = 180.0


@dataclass(frozen=True, eq=False)
class Box:
    """The references that may take part: those inside the search box and the heading window, nearest first."""

    indices: NDArray[np.int64]
    whole_reference: bool  # nothing was left out
    note: str = ""
    centre: Array | None = None  # (3,) m
    half_side_m: float | None = None
    heading_rad: float | None = None  # middle of the heading window; None: any heading


@dataclass(frozen=True, eq=False)
class Whereabouts:
    """What is known of where a query was taken: a prior, or at least a place to search about; a heading."""

    prior: PositionPrior | None = None
    near: Array | None = None  # (3,) m, a position whose sigma nobody states
    heading_rad: float | None = None

    @property
    def centre(self) -> Array | None:
        return self.near if self.prior is None else self.prior.position_in_world


def search_box(positions: Array, headings_rad: Array, where: Whereabouts, config: CandidatesConfig) -> Box:
    """References (positions (N, 3), headings (N,)) about a position and within a heading window.

    Half the side of the square is the stated uncertainty ("published"), max(min_half_side, 3 sigma + viewing reach)
    ("reach"), or half_side_m ("fixed"); it is widened until enough references that look the right way are inside.
    "none" has no box, and neither has an image of unknown position.
    """
    heading = where.heading_rad if config.heading_window_deg < _ANY_HEADING_DEG else None
    looking = np.flatnonzero(in_heading_window(headings_rad, heading, config.heading_window_deg))
    centre = where.centre
    if centre is None or config.box == "none":
        note = "no position prior: searched the whole reference" if centre is None and config.box != "none" else ""
        return _without_box(positions, looking, centre, heading, note)
    offset = np.abs(positions[looking, :2] - centre[:2]).max(axis=1)
    asked = _half_side(where.prior, config)
    half_side, needed = asked, min(config.count, int(np.isfinite(offset).sum()))
    while np.count_nonzero(offset <= half_side) < needed:
        half_side *= 2.0
    inside = np.flatnonzero(offset <= half_side)
    note = ""
    if half_side > asked:
        found = np.count_nonzero(offset <= asked)
        note = f"search box widened from {asked:.1f} to {half_side:.1f} m half side: {found} of {needed} references"
    indices = looking[inside[np.argsort(offset[inside], kind="stable")]]
    return Box(indices, len(indices) == len(positions), note, centre, half_side, heading)


def everywhere(positions: Array, where: Whereabouts) -> Box:
    """The whole reference (positions (N, 3)), the nearest first as far as anything is known of the place."""
    return _without_box(positions, np.arange(len(positions)), where.centre, None, "")


def _without_box(
    positions: Array, indices: NDArray[np.int64], centre: Array | None, heading_rad: float | None, note: str
) -> Box:
    if centre is not None:
        offset = np.abs(positions[indices, :2] - centre[:2]).max(axis=1)
        indices = indices[np.argsort(offset, kind="stable")]
    return Box(indices, len(indices) == len(positions), note, heading_rad=heading_rad)


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
    """References whose viewing direction is within a window of a known heading; all where none is known.

    A reference that looks up or down has no heading (NaN), and passes.
    """
    if heading_rad is None:
        return np.ones(len(headings_rad), bool)
    difference = np.angle(np.exp(1j * (headings_rad - heading_rad)))
    return np.isnan(difference) | (np.abs(difference) <= np.radians(window_deg))


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
