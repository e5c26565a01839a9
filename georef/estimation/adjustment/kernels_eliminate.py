"""The compiled loop over points that fills the reduced normal equations."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from georef.estimation.adjustment.kernels import kernel
from georef.estimation.adjustment.kernels_points import (
    add_prior,
    invert_root,
    linearize_track,
    point_normal,
    sum_stations,
)
from georef.geometry.rigid import Array


class Sums(NamedTuple):
    """The reduced normal equations as they grow; `corner` holds each pair of unknowns once, on either side."""

    first: NDArray[np.int64]  # (S + 1,) see `Reduced`
    column: NDArray[np.int64]  # (N,)
    block: Array  # (N, 6, 6)
    border: Array  # (S, 6, B)
    corner: Array  # (B, B)
    gradient: Array  # (6 S + B,)
    diagonal: Array  # (6 S + B,) of the normal matrix before elimination


@kernel
def eliminate_points(tracks, images, placed, points, information, shift, damping, cauchy, sums, work):
    """Adds all image observations, their points eliminated; cost, observations no lens shows, undetermined points.

    points (P, 3); information (K, 3, 3) and its products with given positions (K, 3) of point priors; damping is
    relative to the diagonal of points.
    """
    cost, hidden, undetermined = 0.0, 0, 0
    unknown = 6 * placed.rig_rotation.shape[0]
    shared = sums.corner.shape[0] > 0
    for track in range(tracks.point.shape[0]):
        xyz = points[tracks.point[track]]
        slots, more, unseen = linearize_track(tracks, track, images, placed, xyz, cauchy, shared, work)
        cost, hidden = cost + more, hidden + unseen
        count = tracks.start[track + 1] - tracks.start[track]
        sum_stations(count, slots, work)
        if tracks.kept[track] >= 0:
            keep_point(count, tracks.kept[track], placed, work)
            _add_stations(slots, sums, work)
            _add_shared(count, unknown, sums, work)
            continue
        point_normal(slots, placed, work)
        if tracks.prior[track] >= 0:
            add_prior(information[tracks.prior[track]], shift[tracks.prior[track]], xyz, work)
        undetermined += invert_root(work.normal, damping, work.root)
        _add_stations(slots, sums, work)
        _subtract_stations(slots, sums, work)
        if shared:
            _add_shared(count, unknown, sums, work)
            _subtract_shared(_mix_shared(count, placed, work), slots, unknown, sums, work)
    return cost, hidden, undetermined


@kernel
def _add_stations(slots, sums, work):
    """The stations' own normal matrices T'MT and gradients T'g, T = [[q]x, -I]."""
    f = work.normal6
    for s in range(slots):
        station, m, g = work.station[s], work.square[s], work.slope[s]
        x, y, z = work.q[s, 0], work.q[s, 1], work.q[s, 2]
        for j in range(3):  # T'M, (6, 3)
            f[0, j], f[1, j], f[2, j] = z * m[1, j] - y * m[2, j], x * m[2, j] - z * m[0, j], y * m[0, j] - x * m[1, j]
            f[3, j], f[4, j], f[5, j] = -m[0, j], -m[1, j], -m[2, j]
        block = sums.block[sums.first[station]]
        for i in range(6):
            a, b, c = f[i, 0], f[i, 1], f[i, 2]
            block[i, 0] += b * z - c * y
            block[i, 1] += c * x - a * z
            block[i, 2] += a * y - b * x
            block[i, 3] -= a
            block[i, 4] -= b
            block[i, 5] -= c
        at = 6 * station
        sums.diagonal[at] += f[0, 1] * z - f[0, 2] * y
        sums.diagonal[at + 1] += f[1, 2] * x - f[1, 0] * z
        sums.diagonal[at + 2] += f[2, 0] * y - f[2, 1] * x
        for i in range(3):
            sums.diagonal[at + 3 + i] += m[i, i]
            sums.gradient[at + 3 + i] -= g[i]
        sums.gradient[at] += z * g[1] - y * g[2]
        sums.gradient[at + 1] += x * g[2] - z * g[0]
        sums.gradient[at + 2] += y * g[0] - x * g[1]


@kernel
def _subtract_stations(slots, sums, work):
    """W N^-1 W' of all pairs of a point's stations, W N^-1 times its gradient; leaves E with W N^-1 W' = E E'."""
    root, right = work.root, work.right
    h0 = root[0, 0] * right[0]
    h1 = root[1, 0] * right[0] + root[1, 1] * right[1]
    h2 = root[2, 0] * right[0] + root[2, 1] * right[1] + root[2, 2] * right[2]
    for s in range(slots):
        x, e = work.mixed[s], work.eliminated[s]
        qx, qy, qz = work.q[s, 0], work.q[s, 1], work.q[s, 2]
        for i in range(3):
            a, b, c = x[i, 0], x[i, 1], x[i, 2]
            e[3 + i, 0] = -a * root[0, 0]
            e[3 + i, 1] = -(a * root[1, 0] + b * root[1, 1])
            e[3 + i, 2] = -(a * root[2, 0] + b * root[2, 1] + c * root[2, 2])
        for j in range(3):
            a, b, c = e[3, j], e[4, j], e[5, j]
            e[0, j], e[1, j], e[2, j] = qy * c - qz * b, qz * a - qx * c, qx * b - qy * a
        at = 6 * work.station[s]
        for i in range(6):
            sums.gradient[at + i] -= e[i, 0] * h0 + e[i, 1] * h1 + e[i, 2] * h2
    right[0], right[1], right[2] = h0, h1, h2
    for s in range(slots):
        entry = sums.first[work.station[s]]
        for other in range(s, slots):
            while sums.column[entry] != work.station[other]:
                entry += 1
            subtract_product(work.eliminated[s], work.eliminated[other], sums.block[entry])


@kernel
def subtract_product(a, b, out):
    """out (6, 6) -= a (6, 3) b'."""
    for i in range(6):
        x, y, z = a[i, 0], a[i, 1], a[i, 2]
        for j in range(6):
            out[i, j] -= x * b[j, 0] + y * b[j, 1] + z * b[j, 2]


@kernel
def _add_shared(count, unknown, sums, work):
    """The border's own normal matrix, its products with stations, and its gradient."""
    k = work.small
    for o in range(count):
        s = work.slot[o]
        if s < 0:
            continue
        g, r, shared = work.by_rig[o], work.residual[o], work.shared[o]
        x, y, z = work.q[s, 0], work.q[s, 1], work.q[s, 2]
        rows = sums.border[work.station[s]]
        for a in range(work.columns[o]):
            at, u, v = work.column[o, a], shared[0, a], shared[1, a]
            sums.gradient[unknown + at] += u * r[0] + v * r[1]
            sums.diagonal[unknown + at] += u * u + v * v
            for i in range(3):
                k[0, i] = g[0, i] * u + g[1, i] * v
            rows[0, at] += z * k[0, 1] - y * k[0, 2]
            rows[1, at] += x * k[0, 2] - z * k[0, 0]
            rows[2, at] += y * k[0, 0] - x * k[0, 1]
            for i in range(3):
                rows[3 + i, at] -= k[0, i]
            for b in range(a + 1):
                sums.corner[at, work.column[o, b]] += u * shared[0, b] + v * shared[1, b]


@kernel
def _mix_shared(count, placed, work):
    """W of the border's unknowns of a point, gathered from its observations; how many they are."""
    used = 0
    for o in range(count):
        s = work.slot[o]
        if s < 0:
            continue
        g, shared, r = work.by_rig[o], work.shared[o], placed.rig_rotation[work.station[s]]
        for i in range(2):
            for j in range(3):
                work.small[i, j] = g[i, 0] * r[0, j] + g[i, 1] * r[1, j] + g[i, 2] * r[2, j]
        for a in range(work.columns[o]):
            at = work.column[o, a]
            if work.place[at] < 0:
                work.place[at] = used
                work.used[used] = at
                work.border[used, :] = 0.0
                used += 1
            w = work.border[work.place[at]]
            for j in range(3):
                w[j] += shared[0, a] * work.small[0, j] + shared[1, a] * work.small[1, j]
    return used


@kernel
def _subtract_shared(used, slots, unknown, sums, work):
    """W N^-1 W' of the border's unknowns of a point, with each other and with its stations."""
    root, h = work.root, work.right  # `right` is L^-1 times the gradient by now
    for a in range(used):
        w, at = work.border[a], work.used[a]
        work.place[at] = -1
        w2 = w[0] * root[2, 0] + w[1] * root[2, 1] + w[2] * root[2, 2]
        w1 = w[0] * root[1, 0] + w[1] * root[1, 1]
        w0 = w[0] * root[0, 0]
        w[0], w[1], w[2] = w0, w1, w2
        sums.gradient[unknown + at] -= w0 * h[0] + w1 * h[1] + w2 * h[2]
        for b in range(a + 1):
            other = work.border[b]
            sums.corner[at, work.used[b]] -= w0 * other[0] + w1 * other[1] + w2 * other[2]
    for s in range(slots):
        e, rows = work.eliminated[s], sums.border[work.station[s]]
        for i in range(6):
            for a in range(used):
                w = work.border[a]
                rows[i, work.used[a]] -= e[i, 0] * w[0] + e[i, 1] * w[1] + e[i, 2] * w[2]


@kernel
def keep_point(count, column, placed, work):
    """Turns the derivatives by a point that is not eliminated into ones by the border's unknowns column to column + 2."""
    for o in range(count):
        s = work.slot[o]
        if s < 0:
            continue
        g, r, at = work.by_rig[o], placed.rig_rotation[work.station[s]], work.columns[o]
        for i in range(2):
            for j in range(3):
                work.shared[o, i, at + j] = g[i, 0] * r[0, j] + g[i, 1] * r[1, j] + g[i, 2] * r[2, j]
        for j in range(3):
            work.column[o, at + j] = column + j
        work.columns[o] = at + 3
