"""The compiled loop over points that follows a step of stations and border: points found again, costs compared."""

from __future__ import annotations

from georef.estimation.adjustment.kernels import kernel, observe
from georef.estimation.adjustment.kernels_eliminate import keep_point
from georef.estimation.adjustment.kernels_points import (
    add_prior,
    invert_root,
    linearize_track,
    point_normal,
    robust,
    sum_stations,
    to_rig,
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
    unknown = 6 * placed.rig_rotation.shape[0]
    shared = step.shape[0] > unknown
    for track in range(tracks.point.shape[0]):
        point = tracks.point[track]
        xyz, new = points[point], moved_points[point]
        slots, _, _ = linearize_track(tracks, track, images, placed, xyz, cauchy, shared, work)
        count = tracks.start[track + 1] - tracks.start[track]
        kept = tracks.kept[track]
        if kept >= 0:
            keep_point(count, kept, placed, work)
        promised += _predict(count, unknown, shared, step, work)
        if kept >= 0:
            for i in range(3):
                new[i] = xyz[i] + step[unknown + kept + i]
        else:
            sum_stations(count, slots, work)
            point_normal(slots, placed, work)
            if tracks.prior[track] >= 0:
                add_prior(information[tracks.prior[track]], shift[tracks.prior[track]], xyz, work)
            invert_root(work.normal, damping, work.root)
            _solve_point(work)
            for i in range(3):
                new[i] = xyz[i] + work.right[i]
            _predict_by_point(count, placed, work)
        for o in range(count):
            if work.slot[o] >= 0:
                promised -= 0.5 * (work.residual[o, 0] ** 2 + work.residual[o, 1] ** 2)
        more, unseen = track_cost(tracks, track, images, moved, new, cauchy, hidden_square, work)
        cost, hidden = cost + more, hidden + unseen
    return promised, cost, hidden


@kernel
def _predict(count, unknown, shared, step, work):
    """Adds to the residuals what the step of stations and border changes; their cost before."""
    before = 0.0
    for o in range(count):
        s = work.slot[o]
        if s < 0:
            continue
        r, g, at, q = work.residual[o], work.by_rig[o], 6 * work.station[s], work.q[s]
        before += 0.5 * (r[0] * r[0] + r[1] * r[1])
        x = q[1] * step[at + 2] - q[2] * step[at + 1] - step[at + 3]
        y = q[2] * step[at] - q[0] * step[at + 2] - step[at + 4]
        z = q[0] * step[at + 1] - q[1] * step[at] - step[at + 5]
        for i in range(2):
            r[i] += g[i, 0] * x + g[i, 1] * y + g[i, 2] * z
        if shared:
            for a in range(work.columns[o]):
                change = step[unknown + work.column[o, a]]
                r[0] += work.shared[o, 0, a] * change
                r[1] += work.shared[o, 1, a] * change
    return before


@kernel
def _solve_point(work):
    """The point's step in `right`, from its gradient there."""
    root, g = work.root, work.right
    h0 = root[0, 0] * g[0]
    h1 = root[1, 0] * g[0] + root[1, 1] * g[1]
    h2 = root[2, 0] * g[0] + root[2, 1] * g[1] + root[2, 2] * g[2]
    g[0] = -(root[0, 0] * h0 + root[1, 0] * h1 + root[2, 0] * h2)
    g[1] = -(root[1, 1] * h1 + root[2, 1] * h2)
    g[2] = -root[2, 2] * h2


@kernel
def _predict_by_point(count, placed, work):
    """Adds to the residuals what the point's step changes."""
    step = work.right
    for o in range(count):
        s = work.slot[o]
        if s < 0:
            continue
        g, rotation = work.by_rig[o], placed.rig_rotation[work.station[s]]
        for j in range(3):
            change = rotation[j, 0] * step[0] + rotation[j, 1] * step[1] + rotation[j, 2] * step[2]
            work.residual[o, 0] += g[0, j] * change
            work.residual[o, 1] += g[1, j] * change


@kernel
def track_cost(tracks, track, images, placed, xyz, cauchy, hidden_square, work):
    """Cost of a point's observations, hidden_square for the squared residual of one that no lens shows; how many."""
    cost, hidden, last = 0.0, 0, -1
    image, by_cam, cam = work.small[0], work.small[1:3], work.small[3]
    q, residual = work.q[0], work.residual[0]
    for at in range(tracks.start[track], tracks.start[track + 1]):
        view = tracks.image[at]
        station, mounting, calibration = images.station[view], images.mounting[view], images.calibration[view]
        if station != last:
            last = station
            to_rig(placed, station, xyz[0], xyz[1], xyz[2], q)
        pixel, weight = tracks.pixel[at], tracks.weight[at]
        square = hidden_square
        if observe(placed, mounting, calibration, q, pixel, weight, cam, image, residual, by_cam):
            square = residual[0] * residual[0] + residual[1] * residual[1]
        else:
            hidden += 1
        cost += robust(square, cauchy)[0]
    return cost, hidden


@kernel
def all_cost(tracks, images, placed, points, cauchy, hidden_square, work):
    """Cost of all image observations, and how many no lens shows."""
    cost, hidden = 0.0, 0
    for track in range(tracks.point.shape[0]):
        xyz = points[tracks.point[track]]
        more, unseen = track_cost(tracks, track, images, placed, xyz, cauchy, hidden_square, work)
        cost, hidden = cost + more, hidden + unseen
    return cost, hidden
