"""Tracks: keypoints of several images that are matches of one point."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from georef.estimation.guided import PosedFeatures
from georef.estimation.local_model import triangulate_consistent
from georef.geometry.projection import Views, linearize
from georef.geometry.rigid import Array
from georef.geometry.triangulation import triangulate
from georef.types.scene import Observations

_GATE_SIGMAS = 4.0


@dataclass(frozen=True, eq=False)
class PairMatches:
    """Keypoint matches (M, 2) of the images at two positions of a list."""

    a: int
    b: int
    indices: NDArray[np.int32]


def build_tracks(
    images: Sequence[PosedFeatures], matches: Sequence[PairMatches], keypoint_sigma: float
) -> tuple[int, Observations]:
    """The number of tracks and their observations; an image in which a track has two keypoints leaves that track."""
    start = np.concatenate([[0], np.cumsum([len(image.features) for image in images])])
    a = np.concatenate([start[m.a] + m.indices[:, 0] for m in matches] or [np.zeros(0, np.int64)])
    b = np.concatenate([start[m.b] + m.indices[:, 1] for m in matches] or [np.zeros(0, np.int64)])
    graph = coo_array((np.ones(len(a), np.int8), (a, b)), shape=(start[-1], start[-1]))
    _, label = connected_components(graph, directed=False)
    node = np.unique(np.concatenate([a, b])).astype(np.int64)
    view = np.searchsorted(start, node, side="right") - 1
    _, occurrence, count = np.unique(
        np.column_stack([label[node], view]), axis=0, return_inverse=True, return_counts=True
    )
    single = count[occurrence.ravel()] == 1
    node, view = node[single], view[single]
    _, point = np.unique(label[node], return_inverse=True)
    keypoint = node - start[view]
    pixel, scale = _lookup(images, view, keypoint)
    observations = Observations(point.astype(np.int64), view, pixel, quantized(keypoint_sigma * scale), keypoint)
    return int(point.max()) + 1 if len(point) else 0, observations


def quantized(sigma_px: Array) -> Array:
    """Sigmas in steps of 2^(1/4), so that observations of one image share few noise models."""
    return np.exp2(np.round(4.0 * np.log2(sigma_px)) / 4.0)


def triangulated_tracks(
    count: int, observations: Observations, images: Sequence[PosedFeatures], pose_covs: Sequence[Array]
) -> tuple[Array, Observations]:
    """Points (P, 3) of the tracks that agree with the poses within what the pose covariances (6, 6) allow.

    Returns them with their observations, renumbered.
    """
    views = Views.of([image.world_from_cam for image in images], [image.camera for image in images])
    rough = triangulate(views, observations.point, observations.view, observations.pixel, observations.sigma_px, count)
    lin = linearize(views, observations.view, rough.points[observations.point])
    spread = np.einsum("nki,nij,nkj->n", lin.by_pose, np.array(pose_covs)[observations.view], lin.by_pose) / 2.0
    loose = np.sqrt(np.square(observations.sigma_px) + np.nan_to_num(spread, nan=0.0))
    with_loose = Observations(
        observations.point, observations.view, observations.pixel, loose, np.arange(len(observations))
    )
    model = triangulate_consistent(views, np.arange(count), with_loose, _GATE_SIGMAS)
    kept = observations.take(model.observations.keypoint)
    return model.points, kept.with_points(model.observations.point)


def distributed(observations: Observations, sizes: Array, limited: NDArray[np.bool_], budget: int) -> NDArray[np.bool_]:
    """Which points to keep so that each limited view has about `budget`, spread over its area, long tracks first.

    sizes: (V, 2) image sizes; limited: (V,) views whose number of points counts.
    """
    count = int(observations.point.max()) + 1 if len(observations) else 0
    length = np.bincount(observations.point, minlength=count)
    obs = observations.take(limited[observations.view])
    grid = np.array([12, 8])
    cell = np.clip(obs.pixel / sizes[obs.view] * grid, 0, grid - 1).astype(np.int64)
    group = (obs.view * grid[0] + cell[:, 0]) * grid[1] + cell[:, 1]
    order = np.lexsort((obs.point, -length[obs.point], group))
    first = np.concatenate([[True], np.diff(group[order]) != 0]) if len(order) else np.zeros(0, bool)
    rank = np.arange(len(order)) - np.maximum.accumulate(np.where(first, np.arange(len(order)), 0))
    keep = np.zeros(count, bool)
    keep[obs.point[order][rank < max(1, round(budget / grid.prod()))]] = True
    return keep


def nearest_ray_angles(points: Array, observations: Observations, centres: Array) -> Array:
    """The angle (n,), in radians, between the ray of each observation and the nearest other ray of its point.

    points: (P, 3); centres: (V, 3) of the views. Infinite where a point has no other ray.
    """
    order = np.argsort(observations.point, kind="stable")
    point = observations.point[order]
    ray = points[point] - centres[observations.view[order]]
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    chord = np.full(len(point), np.inf)
    for step in range(1, int(np.bincount(point).max(initial=1))):
        first = np.flatnonzero(point[step:] == point[:-step])
        apart = np.linalg.norm(ray[first + step] - ray[first], axis=1)
        chord[first] = np.minimum(chord[first], apart)
        chord[first + step] = np.minimum(chord[first + step], apart)
    angle = np.full(len(point), np.inf)
    angle[order] = np.where(np.isfinite(chord), 2.0 * np.arcsin(np.minimum(chord, 2.0) / 2.0), np.inf)
    return angle


def select_points(points: Array, observations: Observations, keep: NDArray[np.bool_]) -> tuple[Array, Observations]:
    """The points to keep with their observations, renumbered."""
    kept = observations.take(keep[observations.point])
    return points[keep], kept.with_points((np.cumsum(keep) - 1)[kept.point])


def _lookup(
    images: Sequence[PosedFeatures], view: NDArray[np.integer], keypoint: NDArray[np.integer]
) -> tuple[Array, Array]:
    pixel, scale = np.zeros((len(view), 2)), np.zeros(len(view))
    for index, image in enumerate(images):
        here = view == index
        pixel[here] = image.pixels[keypoint[here]]
        scale[here] = image.features.scales_px[keypoint[here]]
    return pixel, scale
