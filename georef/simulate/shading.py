"""Per-ray kernels: the exact point of a hit, its albedo filtered by the pixel, the light that reaches it."""

from __future__ import annotations

from math import sqrt

import numpy as np
from numpy.typing import NDArray

from georef.geometry.rigid import Array
from georef.simulate.noise import kernel
from georef.simulate.textures import albedo

_MOST_SAMPLES = 3  # of the texture along a pixel's longer axis on a slanted surface


@kernel
def locate(triangle, origins, directions, corners, uv_m, corner_normals, distance, normal, smooth, uv, stretch):
    """Exact intersections in double precision; normals face the ray. stretch (N, 2): metres of texture coordinates
    for a metre along the surface in the viewing direction."""
    single = len(origins) == 1
    for n in range(len(triangle)):
        t = triangle[n]
        if t < 0:
            distance[n] = np.inf
            continue
        o = origins[0] if single else origins[n]
        d0, d1, d2 = float(directions[n, 0]), float(directions[n, 1]), float(directions[n, 2])
        p = corners[t]
        ax, ay, az = p[1, 0] - p[0, 0], p[1, 1] - p[0, 1], p[1, 2] - p[0, 2]
        bx, by, bz = p[2, 0] - p[0, 0], p[2, 1] - p[0, 1], p[2, 2] - p[0, 2]
        nx, ny, nz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
        sx, sy, sz = o[0] - p[0, 0], o[1] - p[0, 1], o[2] - p[0, 2]
        facing = d0 * nx + d1 * ny + d2 * nz
        if facing == 0.0:
            facing = 1e-30
        length = -(sx * nx + sy * ny + sz * nz) / facing
        distance[n] = length
        qx, qy, qz = sx + length * d0, sy + length * d1, sz + length * d2
        aa, ab, bb = ax * ax + ay * ay + az * az, ax * bx + ay * by + az * bz, bx * bx + by * by + bz * bz
        qa, qb = qx * ax + qy * ay + qz * az, qx * bx + qy * by + qz * bz
        inverse = 1.0 / (aa * bb - ab * ab)
        wa, wb = (qa * bb - qb * ab) * inverse, (qb * aa - qa * ab) * inverse
        w0 = 1.0 - wa - wb
        ua, va = uv_m[t, 1, 0] - uv_m[t, 0, 0], uv_m[t, 1, 1] - uv_m[t, 0, 1]
        ub, vb = uv_m[t, 2, 0] - uv_m[t, 0, 0], uv_m[t, 2, 1] - uv_m[t, 0, 1]
        uv[n, 0], uv[n, 1] = uv_m[t, 0, 0] + wa * ua + wb * ub, uv_m[t, 0, 1] + wa * va + wb * vb
        size = sqrt(nx * nx + ny * ny + nz * nz)
        sign = -1.0 if facing > 0 else 1.0
        nx, ny, nz, cosine = sign * nx / size, sign * ny / size, sign * nz / size, abs(facing) / size
        normal[n, 0], normal[n, 1], normal[n, 2] = nx, ny, nz
        c = corner_normals[t]
        mx = w0 * c[0, 0] + wa * c[1, 0] + wb * c[2, 0]
        my = w0 * c[0, 1] + wa * c[1, 1] + wb * c[2, 1]
        mz = w0 * c[0, 2] + wa * c[1, 2] + wb * c[2, 2]
        sign = (1.0 if mx * nx + my * ny + mz * nz >= 0 else -1.0) / max(sqrt(mx * mx + my * my + mz * mz), 1e-9)
        smooth[n, 0], smooth[n, 1], smooth[n, 2] = sign * mx, sign * my, sign * mz
        gx, gy, gz = d0 + cosine * nx, d1 + cosine * ny, d2 + cosine * nz
        along = max(sqrt(gx * gx + gy * gy + gz * gz), 1e-9)
        ga, gb = (gx * ax + gy * ay + gz * az) / along, (gx * bx + gy * by + gz * bz) / along
        ka, kb = (ga * bb - gb * ab) * inverse, (gb * aa - ga * ab) * inverse
        stretch[n, 0], stretch[n, 1] = ka * ua + kb * ub, ka * va + kb * vb


@kernel
def paint(surface, uv, stretch, footprint, cosine, material, seed, colour, values, damp, out):
    """Albedo (N, 3) of hits; footprint (N,) is the pixel's width across the viewing direction, metres."""
    for n in range(len(surface)):
        s = surface[n]
        if s < 0:
            out[n, 0], out[n, 1], out[n, 2] = 0.0, 0.0, 0.0
            continue
        ratio = 1.0 / max(cosine[n], 0.02)
        count = min(max(int(0.55 * ratio + 0.5), 1), _MOST_SAMPLES)
        narrow = footprint[n]
        each = max(narrow, 0.8 * narrow * ratio / count)
        r, g, b = 0.0, 0.0, 0.0
        for k in range(count):
            offset = ((k + 0.5) / count - 0.5) * narrow * ratio
            u, v = uv[n, 0] + offset * stretch[n, 0], uv[n, 1] + offset * stretch[n, 1]
            cr, cg, cb = albedo(material[s], seed[s], colour[s], values[s], u, v, each, damp)
            r, g, b = r + cr, g + cg, b + cb
        out[n, 0], out[n, 1], out[n, 2] = r / count, g / count, b / count


@kernel
def spread_sky(x, y, distance, normal, step, grid_distance, grid_normal, grid_share, out):
    """Sky share (N,) of points at pixels x, y from a coarse grid of the picture, by likeness of depth and normal."""
    rows, columns = grid_share.shape
    for n in range(len(x)):
        gx, gy = x[n] / step - 0.5, y[n] / step - 0.5
        i0, j0 = int(np.floor(gx)), int(np.floor(gy))
        total, weight = 0.0, 0.0
        for dj in range(2):
            for di in range(2):
                i, j = min(max(i0 + di, 0), columns - 1), min(max(j0 + dj, 0), rows - 1)
                if not grid_distance[j, i] < 1e9:
                    continue
                fx, fy = abs(gx - i0 - di), abs(gy - j0 - dj)
                like = 0.0
                for k in range(3):
                    like += normal[n, k] * grid_normal[j, i, k]
                apart = (distance[n] - grid_distance[j, i]) / (0.03 * distance[n] + 0.05)
                like = max(like, 0.03)
                like *= like
                w = (1.01 - fx) * (1.01 - fy) * like * like / (1.0 + apart * apart * apart * apart) + 1e-9
                total, weight = total + w * grid_share[j, i], weight + w
        out[n] = total / weight if weight > 0 else 0.4 + 0.4 * normal[n, 2]


@kernel
def illuminate(surface, albedo, smooth_normal, lit, share, sun, sun_colour, sky_colour, bounce_colour, out):
    """Linear light (N, 3) that surfaces send back, of sun, sky and the surroundings."""
    for n in range(len(surface)):
        if surface[n] < 0:
            continue
        slant = 0.0
        if lit[n]:
            slant = max(smooth_normal[n, 0] * sun[0] + smooth_normal[n, 1] * sun[1] + smooth_normal[n, 2] * sun[2], 0.0)
        for c in range(3):
            out[n, c] = albedo[n, c] * (slant * sun_colour[c] + share[n] * sky_colour[c] + bounce_colour[c])


@kernel
def find_edges(surface, normal, distance, directions, lit, leafy, flagged):
    """Marks pixels beside another surface, a step in depth, a crease or the border of a shadow; not leaf on leaf."""
    rows, columns = surface.shape
    for j in range(rows):
        for i in range(columns):
            for right in range(2):
                k, m = j + 1 - right, i + right
                if k >= rows or m >= columns or (leafy[j, i] and leafy[k, m]):
                    continue
                edge = surface[j, i] != surface[k, m]
                if not edge and surface[j, i] >= 0:
                    crease, step = 0.0, 0.0
                    for c in range(3):
                        crease += normal[j, i, c] * normal[k, m, c]
                        step += normal[j, i, c] * (
                            distance[j, i] * directions[j, i, c] - distance[k, m] * directions[k, m, c]
                        )
                    edge = crease < 0.9 or abs(step) > 0.004 + 0.0005 * distance[j, i] or lit[j, i] != lit[k, m]
                if edge:
                    flagged[j, i] = True
                    flagged[k, m] = True


def empty_hits(count: int) -> tuple[Array, Array, Array, Array, Array]:
    """Distance, normal, smooth normal, texture coordinates and stretch, to be filled by `locate`."""
    return np.zeros(count), np.zeros((count, 3)), np.zeros((count, 3)), np.zeros((count, 2)), np.zeros((count, 2))


Flags = NDArray[np.bool_]
