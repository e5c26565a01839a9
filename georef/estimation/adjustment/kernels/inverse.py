"""The compiled loop over points that tests image observations against everything else, and gives points' cofactors.

With D the derivative by the point, N its normal matrix, A the one by stations and border and H = N^-1 W' (a step dx of
these moves the point by -H dx), the cofactor of an adjusted observation is D N^-1 D' + (A - D H) Q (A - D H)'. Q H' is
formed once for a point; of Q only pairs of its stations are needed, which the selected inverse has.
"""

from __future__ import annotations

from math import sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from georef.estimation.adjustment.kernels.batches import BATCH
from georef.estimation.adjustment.kernels.observations import kernel
from georef.estimation.adjustment.kernels.points import keep, linearize, point_normals, share, sum_stations
from georef.geometry.rigid import Array

RANK_TOLERANCE = 0.05
"""Eigenvalues of a whitened cofactor of residuals below this are directions that nothing checks."""
_OPEN = 1e-12  # of the cubed trace: the determinant of the normal matrix of a point with an open direction


class Inverse(NamedTuple):
    """Cofactors of stations and border, see `Cofactors`."""

    first: NDArray[np.int64]  # (S + 1,)
    column: NDArray[np.int64]  # (N,)
    pair: Array  # (N, 6, 6)
    station_border: Array  # (S, 6, B)
    border: Array  # (B, B)


class Tested(NamedTuple):
    """Results, in the order of the tracks' observations; points by their index."""

    statistic: Array  # (n,) r' Qvv^- r, whitened; NaN where no lens shows the point
    rank: NDArray[np.int8]  # (n,) of Qvv, -1 where no lens shows the point
    redundancy: Array  # (n,) trace of Qvv
    point: Array  # (P, 3, 3) cofactors; NaN where rays leave a direction open


class Scratch(NamedTuple):
    """For one point: t, the most stations; H' and Q H' by station and by border unknown."""

    h: Array  # (t, 6, 3)
    qh: Array  # (t, 6, 3)
    h_border: Array  # (B, 3)
    qh_border: Array  # (B, 3)
    own: Array  # (3, 3) N^-1
    whole: Array  # (3, 3) N^-1 + H Q H'
    by_station: Array  # (2, 6)
    by_point: Array  # (2, 3)
    cov: Array  # (2, 2)


def scratch_for(longest: int, border: int) -> Scratch:
    t, b, zero = max(longest, 1), max(border, 1), np.zeros
    stations, shared = (zero((t, 6, 3)), zero((t, 6, 3))), (zero((b, 3)), zero((b, 3)))
    return Scratch(*stations, *shared, zero((3, 3)), zero((3, 3)), zero((2, 6)), zero((2, 3)), zero((2, 2)))


@kernel
def test_observations(tracks, images, placed, points, information, shift, inverse, tested, work, scratch):
    """Fills `tested`. points (P, 3); information (K, 3, 3) and its products with given positions of point priors."""
    rays, slots, shared = work.rays, work.slots, work.shared
    border = inverse.border.shape[0] > 0
    for begin in range(0, tracks.point.shape[0], BATCH):
        end = min(begin + BATCH, tracks.point.shape[0])
        linearize(tracks, begin, end, images, placed, points, 0.0, rays, slots)
        sum_stations(tracks.start[end] - tracks.start[begin], slots.first[end - begin], rays, slots)
        point_normals(tracks, begin, end, placed, points, information, shift, 0.0, slots)
        if border:
            share(tracks, begin, end, images, placed, rays)
            keep(tracks, begin, end, placed, rays, slots)
        for track in range(begin, end):
            p, kept = track - begin, tracks.kept[track] >= 0
            o, last = tracks.start[track] - tracks.start[begin], tracks.start[track + 1] - tracks.start[begin]
            used = 0 if kept else _gains(p, o, last, placed, border, rays, slots, shared, scratch)
            if not kept:
                _propagate(slots.first[p], slots.first[p + 1], used, inverse, slots, shared, scratch)
            _keep_point_cofactor(tracks, track, kept, slots.normal, p, inverse, scratch, tested)
            for at in range(tracks.start[track], tracks.start[track + 1]):
                _test_one(
                    at, at - tracks.start[begin], p, kept, border, placed, inverse, rays, slots, shared, scratch, tested
                )
            for a in range(used):
                shared.place[shared.used[a]] = -1


@kernel
def _keep_point_cofactor(tracks, track, kept, normal, p, inverse, scratch, tested):
    """The point's own cofactor; NaN where its rays leave a direction open."""
    point = tracks.point[track]
    determinant = (
        normal[p, 0, 0] * (normal[p, 1, 1] * normal[p, 2, 2] - normal[p, 1, 2] * normal[p, 2, 1])
        - normal[p, 0, 1] * (normal[p, 1, 0] * normal[p, 2, 2] - normal[p, 1, 2] * normal[p, 2, 0])
        + normal[p, 0, 2] * (normal[p, 1, 0] * normal[p, 2, 1] - normal[p, 1, 1] * normal[p, 2, 0])
    )
    trace = normal[p, 0, 0] + normal[p, 1, 1] + normal[p, 2, 2]
    loose = not determinant > _OPEN * trace * trace * trace
    for i in range(3):
        for j in range(3):
            if kept:
                tested.point[point, i, j] = inverse.border[tracks.kept[track] + i, tracks.kept[track] + j]
            else:
                tested.point[point, i, j] = np.nan if loose else scratch.whole[i, j]


@kernel
def _test_one(at, o, p, kept, border, placed, inverse, rays, slots, shared, scratch, tested):
    """Tests observation `at`, the batch's o-th, of its p-th point."""
    if rays.slot[o] < 0:
        tested.statistic[at], tested.rank[at], tested.redundancy[at] = np.nan, -1, 0.0
        return
    _adjusted(o, slots.first[p], kept, border, placed, inverse, rays, slots, shared, scratch)
    c = scratch.cov
    u, v = rays.residual[o, 0], rays.residual[o, 1]
    statistic, rank = _test(u, v, 1.0 - c[0, 0], -0.5 * (c[0, 1] + c[1, 0]), 1.0 - c[1, 1])
    tested.statistic[at], tested.rank[at] = statistic, rank
    tested.redundancy[at] = 2.0 - c[0, 0] - c[1, 1]


@kernel
def _gains(p, begin, end, placed, border, rays, slots, shared, scratch):
    """N^-1 and H' of a point's stations and border unknowns; how many the latter are."""
    own, h, root = scratch.own, scratch.h, slots.root
    for i in range(3):
        for j in range(3):
            total = 0.0
            for k in range(max(i, j), 3):
                total += root[p, k, i] * root[p, k, j]
            own[i, j] = total
    for s in range(slots.first[p], slots.first[p + 1]):
        at, x, y, z = s - slots.first[p], slots.q[s, 0], slots.q[s, 1], slots.q[s, 2]
        for j in range(3):
            a, b, c = 0.0, 0.0, 0.0
            for k in range(3):
                a += slots.mixed[s, 0, k] * own[k, j]
                b += slots.mixed[s, 1, k] * own[k, j]
                c += slots.mixed[s, 2, k] * own[k, j]
            h[at, 0, j], h[at, 1, j], h[at, 2, j] = z * b - y * c, x * c - z * a, y * a - x * b
            h[at, 3, j], h[at, 4, j], h[at, 5, j] = -a, -b, -c
    used = 0
    if not border:
        return used
    for o in range(begin, end):
        if rays.slot[o] < 0:
            continue
        _by_point(o, placed, rays, slots, scratch)
        for a in range(rays.columns[o]):
            at = rays.column[o, a]
            if shared.place[at] < 0:
                shared.place[at], shared.used[used] = used, at
                for j in range(3):
                    scratch.h_border[used, j] = 0.0
                used += 1
            place = shared.place[at]
            for k in range(3):
                w = rays.shared[o, 0, a] * scratch.by_point[0, k] + rays.shared[o, 1, a] * scratch.by_point[1, k]
                for j in range(3):
                    scratch.h_border[place, j] += w * own[k, j]
    return used


@kernel
def _by_point(o, placed, rays, slots, scratch):
    """G R (2, 3), the derivative of an observation by its point."""
    station = slots.station[rays.slot[o]]
    for i in range(2):
        for j in range(3):
            total = 0.0
            for k in range(3):
                total += rays.by_rig[o, i, k] * placed.rig_rotation[station, k, j]
            scratch.by_point[i, j] = total


@kernel
def _propagate(begin, end, used, inverse, slots, shared, scratch):
    """Q H' of a point's stations (slots begin to end) and border unknowns, and N^-1 + H Q H'."""
    h, qh, hb, qhb = scratch.h, scratch.qh, scratch.h_border, scratch.qh_border
    count = end - begin
    qh[:count] = 0.0
    qhb[:used] = 0.0
    for s in range(count):
        station = slots.station[begin + s]
        entry = inverse.first[station]
        for other in range(s, count):
            while inverse.column[entry] != slots.station[begin + other]:
                entry += 1
            _add_pair(inverse.pair, entry, s, other, h, qh)
        for i in range(6):
            for a in range(used):
                q = inverse.station_border[station, i, shared.used[a]]
                for j in range(3):
                    qh[s, i, j] += q * hb[a, j]
                    qhb[a, j] += q * h[s, i, j]
    for a in range(used):
        for b in range(used):
            q = inverse.border[shared.used[a], shared.used[b]]
            for j in range(3):
                qhb[a, j] += q * hb[b, j]
    for i in range(3):
        for j in range(3):
            total = scratch.own[i, j]
            for s in range(count):
                for k in range(6):
                    total += h[s, k, i] * qh[s, k, j]
            for a in range(used):
                total += hb[a, i] * qhb[a, j]
            scratch.whole[i, j] = total


@kernel
def _add_pair(pair, entry, s, other, h, qh):
    for i in range(6):
        for j in range(6):
            q = pair[entry, i, j]
            for k in range(3):
                qh[s, i, k] += q * h[other, j, k]
                if other != s:
                    qh[other, j, k] += q * h[s, i, k]


@kernel
def _adjusted(o, first, kept, border, placed, inverse, rays, slots, shared, scratch):
    """The cofactor (2, 2) of an adjusted image observation, whitened; first: slot of its point's first station."""
    s, cov, by = rays.slot[o], scratch.cov, scratch.by_station
    x, y, z = slots.q[s, 0], slots.q[s, 1], slots.q[s, 2]
    for i in range(2):
        a, b, c = rays.by_rig[o, i, 0], rays.by_rig[o, i, 1], rays.by_rig[o, i, 2]
        by[i, 0], by[i, 1], by[i, 2] = b * z - c * y, c * x - a * z, a * y - b * x
        by[i, 3], by[i, 4], by[i, 5] = -a, -b, -c
    station = slots.station[s]
    own = inverse.first[station]
    for i in range(2):
        for j in range(2):
            total = 0.0
            for k in range(6):
                for m in range(6):
                    total += by[i, k] * inverse.pair[own, k, m] * by[j, m]
            cov[i, j] = total
    if border:
        _add_shared(o, station, inverse, rays, scratch)
    if kept:
        return
    _by_point(o, placed, rays, slots, scratch)
    d, whole, qh, qhb = scratch.by_point, scratch.whole, scratch.qh, scratch.qh_border
    for i in range(2):
        for k in range(3):
            across, point = 0.0, 0.0
            for m in range(6):
                across += by[i, m] * qh[s - first, m, k]
            if border:
                for a in range(rays.columns[o]):
                    across += rays.shared[o, i, a] * qhb[shared.place[rays.column[o, a]], k]
            for m in range(3):
                point += d[i, m] * whole[m, k]
            for j in range(2):
                cov[i, j] += (point - across) * d[j, k]
                cov[j, i] -= across * d[j, k]


@kernel
def _add_shared(o, station, inverse, rays, scratch):
    by, cov = scratch.by_station, scratch.cov
    for a in range(rays.columns[o]):
        at = rays.column[o, a]
        for j in range(2):
            across = 0.0
            for m in range(6):
                across += by[j, m] * inverse.station_border[station, m, at]
            for i in range(2):
                cov[i, j] += rays.shared[o, i, a] * across
                cov[j, i] += rays.shared[o, i, a] * across
        for b in range(rays.columns[o]):
            q = inverse.border[at, rays.column[o, b]]
            for i in range(2):
                for j in range(2):
                    cov[i, j] += rays.shared[o, i, a] * q * rays.shared[o, j, b]


@kernel
def _test(r0, r1, a, b, c):
    """r' Q^- r of a symmetric Q = [[a, b], [b, c]], and its rank."""
    mean, half = 0.5 * (a + c), sqrt(0.25 * (a - c) ** 2 + b * b)
    high, low = mean + half, mean - half
    if low > RANK_TOLERANCE:
        return (c * r0 * r0 - 2.0 * b * r0 * r1 + a * r1 * r1) / (a * c - b * b), 2
    if not high > RANK_TOLERANCE:
        return 0.0, 0
    x, y = (b, high - a) if a < c else (high - c, b)
    along = (x * r0 + y * r1) / sqrt(x * x + y * y)
    return along * along / high, 1
