"""The precomputed map: all references matched and triangulated once, as hloc does; a query takes points from it.

Pairs of references that look at the same place are matched, matches that contradict the known poses dropped, and points
triangulated by COLMAP with the poses held fixed. A query keypoint that matches a reference keypoint takes the point
that keypoint belongs to, and may so get several. Sarlin et al., "From coarse to fine" (2019).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
import pycolmap
from numpy.typing import NDArray
from scipy.spatial import KDTree

from georef.estimation.first_pose import QueryImage
from georef.estimation.guided import PosedFeatures, epipolar_distances
from georef.estimation.local_model import LocalModel
from georef.estimation.published import triangulated
from georef.features.base import Matcher
from georef.geometry.frusta import Frusta
from georef.geometry.projection import Views
from georef.geometry.rigid import Array, Rigid3
from georef.geometry.triangulation import triangulate
from georef.types.features import Matches
from georef.types.results import ReferenceNoise
from georef.types.scene import ImageStructure, Observations

_CALIBRATED = int(pycolmap.TwoViewGeometryConfiguration.CALIBRATED)
_TRIED_PER_NEIGHBOUR = 8  # nearest references whose overlap is computed, for each neighbour wanted
Pair = tuple[int, int]


def choose_pairs(frusta: Frusta, neighbours: int) -> list[Pair]:
    """Pairs (a < b) of references: each with those of the nearest that share most of its view, at most `neighbours`."""
    centres = frusta.views.centres
    tried = min(_TRIED_PER_NEIGHBOUR * neighbours + 1, len(centres))
    near = KDTree(centres).query(centres, k=tried, distance_upper_bound=2.0 * frusta.reach_m)[1].reshape(-1, tried)
    pairs: set[Pair] = set()
    for index, row in enumerate(near):
        others = row[(row != index) & (row < len(centres))]
        shared = frusta.shared(index, frusta, others)
        order = np.argsort(-shared, kind="stable")[:neighbours]
        pairs |= {(min(index, int(others[k])), max(index, int(others[k]))) for k in order if shared[k] > 0.0}
    return sorted(pairs)


def match_pair(a: PosedFeatures, b: PosedFeatures, matcher: Matcher, keypoints: int, gate: float) -> Matches:
    """Matches of two references that lie within `gate` keypoint scales of each other's epipolar lines.

    Images from one place have no epipolar lines, and no match.
    """
    matches = matcher.match(a.features.head(keypoints), b.features.head(keypoints))
    if len(matches) == 0:
        return matches
    with np.errstate(divide="ignore", invalid="ignore"):
        off = epipolar_distances(a, b, matches.indices)
    scales = [f.features.scales_px[matches.indices[:, k]] for k, f in enumerate((a, b))]
    kept = (off <= gate * np.column_stack(scales)).all(axis=1)
    return Matches(matches.indices[kept], matches.scores[kept])


def blocks_of(positions: Array, size: int) -> list[NDArray[np.int64]]:
    """Images (of positions (N, 3)) in spatial blocks of at most `size`, by halving along the longer side."""

    def halve(indices: NDArray[np.int64]) -> list[NDArray[np.int64]]:
        if len(indices) <= size:
            return [indices]
        extent = np.ptp(positions[indices], axis=0)
        order = indices[np.argsort(positions[indices, int(np.argmax(extent))], kind="stable")]
        return [*halve(order[: len(order) // 2]), *halve(order[len(order) // 2 :])]

    return halve(np.arange(len(positions)))


def block_structure(
    block: Sequence[int],
    images: Mapping[int, PosedFeatures],
    matches: Mapping[Pair, NDArray[np.int32]],
    noise: ReferenceNoise,
) -> dict[int, ImageStructure]:
    """The structure of the images of a block, triangulated together with the images that they were matched with.

    images: those of the block and their partners, by their place among all references; matches: of pairs of them.
    """
    members = sorted(images)
    place = {image: k for k, image in enumerate(members)}
    references = [images[image] for image in members]
    graph = pycolmap.CorrespondenceGraph()
    for k, image in enumerate(references):
        graph.add_image(k + 1, len(image.features))
    for (a, b), indices in matches.items():
        graph.add_two_view_geometry(place[a] + 1, place[b] + 1, _verified(indices))
    graph.finalize()
    reconstruction = triangulated(references, graph)
    return {image: _structure(place[image], members, references, reconstruction, noise) for image in block}


def global_model(
    structures: Mapping[int, ImageStructure],
    matches: Mapping[int, Matches],
    views_of: Callable[[Sequence[int]], Views],
) -> tuple[LocalModel, list[int]]:
    """The map points that a query's keypoints correspond to, and the references (by place) that its views are.

    matches pair query keypoints with those of a reference. A query keypoint comes once for each map point that its
    matches lead to: `one_point_each` chooses, once a pose is known.
    """
    rows = np.concatenate([np.zeros((0, 3), np.int64), *(_rows(structures[r], r, matches[r]) for r in sorted(matches))])
    identity = [structures[r].identity[p] for r, p in rows[:, 1:]]
    keys = np.column_stack([rows[:, 0], np.array(identity, dtype=np.int64).reshape(-1, 2)])
    _, first = np.unique(keys, axis=0, return_index=True)
    rows = rows[first]
    observations = _gathered([(structures[r], int(p)) for r, p in rows[:, 1:]])
    chosen, view = np.unique(observations.view, return_inverse=True)
    names = [int(v) for v in chosen]
    return LocalModel(
        rows[:, 0],
        np.array([structures[r].points[p] for r, p in rows[:, 1:]]).reshape(-1, 3),
        np.array([structures[r].cov[p] for r, p in rows[:, 1:]]).reshape(-1, 3, 3),
        views_of(names),
        replace(observations, view=view.astype(np.int64)),
    ), names


def one_point_each(pose: Rigid3, query: QueryImage, model: LocalModel, inliers: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Of the inliers (P,) that share a query keypoint, the one that the pose projects nearest to it."""
    views = Views.of([pose], [query.camera])
    off = views.project(np.zeros(len(model), np.int64), model.points) - query.pixels[model.keypoint]
    distance = np.where(inliers, np.nan_to_num(np.linalg.norm(off, axis=1), nan=np.inf), np.inf)
    order = np.lexsort([distance, model.keypoint])
    first = np.unique(model.keypoint[order], return_index=True)[1]
    best = np.zeros(len(model), bool)
    best[order[first]] = True
    return best & inliers


def _rows(structure: ImageStructure, reference: int, matches: Matches) -> NDArray[np.int64]:
    """(M, 3): query keypoint, reference, row of the reference's structure, for matched keypoints that have a point."""
    wanted = matches.indices[:, 1].astype(np.int64)
    row = np.searchsorted(structure.keypoint, wanted)
    inside = row < len(structure)
    found = np.flatnonzero(inside)
    found = found[structure.keypoint[row[found]] == wanted[found]]
    return np.column_stack([matches.indices[found, 0].astype(np.int64), np.full(len(found), reference), row[found]])


def _gathered(points: Sequence[tuple[ImageStructure, int]]) -> Observations:
    """The observations of points of several structures, the points numbered in their order."""
    parts = []
    for number, (structure, row) in enumerate(points):
        obs = structure.observations
        low, high = np.searchsorted(obs.point, [row, row + 1])
        own = obs.take(np.arange(low, high))
        parts.append(own.with_points(np.full(high - low, number)))
    return Observations.joined(parts)


def _structure(
    own: int,
    members: Sequence[int],
    references: Sequence[PosedFeatures],
    reconstruction: pycolmap.Reconstruction,
    noise: ReferenceNoise,
) -> ImageStructure:
    """What COLMAP found for one of the images, each point with the covariance of its observations."""
    with_point = [(k, p.point3D_id) for k, p in enumerate(reconstruction.image(own + 1).points2D) if p.has_point3D()]
    rows = sorted(
        (index, element.image_id - 1, element.point2D_idx)
        for index, (_, point) in enumerate(with_point)
        for element in reconstruction.point3D(point).track.elements
    )
    table = np.array(rows, dtype=np.int64).reshape(-1, 3)
    pixel = np.array([references[v].pixels[k] for _, v, k in rows]).reshape(-1, 2)
    scale = np.array([references[v].features.scales_px[k] for _, v, k in rows], dtype=np.float64)
    obs = Observations(table[:, 0], table[:, 1], pixel, noise.keypoint_sigma * scale, table[:, 2])
    views = Views.of([r.world_from_cam for r in references], [r.camera for r in references])
    solved = triangulate(views, obs.point, obs.view, obs.pixel, obs.sigma_px, len(with_point))
    first = np.flatnonzero(np.diff(obs.point, prepend=-1))
    place = np.array(members, dtype=np.int64)
    known = np.asarray(np.isfinite(solved.points).all(axis=1) & np.isfinite(solved.cov).all(axis=(1, 2)))
    renumber = np.cumsum(known) - 1
    kept = obs.take(known[obs.point])
    return ImageStructure(
        np.array([k for k, _ in with_point], dtype=np.int64)[known],
        np.column_stack([place[obs.view[first]], obs.keypoint[first]]).reshape(-1, 2)[known],
        solved.points[known],
        solved.cov[known],
        replace(kept, point=renumber[kept.point], view=place[kept.view]),
    )


def _verified(indices: NDArray[np.int32]) -> pycolmap.TwoViewGeometry:
    geometry = pycolmap.TwoViewGeometry()
    geometry.config = _CALIBRATED
    geometry.inlier_matches = indices.astype(np.uint32)
    return geometry
