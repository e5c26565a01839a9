"""What the compiled kernels work on: observations in the order of points, and scratch memory for a batch of points.

Batches are short enough for the processor's cache and long enough that calls cost nothing.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from georef.geometry.rigid import Array

BATCH = 128  # points


class Tracks(NamedTuple):
    """Image observations point by point, within a point by station; see `prepared.Prepared`."""

    point: NDArray[np.int32]  # (T,) points that have observations or a prior
    start: NDArray[np.int64]  # (T + 1,) their observations
    image: NDArray[np.int32]  # (n,)
    pixel: Array  # (n, 2)
    weight: Array  # (n,) 1 / sigma
    kept: NDArray[np.int64]  # (T,) first unknown of a point that is not eliminated, else -1
    prior: NDArray[np.int64]  # (T,) row of the point's prior, else -1


class Rays(NamedTuple):
    """Linearised observations of a batch, whitened, weights of the loss applied; n: the most of any batch."""

    residual: Array  # (n, 2)
    by_rig: Array  # (n, 2, 3) by the point in the rig frame
    by_cam: Array  # (n, 2, 3) by the point in the camera frame
    cam: Array  # (n, 3) the point there
    image: Array  # (n, 2) at unit focal length
    scale: Array  # (n,) weight of a pixel's residual, that of the loss included
    slot: NDArray[np.int64]  # (n,) which of the batch's slots; -1 where the lens does not show the point
    shared: Array  # (n, 2, w) by unknowns of the border
    column: NDArray[np.int64]  # (n, w) which they are
    columns: NDArray[np.int64]  # (n,) how many


class Slots(NamedTuple):
    """Pairs of a point and a station, and the points, of a batch."""

    first: NDArray[np.int64]  # (BATCH + 1,) slots of each point
    station: NDArray[np.int64]  # (n,)
    q: Array  # (n, 3) the point in the rig frame
    square: Array  # (n, 3, 3) sum of G'G
    slope: Array  # (n, 3) sum of G'r
    mixed: Array  # (n, 3, 3) G'G R
    eliminated: Array  # (n, 3, 6) E with W N^-1 W' = E' E
    normal: Array  # (BATCH, 3, 3) of points
    right: Array  # (BATCH, 3) their gradients
    root: Array  # (BATCH, 3, 3) inverses of their lower Cholesky factors


class Shared(NamedTuple):
    """The border's unknowns that one point depends on."""

    place: NDArray[np.int64]  # (B,) among the point's, else -1
    used: NDArray[np.int64]  # (B,)
    mixed: Array  # (B, 3) W of these


class Pairs(NamedTuple):
    """Slots of all tracks, and where the pairs of stations of those that are eliminated stand in the pattern."""

    slot: NDArray[np.int64]  # (T + 1,) first slot of each track
    first: NDArray[np.int64]  # (T + 1,) first pair of each track
    entry: NDArray[np.int32]  # (m,) of each pair of slots of a track, the second not before the first


class Back(NamedTuple):
    """What back-substitution needs of the elimination before it."""

    square: Array  # (slots, 6) upper triangle of G'G, row by row
    root: Array  # (T, 6) lower triangle of the inverse of the point's Cholesky factor, row by row
    right: Array  # (T, 3) that inverse times the point's gradient

    @staticmethod
    def empty(slots: int, tracks: int) -> Back:
        return Back(np.empty((slots, 6)), np.empty((tracks, 6)), np.empty((tracks, 3)))


class Work(NamedTuple):
    """Scratch memory of one pass, made once."""

    rays: Rays
    slots: Slots
    shared: Shared


def work_for(start: NDArray[np.int64], shared: int, border: int) -> Work:
    """For tracks with these starts (T + 1,), `shared` unknowns of the border to an observation at most."""
    ends = start[np.minimum(np.arange(0, len(start), BATCH) + BATCH, len(start) - 1)]
    n, w, b = max(int((ends - start[::BATCH]).max(initial=0)), 1), max(shared, 1), max(border, 1)
    f, i = np.zeros, np.int64
    return Work(
        Rays(
            *(f((n, 2)), f((n, 2, 3)), f((n, 2, 3)), f((n, 3)), f((n, 2)), f(n), f(n, i)),
            *(f((n, 2, w)), f((n, w), i), f(n, i)),
        ),
        Slots(
            *(f(BATCH + 1, i), f(n, i), f((n, 3)), f((n, 3, 3)), f((n, 3)), f((n, 3, 3)), f((n, 3, 6))),
            *(f((BATCH, 3, 3)), f((BATCH, 3)), f((BATCH, 3, 3))),
        ),
        Shared(np.full(b, -1), f(b, i), f((b, 3))),
    )
