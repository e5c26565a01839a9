"""Compiled kernels of one point at a time: its image observations linearised, the point eliminated or found again.

An observation depends on its station and point through the point q in the rig frame only: with G its derivative (2, 3)
by q, the derivative by the station is G [[q]x, -I] and by the point G R. So the cameras of a station are first summed
into G'G (3, 3) and G'r (3,), and elimination works on stations.
"""

from __future__ import annotations

from math import log1p, sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from georef.estimation.adjustment.kernels import by_shared, kernel, observe
from georef.geometry.rigid import Array

_UNDETERMINED, _HELD = 1e-12, 1e-10  # of the trace of a point's normal matrix


class Tracks(NamedTuple):
    """Image observations point by point, within a point by station; see `prepared.Prepared`."""

    point: NDArray[np.int32]  # (T,) points that have observations or a prior
    start: NDArray[np.int64]  # (T + 1,) their observations
    image: NDArray[np.int32]  # (n,)
    pixel: Array  # (n, 2)
    weight: Array  # (n,) 1 / sigma
    kept: NDArray[np.int64]  # (T,) first unknown of a point that is not eliminated, else -1
    prior: NDArray[np.int64]  # (T,) row of the point's prior, else -1


class Work(NamedTuple):
    """What one point needs, made once: t, the most observations of a point, w, the most shared unknowns of one."""

    residual: Array  # (t, 2) by observation, whitened, as are the derivatives
    by_rig: Array  # (t, 2, 3)
    shared: Array  # (t, 2, w)
    column: NDArray[np.int64]  # (t, w)
    columns: NDArray[np.int64]  # (t,)
    slot: NDArray[np.int64]  # (t,) which of the point's stations; -1 where the lens does not show the point
    station: NDArray[np.int64]  # (t,) by slot
    q: Array  # (t, 3) the point in the rig frame
    square: Array  # (t, 3, 3) sum of G'G
    slope: Array  # (t, 3) sum of G'r
    mixed: Array  # (t, 3, 3) W N^-1 W' is mixed mixed' of the point q
    eliminated: Array  # (t, 6, 3) the same of the station
    normal: Array  # (3, 3) of the point
    right: Array  # (3,)
    root: Array  # (3, 3) inverse of the lower Cholesky factor
    place: NDArray[np.int64]  # (B,) of a border's unknown among the point's, else -1
    used: NDArray[np.int64]  # (B,) border's unknowns of the point
    border: Array  # (B, 3) W of these
    small: Array  # (4, 3) scratch
    normal6: Array  # (6, 3) scratch


def work_for(longest: int, shared: int, border: int) -> Work:
    t, w, b = max(longest, 1), max(shared, 1), max(border, 1)
    f, i = np.zeros, np.int64
    return Work(
        *(f((t, 2)), f((t, 2, 3)), f((t, 2, w)), f((t, w), i), f(t, i), f(t, i), f(t, i), f((t, 3)), f((t, 3, 3))),
        *(f((t, 3)), f((t, 3, 3)), f((t, 6, 3)), f((3, 3)), f(3), f((3, 3)), np.full(b, -1), f(b, i), f((b, 3))),
        f((4, 3)), f((6, 3)),
    )


@kernel
def to_rig(placed, station, x, y, z, q):
    r, t = placed.rig_rotation[station], placed.rig_translation[station]
    for i in range(3):
        q[i] = r[i, 0] * x + r[i, 1] * y + r[i, 2] * z + t[i]


@kernel
def linearize_track(tracks, track, images, placed, xyz, cauchy, shared, work):
    """Fills residuals, derivatives and slots of all observations of a point at xyz (3,); how many stations, the cost,
    and how many observations no lens shows. Weights of the loss are applied."""
    slots, cost, hidden = 0, 0.0, 0
    last = -1
    image, by_cam, cam, dim = work.small[0], work.small[1:3], work.small[3], 0
    for at in range(tracks.start[track], tracks.start[track + 1]):
        o = at - tracks.start[track]
        view = tracks.image[at]
        station, mounting, calibration = images.station[view], images.mounting[view], images.calibration[view]
        if station != last:
            last = station
            work.station[slots] = station
            to_rig(placed, station, xyz[0], xyz[1], xyz[2], work.q[slots])
            slots += 1
        q, residual = work.q[slots - 1], work.residual[o]
        weight = tracks.weight[at]
        if not observe(placed, mounting, calibration, q, tracks.pixel[at], weight, cam, image, residual, by_cam):
            work.slot[o] = -1
            hidden += 1
            continue
        work.slot[o] = slots - 1
        loss, damp = robust(residual[0] * residual[0] + residual[1] * residual[1], cauchy)
        cost += loss
        if shared:
            dim = by_shared(images, placed, mounting, calibration, cam, image, weight, by_cam, work.shared[o], work.column[o])
            work.columns[o] = dim
        _to_rig_derivative(placed.cam_rotation[mounting], by_cam, damp, residual, work.by_rig[o], work.shared[o], dim)
    return slots, cost, hidden


@kernel
def robust(square, cauchy):
    """Cost of a squared whitened norm and the root of its weight; no loss where the scale is 0."""
    if cauchy <= 0.0:
        return 0.5 * square, 1.0
    ratio = square / (cauchy * cauchy)
    return 0.5 * cauchy * cauchy * log1p(ratio), sqrt(1.0 / (1.0 + ratio))


@kernel
def _to_rig_derivative(rotation, by_cam, damp, residual, by_rig, shared, dim):
    for i in range(2):
        residual[i] *= damp
        for j in range(3):
            by_rig[i, j] = damp * (
                by_cam[i, 0] * rotation[0, j] + by_cam[i, 1] * rotation[1, j] + by_cam[i, 2] * rotation[2, j]
            )
        for j in range(dim):
            shared[i, j] *= damp


@kernel
def sum_stations(count, slots, work):
    """G'G and G'r of the stations of a point from its `count` observations."""
    for s in range(slots):
        work.square[s, :, :] = 0.0
        work.slope[s, :] = 0.0
    for o in range(count):
        s = work.slot[o]
        if s < 0:
            continue
        g, r, square, slope = work.by_rig[o], work.residual[o], work.square[s], work.slope[s]
        for i in range(3):
            slope[i] += g[0, i] * r[0] + g[1, i] * r[1]
            for j in range(3):
                square[i, j] += g[0, i] * g[0, j] + g[1, i] * g[1, j]


@kernel
def point_normal(slots, placed, work):
    """Normal matrix and gradient of a point; leaves G'G R in `mixed`."""
    work.normal[:, :] = 0.0
    work.right[:] = 0.0
    for s in range(slots):
        r, m, x = placed.rig_rotation[work.station[s]], work.square[s], work.mixed[s]
        g = work.slope[s]
        for i in range(3):
            for j in range(3):
                x[i, j] = m[i, 0] * r[0, j] + m[i, 1] * r[1, j] + m[i, 2] * r[2, j]
        for i in range(3):
            work.right[i] += r[0, i] * g[0] + r[1, i] * g[1] + r[2, i] * g[2]
            for j in range(3):
                work.normal[i, j] += r[0, i] * x[0, j] + r[1, i] * x[1, j] + r[2, i] * x[2, j]


@kernel
def add_prior(information, shift, xyz, work):
    """Adds a given coordinate: information (3, 3), its product with the given position (3,)."""
    for i in range(3):
        for j in range(3):
            work.normal[i, j] += information[i, j]
            work.right[i] += information[i, j] * xyz[j]
        work.right[i] -= shift[i]


@kernel
def invert_root(normal, damping, root):
    """Inverse of the lower Cholesky factor of a point's damped normal matrix (3, 3).

    A direction that rays leave open (one ray, or none across) is held by next to nothing; True where that is so.
    """
    a, b, c = normal[0, 0] * (1 + damping), normal[1, 1] * (1 + damping), normal[2, 2] * (1 + damping)
    trace = a + b + c
    loose = _root(a, b, c, normal[1, 0], normal[2, 0], normal[2, 1], _UNDETERMINED * trace, root)
    if loose:
        held = _HELD * trace if trace > 0.0 else 1.0
        _root(a + held, b + held, c + held, normal[1, 0], normal[2, 0], normal[2, 1], 0.0, root)
    return loose


@kernel
def _root(a, b, c, ba, ca, cb, least, root):
    if not a > least:
        return True
    l00 = sqrt(a)
    l10, l20 = ba / l00, ca / l00
    pivot = b - l10 * l10
    if not pivot > least:
        return True
    l11 = sqrt(pivot)
    l21 = (cb - l20 * l10) / l11
    pivot = c - l20 * l20 - l21 * l21
    if not pivot > least:
        return True
    l22 = sqrt(pivot)
    root[0, 0], root[1, 1], root[2, 2] = 1.0 / l00, 1.0 / l11, 1.0 / l22
    root[1, 0] = -l10 * root[0, 0] / l11
    root[2, 1] = -l21 * root[1, 1] / l22
    root[2, 0] = -(l20 * root[0, 0] + l21 * root[1, 0]) / l22
    return False
