"""The compiled loop over points that fills the reduced normal equations."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from georef.estimation.adjustment.batches import BATCH
from georef.estimation.adjustment.kernels import kernel
from georef.estimation.adjustment.kernels_points import keep, linearize, point_normals, share, sum_stations
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
def eliminate_points(tracks, images, placed, points, information, shift, damping, cauchy, pairs, sums, back, work):
    """Adds all image observations, their points eliminated; cost, observations no lens shows, undetermined points, and
    by how much the (damped) cost falls if points alone move.

    points (P, 3); information (K, 3, 3) and its products with given positions (K, 3) of point priors; damping is
    relative to the diagonal of points. back: filled, unless it is empty.
    """
    cost, hidden, undetermined, gain = 0.0, 0, 0, 0.0
    rays, slots, shared = work.rays, work.slots, work.shared
    border = sums.corner.shape[0] > 0
    for begin in range(0, tracks.point.shape[0], BATCH):
        end = min(begin + BATCH, tracks.point.shape[0])
        more, unseen = linearize(tracks, begin, end, images, placed, points, cauchy, rays, slots)
        cost, hidden = cost + more, hidden + unseen
        count = tracks.start[end] - tracks.start[begin]
        sum_stations(count, slots.first[end - begin], rays, slots)
        undetermined += point_normals(tracks, begin, end, placed, points, information, shift, damping, slots)
        _add_stations(slots.first[end - begin], slots, sums)
        gain += _roots_of_stations(tracks, begin, end, slots, sums)
        _subtract_stations(tracks, begin, end, pairs, slots, sums)
        if back.right.shape[0] > 0:
            _leave(tracks, begin, end, pairs.slot[begin], slots, back)
        if border:
            share(tracks, begin, end, images, placed, rays)
            keep(tracks, begin, end, placed, rays, slots)
            _add_shared(count, rays, slots, sums)
            _subtract_shared(tracks, begin, end, placed, rays, slots, shared, sums)
    return cost, hidden, undetermined, gain


@kernel
def _leave(tracks, begin, end, slot, slots, back):
    """Keeps what back-substitution needs; slot: number of the batch's first one."""
    for s in range(slots.first[end - begin]):
        square = slots.square
        back.square[slot + s, 0], back.square[slot + s, 1] = square[s, 0, 0], square[s, 0, 1]
        back.square[slot + s, 2], back.square[slot + s, 3] = square[s, 0, 2], square[s, 1, 1]
        back.square[slot + s, 4], back.square[slot + s, 5] = square[s, 1, 2], square[s, 2, 2]
    for p in range(end - begin):
        if tracks.kept[begin + p] >= 0:
            continue
        root = slots.root
        back.root[begin + p, 0], back.root[begin + p, 1] = root[p, 0, 0], root[p, 1, 0]
        back.root[begin + p, 2], back.root[begin + p, 3] = root[p, 1, 1], root[p, 2, 0]
        back.root[begin + p, 4], back.root[begin + p, 5] = root[p, 2, 1], root[p, 2, 2]
        for i in range(3):
            back.right[begin + p, i] = slots.right[p, i]


@kernel
def _add_stations(count, slots, sums):
    """The stations' own normal matrices T'MT and gradients T'g, T = [[q]x, -I], of all slots."""
    f = np.empty((6, 3))
    block, gradient, diagonal = sums.block, sums.gradient, sums.diagonal
    for s in range(count):
        station = slots.station[s]
        own, at = sums.first[station], 6 * station
        x, y, z = slots.q[s, 0], slots.q[s, 1], slots.q[s, 2]
        for j in range(3):  # T'M
            m0, m1, m2 = slots.square[s, 0, j], slots.square[s, 1, j], slots.square[s, 2, j]
            f[0, j], f[1, j], f[2, j] = z * m1 - y * m2, x * m2 - z * m0, y * m0 - x * m1
            f[3, j], f[4, j], f[5, j] = -m0, -m1, -m2
        for i in range(6):
            a, b, c = f[i, 0], f[i, 1], f[i, 2]
            block[own, i, 0] += b * z - c * y
            block[own, i, 1] += c * x - a * z
            block[own, i, 2] += a * y - b * x
            block[own, i, 3] -= a
            block[own, i, 4] -= b
            block[own, i, 5] -= c
        g0, g1, g2 = slots.slope[s, 0], slots.slope[s, 1], slots.slope[s, 2]
        gradient[at] += z * g1 - y * g2
        gradient[at + 1] += x * g2 - z * g0
        gradient[at + 2] += y * g0 - x * g1
        gradient[at + 3] -= g0
        gradient[at + 4] -= g1
        gradient[at + 5] -= g2
        diagonal[at] += f[0, 1] * z - f[0, 2] * y
        diagonal[at + 1] += f[1, 2] * x - f[1, 0] * z
        diagonal[at + 2] += f[2, 0] * y - f[2, 1] * x
        for i in range(3):
            diagonal[at + 3 + i] -= f[3 + i, i]


@kernel
def _roots_of_stations(tracks, begin, end, slots, sums):
    """E of all slots, with W N^-1 W' = E'E; what elimination takes off the gradients. Leaves L^-1 times the points'
    gradients in `right`; half the sum of their squares."""
    e, gradient, gain = slots.eliminated, sums.gradient, 0.0
    for p in range(end - begin):
        if tracks.kept[begin + p] >= 0:
            continue
        r00, r10, r11 = slots.root[p, 0, 0], slots.root[p, 1, 0], slots.root[p, 1, 1]
        r20, r21, r22 = slots.root[p, 2, 0], slots.root[p, 2, 1], slots.root[p, 2, 2]
        g0, g1, g2 = slots.right[p, 0], slots.right[p, 1], slots.right[p, 2]
        h0, h1, h2 = r00 * g0, r10 * g0 + r11 * g1, r20 * g0 + r21 * g1 + r22 * g2
        slots.right[p, 0], slots.right[p, 1], slots.right[p, 2] = h0, h1, h2
        gain += h0 * h0 + h1 * h1 + h2 * h2
        for s in range(slots.first[p], slots.first[p + 1]):
            x, y, z = slots.q[s, 0], slots.q[s, 1], slots.q[s, 2]
            for i in range(3):
                a, b, c = slots.mixed[s, i, 0], slots.mixed[s, i, 1], slots.mixed[s, i, 2]
                e[s, 0, 3 + i] = -r00 * a
                e[s, 1, 3 + i] = -(r10 * a + r11 * b)
                e[s, 2, 3 + i] = -(r20 * a + r21 * b + r22 * c)
            for j in range(3):
                a, b, c = e[s, j, 3], e[s, j, 4], e[s, j, 5]
                e[s, j, 0], e[s, j, 1], e[s, j, 2] = y * c - z * b, z * a - x * c, x * b - y * a
            at = 6 * slots.station[s]
            for i in range(6):
                gradient[at + i] -= e[s, 0, i] * h0 + e[s, 1, i] * h1 + e[s, 2, i] * h2
    return 0.5 * gain


@kernel
def _subtract_stations(tracks, begin, end, pairs, slots, sums):
    """W N^-1 W' of all pairs of a point's stations."""
    e, block = slots.eliminated, sums.block
    for p in range(end - begin):
        if tracks.kept[begin + p] >= 0:
            continue
        pair = pairs.first[begin + p]
        for s in range(slots.first[p], slots.first[p + 1]):
            for other in range(s, slots.first[p + 1]):
                entry = pairs.entry[pair]
                pair += 1
                for i in range(6):
                    a, b, c = e[s, 0, i], e[s, 1, i], e[s, 2, i]
                    for j in range(6):
                        block[entry, i, j] -= a * e[other, 0, j] + b * e[other, 1, j] + c * e[other, 2, j]


@kernel
def _add_shared(count, rays, slots, sums):
    """The border's own normal matrix, its products with stations, and its gradient."""
    border, corner, gradient, diagonal = sums.border, sums.corner, sums.gradient, sums.diagonal
    unknown = 6 * border.shape[0]
    for o in range(count):
        s = rays.slot[o]
        if s < 0:
            continue
        station = slots.station[s]
        x, y, z = slots.q[s, 0], slots.q[s, 1], slots.q[s, 2]
        for a in range(rays.columns[o]):
            at, u, v = rays.column[o, a], rays.shared[o, 0, a], rays.shared[o, 1, a]
            gradient[unknown + at] += u * rays.residual[o, 0] + v * rays.residual[o, 1]
            diagonal[unknown + at] += u * u + v * v
            k0 = rays.by_rig[o, 0, 0] * u + rays.by_rig[o, 1, 0] * v
            k1 = rays.by_rig[o, 0, 1] * u + rays.by_rig[o, 1, 1] * v
            k2 = rays.by_rig[o, 0, 2] * u + rays.by_rig[o, 1, 2] * v
            border[station, 0, at] += z * k1 - y * k2
            border[station, 1, at] += x * k2 - z * k0
            border[station, 2, at] += y * k0 - x * k1
            border[station, 3, at] -= k0
            border[station, 4, at] -= k1
            border[station, 5, at] -= k2
            for b in range(a + 1):
                corner[at, rays.column[o, b]] += u * rays.shared[o, 0, b] + v * rays.shared[o, 1, b]


@kernel
def _subtract_shared(tracks, begin, end, placed, rays, slots, shared, sums):
    """W N^-1 W' of the border's unknowns of each point, with each other and with its stations."""
    border, corner, gradient = sums.border, sums.corner, sums.gradient
    unknown, mixed = 6 * border.shape[0], shared.mixed
    for p in range(end - begin):
        if tracks.kept[begin + p] >= 0:
            continue
        offset = tracks.start[begin]
        first, last = tracks.start[begin + p] - offset, tracks.start[begin + p + 1] - offset
        used = _mix_shared(first, last, placed.rig_rotation, rays, slots, shared)
        root, h0, h1, h2 = slots.root, slots.right[p, 0], slots.right[p, 1], slots.right[p, 2]
        for a in range(used):
            at, w0, w1, w2 = shared.used[a], mixed[a, 0], mixed[a, 1], mixed[a, 2]
            shared.place[at] = -1
            w2 = w0 * root[p, 2, 0] + w1 * root[p, 2, 1] + w2 * root[p, 2, 2]
            w1 = w0 * root[p, 1, 0] + w1 * root[p, 1, 1]
            w0 = w0 * root[p, 0, 0]
            mixed[a, 0], mixed[a, 1], mixed[a, 2] = w0, w1, w2
            gradient[unknown + at] -= w0 * h0 + w1 * h1 + w2 * h2
            for b in range(a + 1):
                corner[at, shared.used[b]] -= w0 * mixed[b, 0] + w1 * mixed[b, 1] + w2 * mixed[b, 2]
        for s in range(slots.first[p], slots.first[p + 1]):
            station = slots.station[s]
            for i in range(6):
                e0, e1, e2 = slots.eliminated[s, 0, i], slots.eliminated[s, 1, i], slots.eliminated[s, 2, i]
                for a in range(used):
                    border[station, i, shared.used[a]] -= e0 * mixed[a, 0] + e1 * mixed[a, 1] + e2 * mixed[a, 2]


@kernel
def _mix_shared(first, last, rotation, rays, slots, shared):
    """W of the border's unknowns of a point, gathered from its observations first to last; how many they are."""
    used = 0
    for o in range(first, last):
        if rays.slot[o] < 0 or not rays.columns[o]:
            continue
        station, g = slots.station[rays.slot[o]], rays.by_rig
        for j in range(3):
            r0, r1, r2 = rotation[station, 0, j], rotation[station, 1, j], rotation[station, 2, j]
            u = g[o, 0, 0] * r0 + g[o, 0, 1] * r1 + g[o, 0, 2] * r2
            v = g[o, 1, 0] * r0 + g[o, 1, 1] * r1 + g[o, 1, 2] * r2
            for a in range(rays.columns[o]):
                at = rays.column[o, a]
                if shared.place[at] < 0:
                    shared.place[at], shared.used[used] = used, at
                    shared.mixed[used, 0], shared.mixed[used, 1], shared.mixed[used, 2] = 0.0, 0.0, 0.0
                    used += 1
                shared.mixed[shared.place[at], j] += rays.shared[o, 0, a] * u + rays.shared[o, 1, a] * v
    return used
