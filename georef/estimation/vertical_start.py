"""Headings of images that look straight down, from where they were taken and the points that they share.

Over ground that is flat against the flying height a vertical image is a map: with u the image coordinates (right, up)
at unit focal length as complex numbers, C the position, H the height above ground and k the heading of image right
(anticlockwise from east), a point lies at C + H exp(i k) u. Of two images u_i = a u_j + b with
b = (C_j - C_i) exp(-i k_i) / H_i: the base as it is known, and as the image sees it, differ by the heading.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix

from georef.geometry.camera import Camera, rays_from_pixels
from georef.geometry.poses import Poses
from georef.geometry.rigid import Array
from georef.types.scene import Observations

Complex = NDArray[np.complex128]
_NEIGHBOURS, _LEAST_COMMON, _ROUNDS = 8, 6, 6
_HUBER = 2.0


@dataclass(frozen=True, eq=False)
class VerticalStart:
    """world_from_cam of M images; `misfit` (M,) says how far from a map each is: NaN where nothing gives its heading.

    misfit: median distance of common points after the fit, over the distance from the image's middle to its border.
    """

    world_from_cam: Poses
    misfit: Array


def vertical_start(positions: Array, cameras: Sequence[Camera], observations: Observations) -> VerticalStart:
    """Poses of M images that look down, at positions (M, 3) in world; observations of points, by index of image."""
    coordinates = _image_coordinates(cameras, observations)
    places = positions[:, 0] + 1j * positions[:, 1]
    turns, misfits, weights = _turns(places, coordinates, observations)
    count, border = len(positions), np.array([0.5 * max(c.width / c.fx, c.height / c.fy) for c in cameras])
    headings, misfit = np.zeros(count), np.full(count, np.nan)
    for image in range(count):
        here = turns[:, 0].real.astype(np.int64) == image
        if here.any():
            headings[image] = np.angle(np.sum(weights[here] * turns[here, 1]))
            misfit[image] = float(np.median(misfits[here])) / border[image]
    return VerticalStart(Poses(_rotations(headings), positions.copy()), misfit)


def _rotations(headings: Array) -> Array:
    """world_from_cam (M, 3, 3) of cameras that look down, image right at a heading anticlockwise from east."""
    c, s, zero = np.cos(headings), np.sin(headings), np.zeros(len(headings))
    right, down = np.stack([c, s, zero], axis=1), np.stack([s, -c, zero], axis=1)
    return np.stack([right, down, np.cross(right, down)], axis=2)


def _image_coordinates(cameras: Sequence[Camera], observations: Observations) -> Complex:
    """Slopes (n,) right and up of the observations."""
    out = np.full(len(observations), np.nan, np.complex128)
    groups: dict[Camera, list[int]] = {}
    for image, camera in enumerate(cameras):
        groups.setdefault(camera, []).append(image)
    for camera, images in groups.items():
        here = np.isin(observations.view, images)
        rays = rays_from_pixels(camera, observations.pixel[here])
        out[here] = (rays[:, 0] - 1j * rays[:, 1]) / np.where(rays[:, 2] > 0, rays[:, 2], np.nan)
    return out


def _turns(places: Complex, coordinates: Complex, observations: Observations) -> tuple[Complex, Array, Array]:
    """From each pair of images two rows (image, exp(i heading)), with misfit and weight."""
    rows, misfits, weights = [], [], []
    by_image = [np.flatnonzero(observations.view == i) for i in range(len(places))]
    by_image = [rows_[np.argsort(observations.point[rows_])] for rows_ in by_image]
    for i, j in _pairs(places, observations):
        _, in_i, in_j = np.intersect1d(
            observations.point[by_image[i]], observations.point[by_image[j]], assume_unique=True, return_indices=True
        )
        u, v = coordinates[by_image[i][in_i]], coordinates[by_image[j][in_j]]
        seen = np.isfinite(u) & np.isfinite(v)
        if seen.sum() < _LEAST_COMMON:
            continue
        a, b, misfit = _fit(u[seen], v[seen])
        base = places[j] - places[i]
        if abs(a) < 1e-6 or abs(b) < 1e-6:
            continue
        for image, turn in ((i, base / b), (j, base * a / b)):
            rows.append((image, turn / abs(turn)))
            misfits.append(misfit)
            weights.append(abs(base) * np.sqrt(seen.sum()))
    return np.array(rows, np.complex128).reshape(-1, 2), np.array(misfits), np.array(weights)


def _pairs(places: Complex, observations: Observations) -> list[tuple[int, int]]:
    """For each image the others that share many points with it from far away."""
    count = len(places)
    shape = (count, int(observations.point.max(initial=-1)) + 1)
    seen = csr_matrix((np.ones(len(observations)), (observations.view, observations.point)), shape=shape)
    common = (seen @ seen.T).tocsr()
    out: set[tuple[int, int]] = set()
    for i in range(count):
        others = common.indices[common.indptr[i] : common.indptr[i + 1]]
        shared = common.data[common.indptr[i] : common.indptr[i + 1]]
        score = np.sqrt(shared) * np.abs(places[others] - places[i])
        score[shared < _LEAST_COMMON] = 0.0
        best = np.argsort(-score)[:_NEIGHBOURS]
        out |= {(min(i, int(j)), max(i, int(j))) for j in others[best[score[best] > 0]]}
    return sorted(out)


def _fit(u: Complex, v: Complex) -> tuple[complex, complex, float]:
    """a, b of u = a v + b, robustly, and the median distance."""
    weight = np.ones(len(u))
    a, b, distance = 1.0 + 0.0j, 0.0j, np.zeros(len(u))
    for _ in range(_ROUNDS):
        total = weight.sum()
        mean_u, mean_v = (weight @ u) / total, (weight @ v) / total
        spread = weight @ np.square(np.abs(v - mean_v))
        a = complex((weight * np.conj(v - mean_v)) @ (u - mean_u) / spread) if spread > 0 else 0j
        b = complex(mean_u - a * mean_v)
        distance = np.abs(u - a * v - b)
        weight = 1.0 / np.maximum(1.0, distance / (_HUBER * max(float(np.median(distance)), 1e-12)))
    return a, b, float(np.median(distance))
