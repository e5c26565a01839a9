"""The compiled loop over points that fills the reduced normal equations."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from georef.estimation.adjustment.kernels.batches import BATCH
from georef.estimation.adjustment.kernels.observations import kernel
from georef.estimation.adjustment.kernels.points import keep, linearize, point_normals, share, sum_stations
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
    """The stations' own normal matrices T'MT (upper triangles) and gradients T'g, T = [[q]x, -I], of all slots."""
    block, gradient, diagonal = sums.block, sums.gradient, sums.diagonal
    for s in range(count):
        station = slots.station[s]
        own, at = sums.first[station], 6 * station
        x, y, z = slots.q[s, 0], slots.q[s, 1], slots.q[s, 2]
        a, b, c = slots.square[s, 0, 0], slots.square[s, 0, 1], slots.square[s, 0, 2]
        d, e, f = slots.square[s, 1, 1], slots.square[s, 1, 2], slots.square[s, 2, 2]
        u, v, w = slots.slope[s, 0], slots.slope[s, 1], slots.slope[s, 2]
        m00, m01, m02 = z * b - y * c, z * d - y * e, z * e - y * f  # [q]x' M
        m10, m11, m12 = x * c - z * a, x * e - z * b, x * f - z * c
        m20, m21, m22 = y * a - x * b, y * b - x * d, y * c - x * e
        d0, d1, d2 = m01 * z - m02 * y, m12 * x - m10 * z, m20 * y - m21 * x
        block[own, 0, 0] += d0
        block[own, 0, 1] += m02 * x - m00 * z
        block[own, 0, 2] += m00 * y - m01 * x
        block[own, 0, 3] -= m00
        block[own, 0, 4] -= m01
        block[own, 0, 5] -= m02
        block[own, 1, 1] += d1
        block[own, 1, 2] += m10 * y - m11 * x
        block[own, 1, 3] -= m10
        block[own, 1, 4] -= m11
        block[own, 1, 5] -= m12
        block[own, 2, 2] += d2
        block[own, 2, 3] -= m20
        block[own, 2, 4] -= m21
        block[own, 2, 5] -= m22
        block[own, 3, 3] += a
        block[own, 3, 4] += b
        block[own, 3, 5] += c
        block[own, 4, 4] += d
        block[own, 4, 5] += e
        block[own, 5, 5] += f
        gradient[at] += z * v - y * w
        gradient[at + 1] += x * w - z * u
        gradient[at + 2] += y * u - x * v
        gradient[at + 3] -= u
        gradient[at + 4] -= v
        gradient[at + 5] -= w
        diagonal[at] += d0
        diagonal[at + 1] += d1
        diagonal[at + 2] += d2
        diagonal[at + 3] += a
        diagonal[at + 4] += d
        diagonal[at + 5] += f


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
            m, at = slots.mixed, 6 * slots.station[s]
            x, y, z = slots.q[s, 0], slots.q[s, 1], slots.q[s, 2]
            m00, m01, m02 = m[s, 0, 0], m[s, 0, 1], m[s, 0, 2]
            m10, m11, m12 = m[s, 1, 0], m[s, 1, 1], m[s, 1, 2]
            m20, m21, m22 = m[s, 2, 0], m[s, 2, 1], m[s, 2, 2]
            for i in range(3):
                if i == 0:
                    a, b, c, h = -r00 * m00, -r00 * m10, -r00 * m20, h0
                elif i == 1:
                    a, b, c, h = -(r10 * m00 + r11 * m01), -(r10 * m10 + r11 * m11), -(r10 * m20 + r11 * m21), h1
                else:
                    a = -(r20 * m00 + r21 * m01 + r22 * m02)
                    b = -(r20 * m10 + r21 * m11 + r22 * m12)
                    c = -(r20 * m20 + r21 * m21 + r22 * m22)
                    h = h2
                k, n, o = y * c - z * b, z * a - x * c, x * b - y * a
                e[s, i, 0], e[s, i, 1], e[s, i, 2], e[s, i, 3], e[s, i, 4], e[s, i, 5] = k, n, o, a, b, c
                gradient[at] -= k * h
                gradient[at + 1] -= n * h
                gradient[at + 2] -= o * h
                gradient[at + 3] -= a * h
                gradient[at + 4] -= b * h
                gradient[at + 5] -= c * h
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
