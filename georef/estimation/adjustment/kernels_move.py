"""The compiled loop over points that follows a step of stations and border: points found again, costs compared."""

from __future__ import annotations

import numpy as np

from georef.estimation.adjustment.kernels import kernel, lens
from georef.estimation.adjustment.kernels_points import (
    BATCH,
    keep,
    linearize,
    loss,
    point_normals,
    share,
    sum_stations,
)


@kernel
def move_points(
    tracks, images, placed, moved, points, information, shift, damping, cauchy, hidden_square, step, moved_points, work
):
    """Fills moved_points (P, 3) by back-substitution of step (6 S + B,), which leads from `placed` to `moved`.

    The decrease of the cost that the linear model of the image observations promises, their cost after the step with
    hidden_square for the squared residual of one that no lens shows, and how many those are.
    """
    promised, cost, hidden = 0.0, 0.0, 0
    rays, slots = work.rays, work.slots
    border = step.shape[0] > 6 * placed.rig_rotation.shape[0]
    for begin in range(0, tracks.point.shape[0], BATCH):
        end = min(begin + BATCH, tracks.point.shape[0])
        linearize(tracks, begin, end, images, placed, points, cauchy, rays, slots)
        if border:
            share(tracks, begin, end, images, placed, rays)
            keep(tracks, begin, end, placed, rays, slots)
        count = tracks.start[end] - tracks.start[begin]
        promised += _squares(count, rays)
        _predict(count, 6 * placed.rig_rotation.shape[0], step, rays, slots)
        sum_stations(count, slots.first[end - begin], rays, slots)
        point_normals(tracks, begin, end, placed, points, information, shift, damping, slots)
        _move(tracks, begin, end, 6 * placed.rig_rotation.shape[0], step, points, moved_points, slots)
        _predict_by_points(tracks, begin, end, placed.rig_rotation, rays, slots)
        promised -= _squares(count, rays)
        more, unseen = _cost(tracks, begin, end, images, moved, moved_points, cauchy, hidden_square)
        cost, hidden = cost + more, hidden + unseen
    return promised, cost, hidden


@kernel
def _squares(count, rays):
    """Half the squared residuals of a batch."""
    total = 0.0
    for o in range(count):
        if rays.slot[o] >= 0:
            total += rays.residual[o, 0] ** 2 + rays.residual[o, 1] ** 2
    return 0.5 * total


@kernel
def _predict(count, unknown, step, rays, slots):
    """Adds to the residuals what the step of stations and border changes."""
    for o in range(count):
        s = rays.slot[o]
        if s < 0:
            continue
        at, q = 6 * slots.station[s], slots.q
        x = q[s, 1] * step[at + 2] - q[s, 2] * step[at + 1] - step[at + 3]
        y = q[s, 2] * step[at] - q[s, 0] * step[at + 2] - step[at + 4]
        z = q[s, 0] * step[at + 1] - q[s, 1] * step[at] - step[at + 5]
        for i in range(2):
            change = rays.by_rig[o, i, 0] * x + rays.by_rig[o, i, 1] * y + rays.by_rig[o, i, 2] * z
            for a in range(rays.columns[o]):
                change += rays.shared[o, i, a] * step[unknown + rays.column[o, a]]
            rays.residual[o, i] += change


@kernel
def _move(tracks, begin, end, unknown, step, points, moved_points, slots):
    """Points of a batch after the step, from what is left of their gradients; leaves the steps of those that were
    eliminated in `right`, zero for the others."""
    for p in range(end - begin):
        point, kept, right, root = tracks.point[begin + p], tracks.kept[begin + p], slots.right, slots.root
        if kept >= 0:
            for i in range(3):
                moved_points[point, i] = points[point, i] + step[unknown + kept + i]
                right[p, i] = 0.0
            continue
        h0 = root[p, 0, 0] * right[p, 0]
        h1 = root[p, 1, 0] * right[p, 0] + root[p, 1, 1] * right[p, 1]
        h2 = root[p, 2, 0] * right[p, 0] + root[p, 2, 1] * right[p, 1] + root[p, 2, 2] * right[p, 2]
        right[p, 0] = -(root[p, 0, 0] * h0 + root[p, 1, 0] * h1 + root[p, 2, 0] * h2)
        right[p, 1] = -(root[p, 1, 1] * h1 + root[p, 2, 1] * h2)
        right[p, 2] = -root[p, 2, 2] * h2
        for i in range(3):
            moved_points[point, i] = points[point, i] + right[p, i]


@kernel
def _predict_by_points(tracks, begin, end, rotation, rays, slots):
    """Adds to the residuals what the points' steps change."""
    for p in range(end - begin):
        x, y, z = slots.right[p, 0], slots.right[p, 1], slots.right[p, 2]
        for at in range(tracks.start[begin + p], tracks.start[begin + p + 1]):
            o = at - tracks.start[begin]
            if rays.slot[o] < 0:
                continue
            s = slots.station[rays.slot[o]]
            for j in range(3):
                change = rotation[s, j, 0] * x + rotation[s, j, 1] * y + rotation[s, j, 2] * z
                rays.residual[o, 0] += rays.by_rig[o, 0, j] * change
                rays.residual[o, 1] += rays.by_rig[o, 1, j] * change


@kernel
def _cost(tracks, begin, end, images, placed, points, cauchy, hidden_square):
    """Cost of the observations of tracks begin to end, hidden_square for the squared residual of one that no lens
    shows; how many those are."""
    cost, hidden = 0.0, 0
    r, t, c, d, k = (
        placed.rig_rotation,
        placed.rig_translation,
        placed.cam_rotation,
        placed.cam_translation,
        placed.parameters,
    )
    seen = np.empty(8)
    for track in range(begin, end):
        point, last, x, y, z = tracks.point[track], -1, 0.0, 0.0, 0.0
        px, py, pz = points[point, 0], points[point, 1], points[point, 2]
        for at in range(tracks.start[track], tracks.start[track + 1]):
            view = tracks.image[at]
            s, m, row = images.station[view], images.mounting[view], images.calibration[view]
            if s != last:
                last = s
                x = r[s, 0, 0] * px + r[s, 0, 1] * py + r[s, 0, 2] * pz + t[s, 0]
                y = r[s, 1, 0] * px + r[s, 1, 1] * py + r[s, 1, 2] * pz + t[s, 1]
                z = r[s, 2, 0] * px + r[s, 2, 1] * py + r[s, 2, 2] * pz + t[s, 2]
            u = c[m, 0, 0] * x + c[m, 0, 1] * y + c[m, 0, 2] * z + d[m, 0]
            v = c[m, 1, 0] * x + c[m, 1, 1] * y + c[m, 1, 2] * z + d[m, 1]
            w = c[m, 2, 0] * x + c[m, 2, 1] * y + c[m, 2, 2] * z + d[m, 2]
            square = hidden_square
            if lens(placed.model[row], k, row, u, v, w, seen):
                a = (seen[0] * k[row, 0] + k[row, 2] - tracks.pixel[at, 0]) * tracks.weight[at]
                b = (seen[1] * k[row, 1] + k[row, 3] - tracks.pixel[at, 1]) * tracks.weight[at]
                square = a * a + b * b
            else:
                hidden += 1
            cost += loss(square, cauchy)
    return cost, hidden


@kernel
def all_cost(tracks, images, placed, points, cauchy, hidden_square):
    """Cost of all image observations, and how many no lens shows."""
    cost, hidden = 0.0, 0
    for begin in range(0, tracks.point.shape[0], BATCH):
        end = min(begin + BATCH, tracks.point.shape[0])
        more, unseen = _cost(tracks, begin, end, images, placed, points, cauchy, hidden_square)
        cost, hidden = cost + more, hidden + unseen
    return cost, hidden
