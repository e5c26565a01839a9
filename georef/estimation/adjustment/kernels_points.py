"""Compiled kernels over a batch of points: their image observations linearised, summed by station, points inverted.

An observation depends on its station and point through the point q in the rig frame only: with G its derivative (2, 3)
by q, the derivative by the station is G [[q]x, -I] and by the point G R. So the cameras of a station are first summed
into G'G (3, 3) and G'r (3,), and elimination works on stations. Batches are short enough for the processor's cache and
long enough that calls cost nothing.
"""

from __future__ import annotations

from math import log1p, sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from georef.estimation.adjustment.kernels import by_unknown, kernel, lens
from georef.geometry.rigid import Array

BATCH = 128  # points
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


@kernel
def linearize(tracks, begin, end, images, placed, points, cauchy, rays, slots):
    """Linearises all observations of tracks begin to end; their cost, and how many no lens shows."""
    count, cost, hidden = 0, 0.0, 0
    r, t, c, d = placed.rig_rotation, placed.rig_translation, placed.cam_rotation, placed.cam_translation
    seen = np.empty(8)
    for track in range(begin, end):
        slots.first[track - begin] = count
        point, last = tracks.point[track], -1
        px, py, pz = points[point, 0], points[point, 1], points[point, 2]
        for at in range(tracks.start[track], tracks.start[track + 1]):
            o, view = at - tracks.start[begin], tracks.image[at]
            s, m, k = images.station[view], images.mounting[view], images.calibration[view]
            if s != last:
                last, slots.station[count] = s, s
                for i in range(3):
                    slots.q[count, i] = r[s, i, 0] * px + r[s, i, 1] * py + r[s, i, 2] * pz + t[s, i]
                count += 1
            x, y, z = slots.q[count - 1, 0], slots.q[count - 1, 1], slots.q[count - 1, 2]
            u = c[m, 0, 0] * x + c[m, 0, 1] * y + c[m, 0, 2] * z + d[m, 0]
            v = c[m, 1, 0] * x + c[m, 1, 1] * y + c[m, 1, 2] * z + d[m, 1]
            w = c[m, 2, 0] * x + c[m, 2, 1] * y + c[m, 2, 2] * z + d[m, 2]
            rays.columns[o] = 0
            if not lens(placed.model[k], placed.parameters, k, u, v, w, seen):
                rays.slot[o] = -1
                hidden += 1
                continue
            rays.slot[o] = count - 1
            rays.cam[o, 0], rays.cam[o, 1], rays.cam[o, 2] = u, v, w
            rays.image[o, 0], rays.image[o, 1] = seen[0], seen[1]
            weight = tracks.weight[at]
            a = (seen[0] * placed.parameters[k, 0] + placed.parameters[k, 2] - tracks.pixel[at, 0]) * weight
            b = (seen[1] * placed.parameters[k, 1] + placed.parameters[k, 3] - tracks.pixel[at, 1]) * weight
            cost += loss(a * a + b * b, cauchy)
            weight *= root_weight(a * a + b * b, cauchy)
            rays.scale[o] = weight
            damp = weight / tracks.weight[at]
            rays.residual[o, 0], rays.residual[o, 1] = a * damp, b * damp
            for i in range(2):
                f = placed.parameters[k, i] * weight
                e0, e1, e2 = seen[2 + 3 * i] * f, seen[3 + 3 * i] * f, seen[4 + 3 * i] * f
                rays.by_cam[o, i, 0], rays.by_cam[o, i, 1], rays.by_cam[o, i, 2] = e0, e1, e2
                for j in range(3):
                    rays.by_rig[o, i, j] = e0 * c[m, 0, j] + e1 * c[m, 1, j] + e2 * c[m, 2, j]
    slots.first[end - begin] = count
    return cost, hidden


@kernel
def loss(square, cauchy):
    """Cost of a squared whitened norm; no loss where the scale is 0."""
    if cauchy <= 0.0:
        return 0.5 * square
    return 0.5 * cauchy * cauchy * log1p(square / (cauchy * cauchy))


@kernel
def root_weight(square, cauchy):
    """Root of the weight that the loss gives an observation."""
    return 1.0 if cauchy <= 0.0 else sqrt(1.0 / (1.0 + square / (cauchy * cauchy)))


@kernel
def share(tracks, begin, end, images, placed, rays):
    """Derivatives of a batch's observations by mountings and calibrations, where these are unknown."""
    offset = tracks.start[begin]
    for at in range(offset, tracks.start[end]):
        o, count = at - offset, 0
        if rays.slot[o] < 0:
            continue
        mounting, k = images.mounting[tracks.image[at]], images.calibration[tracks.image[at]]
        x, y, z = rays.cam[o, 0], rays.cam[o, 1], rays.cam[o, 2]
        first = images.mounting_column[mounting]
        if first >= 0:
            for i in range(2):
                a, b, c = rays.by_cam[o, i, 0], rays.by_cam[o, i, 1], rays.by_cam[o, i, 2]
                rays.shared[o, i, 0] = b * z - c * y
                rays.shared[o, i, 1] = c * x - a * z
                rays.shared[o, i, 2] = a * y - b * x
                rays.shared[o, i, 3], rays.shared[o, i, 4], rays.shared[o, i, 5] = -a, -b, -c
            for j in range(6):
                rays.column[o, j] = first + j
            count = 6
        first = images.calibration_column[k]
        if first >= 0:
            for j in range(images.unknowns[k]):
                code, model = images.code[k, j], placed.model[k]
                a, b = by_unknown(code, model, placed.parameters, k, x, y, z, rays.image[o, 0], rays.image[o, 1])
                rays.shared[o, 0, count], rays.shared[o, 1, count] = a * rays.scale[o], b * rays.scale[o]
                rays.column[o, count] = first + j
                count += 1
        rays.columns[o] = count


@kernel
def keep(tracks, begin, end, placed, rays, slots):
    """Appends the derivatives by points that are not eliminated to those by unknowns of the border."""
    for track in range(begin, end):
        kept = tracks.kept[track]
        if kept < 0:
            continue
        for o in range(tracks.start[track] - tracks.start[begin], tracks.start[track + 1] - tracks.start[begin]):
            if rays.slot[o] < 0:
                continue
            s, at = slots.station[rays.slot[o]], rays.columns[o]
            for j in range(3):
                for i in range(2):
                    total = 0.0
                    for k in range(3):
                        total += rays.by_rig[o, i, k] * placed.rig_rotation[s, k, j]
                    rays.shared[o, i, at + j] = total
                rays.column[o, at + j] = kept + j
            rays.columns[o] = at + 3


@kernel
def sum_stations(count, slot_count, rays, slots):
    """G'G and G'r of all slots of a batch from its `count` observations."""
    for s in range(slot_count):
        for i in range(3):
            slots.slope[s, i] = 0.0
            for j in range(3):
                slots.square[s, i, j] = 0.0
    for o in range(count):
        s = rays.slot[o]
        if s < 0:
            continue
        u, v = rays.residual[o, 0], rays.residual[o, 1]
        for i in range(3):
            a, b = rays.by_rig[o, 0, i], rays.by_rig[o, 1, i]
            slots.slope[s, i] += a * u + b * v
            for j in range(3):
                slots.square[s, i, j] += a * rays.by_rig[o, 0, j] + b * rays.by_rig[o, 1, j]


@kernel
def point_normals(tracks, begin, end, placed, points, information, shift, damping, slots):
    """Normal matrices and gradients of a batch's points, priors included, and the inverse roots of the damped ones; how
    many points their rays leave undetermined."""
    loose = 0
    for p in range(end - begin):
        for i in range(3):
            slots.right[p, i] = 0.0
            for j in range(3):
                slots.normal[p, i, j] = 0.0
        for s in range(slots.first[p], slots.first[p + 1]):
            station = slots.station[s]
            for j in range(3):
                r0, r1, r2 = (
                    placed.rig_rotation[station, 0, j],
                    placed.rig_rotation[station, 1, j],
                    placed.rig_rotation[station, 2, j],
                )
                slots.right[p, j] += r0 * slots.slope[s, 0] + r1 * slots.slope[s, 1] + r2 * slots.slope[s, 2]
                for i in range(3):
                    m = slots.square[s, i, 0] * r0 + slots.square[s, i, 1] * r1 + slots.square[s, i, 2] * r2
                    slots.mixed[s, i, j] = m
            for i in range(3):
                for j in range(3):
                    total = 0.0
                    for k in range(3):
                        total += placed.rig_rotation[station, k, i] * slots.mixed[s, k, j]
                    slots.normal[p, i, j] += total
        row, point = tracks.prior[begin + p], tracks.point[begin + p]
        if row >= 0:
            for i in range(3):
                slots.right[p, i] -= shift[row, i]
                for j in range(3):
                    slots.normal[p, i, j] += information[row, i, j]
                    slots.right[p, i] += information[row, i, j] * points[point, j]
        if tracks.kept[begin + p] < 0:
            loose += invert_root(slots.normal, p, damping, slots.root)
    return loose


@kernel
def invert_root(normal, p, damping, root):
    """Inverse of the lower Cholesky factor of a point's damped normal matrix (P, 3, 3).

    A direction that rays leave open (one ray, or none across) is held by next to nothing; True where that is so.
    """
    factor = 1.0 + damping
    a, b, c = normal[p, 0, 0] * factor, normal[p, 1, 1] * factor, normal[p, 2, 2] * factor
    trace = a + b + c
    loose = _root(a, b, c, normal[p, 1, 0], normal[p, 2, 0], normal[p, 2, 1], _UNDETERMINED * trace, p, root)
    if loose:
        held = _HELD * trace if trace > 0.0 else 1.0
        a, b, c = a + held, b + held, c + held
        _root(a, b, c, normal[p, 1, 0], normal[p, 2, 0], normal[p, 2, 1], 0.0, p, root)
    return loose


@kernel
def _root(a, b, c, ba, ca, cb, least, p, root):
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
    r0, r1, r2 = 1.0 / l00, 1.0 / l11, 1.0 / sqrt(pivot)
    root[p, 0, 0], root[p, 1, 1], root[p, 2, 2] = r0, r1, r2
    root[p, 1, 0] = -l10 * r0 * r1
    root[p, 2, 1] = -l21 * r1 * r2
    root[p, 2, 0] = -(l20 * r0 + l21 * root[p, 1, 0]) * r2
    return False
