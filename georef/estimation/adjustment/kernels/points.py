"""Compiled kernels over a batch of points: their image observations linearised, summed by station, points inverted.

An observation depends on its station and point through the point q in the rig frame only: with G its derivative (2, 3)
by q, the derivative by the station is G [[q]x, -I] and by the point G R. So the cameras of a station are first summed
into G'G (3, 3) and G'r (3,), and elimination works on stations.
"""

from __future__ import annotations

from math import log1p, sqrt

from georef.estimation.adjustment.kernels.observations import by_unknown, kernel, lens

_UNDETERMINED, _HELD = 1e-12, 1e-10  # of the trace of a point's normal matrix


@kernel
def linearize(tracks, begin, end, images, placed, points, cauchy, rays, slots):
    """Linearises all observations of tracks begin to end; their cost, and how many no lens shows."""
    count, cost, hidden, offset = 0, 0.0, 0, tracks.start[begin]
    x, y, z = 0.0, 0.0, 0.0
    r, t, c, d, k = (
        placed.rig_rotation,
        placed.rig_translation,
        placed.cam_rotation,
        placed.cam_translation,
        placed.parameters,
    )
    for track in range(begin, end):
        slots.first[track - begin] = count
        point, last = tracks.point[track], -1
        px, py, pz = points[point, 0], points[point, 1], points[point, 2]
        for at in range(tracks.start[track], tracks.start[track + 1]):
            o, view = at - offset, tracks.image[at]
            s, m, row = images.station[view], images.mounting[view], images.calibration[view]
            if s != last:
                last = s
                x = r[s, 0, 0] * px + r[s, 0, 1] * py + r[s, 0, 2] * pz + t[s, 0]
                y = r[s, 1, 0] * px + r[s, 1, 1] * py + r[s, 1, 2] * pz + t[s, 1]
                z = r[s, 2, 0] * px + r[s, 2, 1] * py + r[s, 2, 2] * pz + t[s, 2]
                slots.station[count] = s
                slots.q[count, 0], slots.q[count, 1], slots.q[count, 2] = x, y, z
                count += 1
            # Values in hand, not read again: the compiler must take any array that is written for any other.
            c00, c01, c02 = c[m, 0, 0], c[m, 0, 1], c[m, 0, 2]
            c10, c11, c12 = c[m, 1, 0], c[m, 1, 1], c[m, 1, 2]
            c20, c21, c22 = c[m, 2, 0], c[m, 2, 1], c[m, 2, 2]
            u = c00 * x + c01 * y + c02 * z + d[m, 0]
            v = c10 * x + c11 * y + c12 * z + d[m, 1]
            w = c20 * x + c21 * y + c22 * z + d[m, 2]
            rays.columns[o] = 0
            shown, iu, iv, e0, e1, e2, f0, f1, f2 = lens(placed.model[row], k, row, u, v, w)
            if not shown:
                rays.slot[o] = -1
                hidden += 1
                continue
            weight, fx, fy = tracks.weight[at], k[row, 0], k[row, 1]
            a = (iu * fx + k[row, 2] - tracks.pixel[at, 0]) * weight
            b = (iv * fy + k[row, 3] - tracks.pixel[at, 1]) * weight
            damp = root_weight(a * a + b * b, cauchy)
            cost += loss(a * a + b * b, cauchy)
            weight *= damp
            rays.slot[o], rays.scale[o] = count - 1, weight
            rays.residual[o, 0], rays.residual[o, 1] = a * damp, b * damp
            rays.cam[o, 0], rays.cam[o, 1], rays.cam[o, 2] = u, v, w
            rays.image[o, 0], rays.image[o, 1] = iu, iv
            fx, fy = fx * weight, fy * weight
            e0, e1, e2, f0, f1, f2 = e0 * fx, e1 * fx, e2 * fx, f0 * fy, f1 * fy, f2 * fy
            rays.by_cam[o, 0, 0], rays.by_cam[o, 0, 1], rays.by_cam[o, 0, 2] = e0, e1, e2
            rays.by_cam[o, 1, 0], rays.by_cam[o, 1, 1], rays.by_cam[o, 1, 2] = f0, f1, f2
            rays.by_rig[o, 0, 0] = e0 * c00 + e1 * c10 + e2 * c20
            rays.by_rig[o, 0, 1] = e0 * c01 + e1 * c11 + e2 * c21
            rays.by_rig[o, 0, 2] = e0 * c02 + e1 * c12 + e2 * c22
            rays.by_rig[o, 1, 0] = f0 * c00 + f1 * c10 + f2 * c20
            rays.by_rig[o, 1, 1] = f0 * c01 + f1 * c11 + f2 * c21
            rays.by_rig[o, 1, 2] = f0 * c02 + f1 * c12 + f2 * c22
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
    square, slope = slots.square, slots.slope
    square[:slot_count] = 0.0
    slope[:slot_count] = 0.0
    for o in range(count):
        s = rays.slot[o]
        if s < 0:
            continue
        u, v = rays.residual[o, 0], rays.residual[o, 1]
        a0, a1, a2 = rays.by_rig[o, 0, 0], rays.by_rig[o, 0, 1], rays.by_rig[o, 0, 2]
        b0, b1, b2 = rays.by_rig[o, 1, 0], rays.by_rig[o, 1, 1], rays.by_rig[o, 1, 2]
        slope[s, 0] += a0 * u + b0 * v
        slope[s, 1] += a1 * u + b1 * v
        slope[s, 2] += a2 * u + b2 * v
        xy, xz, yz = a0 * a1 + b0 * b1, a0 * a2 + b0 * b2, a1 * a2 + b1 * b2
        square[s, 0, 0] += a0 * a0 + b0 * b0
        square[s, 0, 1] += xy
        square[s, 0, 2] += xz
        square[s, 1, 0] += xy
        square[s, 1, 1] += a1 * a1 + b1 * b1
        square[s, 1, 2] += yz
        square[s, 2, 0] += xz
        square[s, 2, 1] += yz
        square[s, 2, 2] += a2 * a2 + b2 * b2


@kernel
def point_normals(tracks, begin, end, placed, points, information, shift, damping, slots):
    """Normal matrices and gradients of a batch's points, priors included, and the inverse roots of the damped ones; how
    many points their rays leave undetermined."""
    loose = 0
    for p in range(end - begin):
        _sum_point(p, slots.first[p], slots.first[p + 1], placed.rig_rotation, slots)
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
def _sum_point(p, first, last, r, slots):
    """Sums R'G'GR and R'G'r of a point's slots first to last; leaves G'GR of each in `mixed`."""
    xx, xy, xz, yy, yz, zz, gx, gy, gz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    mixed, square, slope = slots.mixed, slots.square, slots.slope
    for s in range(first, last):
        k = slots.station[s]
        r00, r01, r02 = r[k, 0, 0], r[k, 0, 1], r[k, 0, 2]
        r10, r11, r12 = r[k, 1, 0], r[k, 1, 1], r[k, 1, 2]
        r20, r21, r22 = r[k, 2, 0], r[k, 2, 1], r[k, 2, 2]
        a, b, c = square[s, 0, 0], square[s, 0, 1], square[s, 0, 2]
        d, e, f = square[s, 1, 1], square[s, 1, 2], square[s, 2, 2]
        u, v, w = slope[s, 0], slope[s, 1], slope[s, 2]
        m00, m01, m02 = a * r00 + b * r10 + c * r20, a * r01 + b * r11 + c * r21, a * r02 + b * r12 + c * r22
        m10, m11, m12 = b * r00 + d * r10 + e * r20, b * r01 + d * r11 + e * r21, b * r02 + d * r12 + e * r22
        m20, m21, m22 = c * r00 + e * r10 + f * r20, c * r01 + e * r11 + f * r21, c * r02 + e * r12 + f * r22
        mixed[s, 0, 0], mixed[s, 0, 1], mixed[s, 0, 2] = m00, m01, m02
        mixed[s, 1, 0], mixed[s, 1, 1], mixed[s, 1, 2] = m10, m11, m12
        mixed[s, 2, 0], mixed[s, 2, 1], mixed[s, 2, 2] = m20, m21, m22
        xx, xy = xx + r00 * m00 + r10 * m10 + r20 * m20, xy + r00 * m01 + r10 * m11 + r20 * m21
        xz, yy = xz + r00 * m02 + r10 * m12 + r20 * m22, yy + r01 * m01 + r11 * m11 + r21 * m21
        yz, zz = yz + r01 * m02 + r11 * m12 + r21 * m22, zz + r02 * m02 + r12 * m12 + r22 * m22
        gx, gy = gx + r00 * u + r10 * v + r20 * w, gy + r01 * u + r11 * v + r21 * w
        gz += r02 * u + r12 * v + r22 * w
    normal, right = slots.normal, slots.right
    right[p, 0], right[p, 1], right[p, 2] = gx, gy, gz
    normal[p, 0, 0], normal[p, 0, 1], normal[p, 0, 2] = xx, xy, xz
    normal[p, 1, 0], normal[p, 1, 1], normal[p, 1, 2] = xy, yy, yz
    normal[p, 2, 0], normal[p, 2, 1], normal[p, 2, 2] = xz, yz, zz


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
