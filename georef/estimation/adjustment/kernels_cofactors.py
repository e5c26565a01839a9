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

from georef.estimation.adjustment.kernels import kernel
from georef.estimation.adjustment.kernels_eliminate import keep_point
from georef.estimation.adjustment.kernels_points import (
    add_prior,
    invert_root,
    linearize_track,
    point_normal,
    sum_stations,
)
from georef.geometry.rigid import Array

RANK_TOLERANCE = 0.05
"""Eigenvalues of a whitened cofactor of residuals below this are directions that nothing checks."""


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
    shared = inverse.border.shape[0] > 0
    for track in range(tracks.point.shape[0]):
        point, kept, used = tracks.point[track], tracks.kept[track], 0
        slots, _, _ = linearize_track(tracks, track, images, placed, points[point], 0.0, shared, work)
        count = tracks.start[track + 1] - tracks.start[track]
        if kept >= 0:
            keep_point(count, kept, placed, work)
            tested.point[point] = inverse.border[kept : kept + 3, kept : kept + 3]
        else:
            sum_stations(count, slots, work)
            point_normal(slots, placed, work)
            if tracks.prior[track] >= 0:
                add_prior(information[tracks.prior[track]], shift[tracks.prior[track]], points[point], work)
            loose = invert_root(work.normal, 0.0, work.root)
            used = _gains(count, slots, placed, shared, work, scratch)
            _propagate(slots, used, inverse, work, scratch)
            tested.point[point] = scratch.whole
            if loose:
                tested.point[point] = np.nan
        for o in range(count):
            at = tracks.start[track] + o
            if work.slot[o] < 0:
                tested.statistic[at], tested.rank[at], tested.redundancy[at] = np.nan, -1, 0.0
                continue
            _adjusted(o, kept >= 0, shared, placed, inverse, work, scratch)
            r, c = work.residual[o], scratch.cov
            statistic, rank = _test(r[0], r[1], 1.0 - c[0, 0], -0.5 * (c[0, 1] + c[1, 0]), 1.0 - c[1, 1])
            tested.statistic[at], tested.rank[at] = statistic, rank
            tested.redundancy[at] = 2.0 - c[0, 0] - c[1, 1]
        if kept < 0:
            for a in range(used):
                work.place[work.used[a]] = -1


@kernel
def _gains(count, slots, placed, shared, work, scratch):
    """N^-1 and H' of the point's stations and border unknowns; how many the latter are."""
    root, own = work.root, scratch.own
    for i in range(3):
        for j in range(3):
            own[i, j] = root[0, i] * root[0, j] + root[1, i] * root[1, j] + root[2, i] * root[2, j]
    for s in range(slots):
        m, q, h = work.mixed[s], work.q[s], scratch.h[s]
        for j in range(3):
            a = m[0, 0] * own[0, j] + m[0, 1] * own[1, j] + m[0, 2] * own[2, j]
            b = m[1, 0] * own[0, j] + m[1, 1] * own[1, j] + m[1, 2] * own[2, j]
            c = m[2, 0] * own[0, j] + m[2, 1] * own[1, j] + m[2, 2] * own[2, j]
            h[0, j], h[1, j], h[2, j] = q[2] * b - q[1] * c, q[0] * c - q[2] * a, q[1] * a - q[0] * b
            h[3, j], h[4, j], h[5, j] = -a, -b, -c
    used = 0
    if not shared:
        return used
    for o in range(count):
        if work.slot[o] < 0:
            continue
        _by_point(o, placed, work, scratch)
        d, c = scratch.by_point, work.shared[o]
        for a in range(work.columns[o]):
            at = work.column[o, a]
            if work.place[at] < 0:
                work.place[at], work.used[used] = used, at
                scratch.h_border[used, :] = 0.0
                used += 1
            h = scratch.h_border[work.place[at]]
            for j in range(3):
                for k in range(3):
                    h[j] += (c[0, a] * d[0, k] + c[1, a] * d[1, k]) * own[k, j]
    return used


@kernel
def _by_point(o, placed, work, scratch):
    """G R (2, 3), the derivative of an observation by its point."""
    g, r = work.by_rig[o], placed.rig_rotation[work.station[work.slot[o]]]
    for i in range(2):
        for j in range(3):
            scratch.by_point[i, j] = g[i, 0] * r[0, j] + g[i, 1] * r[1, j] + g[i, 2] * r[2, j]


@kernel
def _propagate(slots, used, inverse, work, scratch):
    """Q H' of the point's stations and border unknowns, and N^-1 + H Q H'."""
    h, qh, hb, qhb = scratch.h, scratch.qh, scratch.h_border, scratch.qh_border
    qh[:slots] = 0.0
    qhb[:used] = 0.0
    for s in range(slots):
        entry = inverse.first[work.station[s]]
        for other in range(s, slots):
            while inverse.column[entry] != work.station[other]:
                entry += 1
            _add_pair(inverse.pair[entry], s, other, h, qh)
        edge = inverse.station_border[work.station[s]]
        for i in range(6):
            for a in range(used):
                q = edge[i, work.used[a]]
                for j in range(3):
                    qh[s, i, j] += q * hb[a, j]
                    qhb[a, j] += q * h[s, i, j]
    for a in range(used):
        for b in range(used):
            q = inverse.border[work.used[a], work.used[b]]
            for j in range(3):
                qhb[a, j] += q * hb[b, j]
    for i in range(3):
        for j in range(3):
            total = scratch.own[i, j]
            for s in range(slots):
                for k in range(6):
                    total += h[s, k, i] * qh[s, k, j]
            for a in range(used):
                total += hb[a, i] * qhb[a, j]
            scratch.whole[i, j] = total


@kernel
def _add_pair(q, s, other, h, qh):
    for i in range(6):
        for j in range(6):
            for k in range(3):
                qh[s, i, k] += q[i, j] * h[other, j, k]
                if other != s:
                    qh[other, j, k] += q[i, j] * h[s, i, k]


@kernel
def _adjusted(o, kept, shared, placed, inverse, work, scratch):
    """The cofactor (2, 2) of an adjusted image observation, whitened."""
    s, cov, by = work.slot[o], scratch.cov, scratch.by_station
    g, x, y, z = work.by_rig[o], work.q[s, 0], work.q[s, 1], work.q[s, 2]
    for i in range(2):
        a, b, c = g[i, 0], g[i, 1], g[i, 2]
        by[i, 0], by[i, 1], by[i, 2] = b * z - c * y, c * x - a * z, a * y - b * x
        by[i, 3], by[i, 4], by[i, 5] = -a, -b, -c
    station = work.station[s]
    own = inverse.pair[inverse.first[station]]
    for i in range(2):
        for j in range(2):
            total = 0.0
            for k in range(6):
                for m in range(6):
                    total += by[i, k] * own[k, m] * by[j, m]
            cov[i, j] = total
    if shared:
        _add_shared(o, station, inverse, work, scratch)
    if kept:
        return
    _by_point(o, placed, work, scratch)
    d, whole, qh, qhb = scratch.by_point, scratch.whole, scratch.qh[s], scratch.qh_border
    for i in range(2):
        for k in range(3):
            across = 0.0
            for m in range(6):
                across += by[i, m] * qh[m, k]
            if shared:
                for a in range(work.columns[o]):
                    across += work.shared[o, i, a] * qhb[work.place[work.column[o, a]], k]
            for j in range(2):
                cov[i, j] -= across * d[j, k]
                cov[j, i] -= across * d[j, k]
                for m in range(3):
                    cov[i, j] += d[i, k] * whole[k, m] * d[j, m]


@kernel
def _add_shared(o, station, inverse, work, scratch):
    by, cov, c = scratch.by_station, scratch.cov, work.shared[o]
    for a in range(work.columns[o]):
        at = work.column[o, a]
        for j in range(2):
            across = 0.0
            for m in range(6):
                across += by[j, m] * inverse.station_border[station, m, at]
            for i in range(2):
                cov[i, j] += c[i, a] * across
                cov[j, i] += c[i, a] * across
        for b in range(work.columns[o]):
            q = inverse.border[at, work.column[o, b]]
            for i in range(2):
                for j in range(2):
                    cov[i, j] += c[i, a] * q * c[j, b]


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
