"""The compiled loop over points that follows a step of stations and border: points found again, costs compared."""

from __future__ import annotations

from georef.estimation.adjustment.kernels.batches import BATCH
from georef.estimation.adjustment.kernels.observations import kernel, lens
from georef.estimation.adjustment.kernels.points import linearize, loss, share


@kernel
def move_points(
    tracks, images, pairs, placed, moved, points, damping, cauchy, hidden_square, step, back, moved_points, work
):
    """Fills moved_points (P, 3) by back-substitution of step (6 S + B,), which leads from `placed` to `moved`; `back`
    is of the elimination at `placed` with this damping.

    The cost of the image observations after the step with hidden_square for the squared residual of one that no lens
    shows, how many those are, and the sum of the squared steps of points times the diagonal of their normal matrices.
    """
    cost, hidden, squares, by_shared = 0.0, 0, 0.0, work.slots.right
    shared = images.mounting_column.max() >= 0 or images.calibration_column.max() >= 0
    by_shared[:] = 0.0
    for begin in range(0, tracks.point.shape[0], BATCH):
        end = min(begin + BATCH, tracks.point.shape[0])
        if shared:
            _sum_shared(tracks, begin, end, images, placed, points, cauchy, step, work.rays, work.slots)
        squares += _move(
            tracks, begin, end, images, pairs.slot, placed, points, damping, step, back, by_shared, moved_points
        )
        more, unseen = _cost(tracks, begin, end, images, moved, moved_points, cauchy, hidden_square)
        cost, hidden = cost + more, hidden + unseen
    return cost, hidden, squares


@kernel
def _sum_shared(tracks, begin, end, images, placed, points, cauchy, step, rays, slots):
    """W' step of the mountings and calibrations that a batch's points are seen through, in `right` of the slots."""
    linearize(tracks, begin, end, images, placed, points, cauchy, rays, slots)
    share(tracks, begin, end, images, placed, rays)
    r, g, unknown, offset = placed.rig_rotation, rays.by_rig, 6 * placed.rig_rotation.shape[0], tracks.start[begin]
    for track in range(begin, end):
        wx, wy, wz = 0.0, 0.0, 0.0
        for o in range(tracks.start[track] - offset, tracks.start[track + 1] - offset):
            if rays.slot[o] < 0 or not rays.columns[o]:
                continue
            u, v, s = 0.0, 0.0, slots.station[rays.slot[o]]
            for a in range(rays.columns[o]):
                change = step[unknown + rays.column[o, a]]
                u, v = u + rays.shared[o, 0, a] * change, v + rays.shared[o, 1, a] * change
            x = g[o, 0, 0] * u + g[o, 1, 0] * v
            y = g[o, 0, 1] * u + g[o, 1, 1] * v
            z = g[o, 0, 2] * u + g[o, 1, 2] * v
            wx += r[s, 0, 0] * x + r[s, 1, 0] * y + r[s, 2, 0] * z
            wy += r[s, 0, 1] * x + r[s, 1, 1] * y + r[s, 2, 1] * z
            wz += r[s, 0, 2] * x + r[s, 1, 2] * y + r[s, 2, 2] * z
        slots.right[track - begin, 0], slots.right[track - begin, 1], slots.right[track - begin, 2] = wx, wy, wz


@kernel
def _move(tracks, begin, end, images, slot, placed, points, damping, step, back, by_shared, moved_points):
    """Points after the step; the sum of their squared steps times the diagonal of their normal matrices."""
    r, t, unknown, squares = placed.rig_rotation, placed.rig_translation, 6 * placed.rig_rotation.shape[0], 0.0
    for track in range(begin, end):
        point, kept = tracks.point[track], tracks.kept[track]
        px, py, pz = points[point, 0], points[point, 1], points[point, 2]
        if kept >= 0:
            for i in range(3):
                moved_points[point, i] = points[point, i] + step[unknown + kept + i]
            continue
        wx, wy, wz = by_shared[track - begin, 0], by_shared[track - begin, 1], by_shared[track - begin, 2]  # W' step
        s, m = -1, slot[track] - 1
        for at in range(tracks.start[track], tracks.start[track + 1]):
            here = images.station[tracks.image[at]]
            if here == s:
                continue
            s, m = here, m + 1
            x = r[s, 0, 0] * px + r[s, 0, 1] * py + r[s, 0, 2] * pz + t[s, 0]
            y = r[s, 1, 0] * px + r[s, 1, 1] * py + r[s, 1, 2] * pz + t[s, 1]
            z = r[s, 2, 0] * px + r[s, 2, 1] * py + r[s, 2, 2] * pz + t[s, 2]
            k = 6 * s
            u = y * step[k + 2] - z * step[k + 1] - step[k + 3]
            v = z * step[k] - x * step[k + 2] - step[k + 4]
            w = x * step[k + 1] - y * step[k] - step[k + 5]
            q = back.square
            a = q[m, 0] * u + q[m, 1] * v + q[m, 2] * w
            b = q[m, 1] * u + q[m, 3] * v + q[m, 4] * w
            c = q[m, 2] * u + q[m, 4] * v + q[m, 5] * w
            wx += r[s, 0, 0] * a + r[s, 1, 0] * b + r[s, 2, 0] * c
            wy += r[s, 0, 1] * a + r[s, 1, 1] * b + r[s, 2, 1] * c
            wz += r[s, 0, 2] * a + r[s, 1, 2] * b + r[s, 2, 2] * c
        f, h = back.root, back.right
        h0 = h[track, 0] + f[track, 0] * wx
        h1 = h[track, 1] + f[track, 1] * wx + f[track, 2] * wy
        h2 = h[track, 2] + f[track, 3] * wx + f[track, 4] * wy + f[track, 5] * wz
        dx = f[track, 0] * h0 + f[track, 1] * h1 + f[track, 3] * h2
        dy = f[track, 2] * h1 + f[track, 4] * h2
        dz = f[track, 5] * h2
        moved_points[point, 0], moved_points[point, 1], moved_points[point, 2] = px - dx, py - dy, pz - dz
        if damping > 0.0:
            squares += _weighed(f, track, dx, dy, dz) / (1.0 + damping)
    return squares


@kernel
def _weighed(root, track, dx, dy, dz):
    """Squares of a step times the diagonal of the matrix whose Cholesky factor has this inverse."""
    l00, l11, l22 = 1.0 / root[track, 0], 1.0 / root[track, 2], 1.0 / root[track, 5]
    l10 = -root[track, 1] * l00 * l11
    l21 = -root[track, 4] * l11 * l22
    l20 = -(root[track, 3] * l00 + root[track, 4] * l10) * l22
    return l00 * l00 * dx * dx + (l10 * l10 + l11 * l11) * dy * dy + (l20 * l20 + l21 * l21 + l22 * l22) * dz * dz


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
            shown, iu, iv, _, _, _, _, _, _ = lens(placed.model[row], k, row, u, v, w)
            if shown:
                a = (iu * k[row, 0] + k[row, 2] - tracks.pixel[at, 0]) * tracks.weight[at]
                b = (iv * k[row, 1] + k[row, 3] - tracks.pixel[at, 1]) * tracks.weight[at]
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
