"""The verified tracks that a posed query must see, and the keypoints of it that they are.

Where a track is expected is known up to a disc: the covariances of the pose, of the point, and of the keypoint. Within
the disc descriptors decide, those of the references that see the point most like the query does.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree
from scipy.stats import chi2

from georef.estimation.first_pose import QueryImage
from georef.estimation.guided import GuidedOptions, PosedFeatures, mutual_best
from georef.estimation.local_model import LocalModel, well_determined
from georef.estimation.pnp import EstimatedPose
from georef.estimation.tracks import nearest_ray_angles
from georef.features.nearest import unit_rows
from georef.geometry.camera import Camera
from georef.geometry.projection import Views, linearize
from georef.geometry.rigid import Array, Rigid3
from georef.geometry.triangulation import triangulate
from georef.types.results import ReferenceNoise
from georef.types.scene import ImageStructure, Observations

_LARGEST_ANGLE_DEG = 60.0
_LARGEST_SCALE_RATIO = 3.0
_LOOKS = 3  # observations of a track whose descriptors are compared, the most similar in direction and scale
_ANGLE_OF_DOUBLE_RAD = np.radians(30.0)  # an angle between rays that makes as unlike as twice the scale
_GATE = float(chi2.ppf(0.999, 2))
_LARGEST_RADIUS_SHARE = 0.1  # of the longer image side: a first pose less sure than that is looked around no farther


@dataclass(frozen=True, eq=False)
class SeenTracks:
    """T tracks inside the query image, and L looks: observations of them from a similar side."""

    source: NDArray[np.int64]  # (T, 2) reference, row of its structure
    points: Array  # (T, 3) in world
    cov: Array  # (T, 3, 3)
    track: NDArray[np.int64]  # (L,)
    look: NDArray[np.int64]  # (L, 2) reference, keypoint

    def __len__(self) -> int:
        return len(self.points)

    @staticmethod
    def of(
        structures: Mapping[int, ImageStructure],
        posed: Mapping[int, PosedFeatures],
        world_from_cam: Rigid3,
        camera: Camera,
    ) -> SeenTracks:
        """The tracks of some references that project into the query, with the looks that resemble its own."""
        rows = np.concatenate(
            [np.zeros((0, 3), np.int64), *(_rows(index, structure) for index, structure in structures.items())]
        )
        identity = np.concatenate([np.zeros((0, 2), np.int64), *(s.identity for s in structures.values())])
        _, first, track = np.unique(identity, axis=0, return_index=True, return_inverse=True)
        points = np.concatenate([np.zeros((0, 3)), *(s.points for s in structures.values())])
        cov = np.concatenate([np.zeros((0, 3, 3)), *(s.cov for s in structures.values())])
        unlike = _unlikeness(rows, points, posed, world_from_cam, camera)
        inside = _inside(points, world_from_cam, camera)
        looks = _most_alike(track.ravel(), np.where(inside, unlike, np.inf))
        kept, number = np.unique(track.ravel()[looks], return_inverse=True)
        chosen = first[kept]
        return SeenTracks(rows[chosen, :2], points[chosen], cov[chosen], number.ravel(), rows[looks][:, [0, 2]])


def associate(
    seen: SeenTracks,
    posed: Mapping[int, PosedFeatures],
    query: PosedFeatures,
    observed: QueryImage,
    estimate: EstimatedPose,
    options: GuidedOptions,
) -> NDArray[np.int64]:
    """Pairs (M, 2) of tracks and query keypoints: mutual best descriptors among those within each other's disc."""
    pairs = _within_discs(seen, observed, estimate)
    if len(pairs) == 0:
        return pairs
    score = np.full(len(pairs), -1.0, np.float32)
    own = unit_rows(query.features.descriptors)
    order = np.argsort(pairs[:, 0], kind="stable")
    pairs = pairs[order]
    bounds = np.searchsorted(pairs[:, 0], np.arange(len(seen) + 1))
    for index in np.unique(seen.look[:, 0]):
        here = np.flatnonzero(seen.look[:, 0] == index)
        theirs = unit_rows(posed[int(index)].features.descriptors[seen.look[here, 1]])
        count = np.diff(bounds)[seen.track[here]]
        row = np.repeat(np.arange(len(here)), count)
        pair = np.repeat(bounds[seen.track[here]] - np.cumsum(count) + count, count) + np.arange(len(row))
        np.maximum.at(score, pair, np.einsum("nd,nd->n", theirs[row], own[pairs[pair, 1]]))
    return pairs[mutual_best(pairs, score, options)]


def local_model_of(
    seen: SeenTracks,
    structures: Mapping[int, ImageStructure],
    pairs: NDArray[np.int64],
    views_of: Callable[[Sequence[int]], Views],
) -> tuple[LocalModel, list[int]]:
    """The local model of associated tracks, and the references (by place) that its views are."""
    order = np.argsort(seen.source[pairs[:, 0], 0], kind="stable")
    pairs = pairs[order]
    source = seen.source[pairs[:, 0]]
    parts = []
    for index in np.unique(source[:, 0]):
        obs = structures[int(index)].observations
        here = np.flatnonzero(source[:, 0] == index)
        place = np.full(len(structures[int(index)]), -1, np.int64)
        place[source[here, 1]] = here
        kept = obs.take(place[obs.point] >= 0)
        parts.append(kept.with_points(place[kept.point]))
    observations = Observations.joined(parts)
    names, view = np.unique(observations.view, return_inverse=True)
    numbered = replace(observations, view=view.astype(np.int64))
    chosen = [int(name) for name in names]
    points, cov = seen.points[pairs[:, 0]], seen.cov[pairs[:, 0]]
    return LocalModel(pairs[:, 1], points, cov, views_of(chosen), numbered), chosen


def as_seen_from(model: LocalModel, world_from_cam: Rigid3, noise: ReferenceNoise) -> LocalModel:
    """The same points, intersected again: what sees them from another side than the query counts less.

    From another side a keypoint sits on a slightly different spot of the same thing; the spot that the query shows is
    wanted. The observations come weighted for the angle to the nearest other ray of their point. They were verified
    with the errors of the reference poses, and none is dropped: what agrees best by chance would pass for certain.
    """
    obs, centres = model.observations, model.views.centres
    to_query = model.points[obs.point] - world_from_cam.translation
    to_view = model.points[obs.point] - centres[obs.view]
    length = np.linalg.norm(to_query, axis=1) * np.linalg.norm(to_view, axis=1)
    cosine = np.einsum("ni,ni->n", to_query, to_view) / np.maximum(length, 1e-12)
    own = obs.sigma_px / noise.widening(nearest_ray_angles(model.points, obs, centres))
    widened = replace(obs, sigma_px=own * noise.widening(np.arccos(np.clip(cosine, -1.0, 1.0))))
    return _intersected(replace(model, observations=widened))


def without_views(
    model: LocalModel, names: Sequence[int], dropped: Collection[int], views_of: Callable[[Sequence[int]], Views]
) -> tuple[LocalModel, list[int]]:
    """The points that are left without some of a model's views, and the references (by place) that its views are."""
    obs = model.observations
    kept = obs.take(~np.isin(obs.view, list(dropped)))
    chosen = [view for view in range(len(names)) if view not in dropped]
    place = np.full(len(names), -1, np.int64)
    place[chosen] = np.arange(len(chosen))
    left = [names[view] for view in chosen]
    return _intersected(replace(model, views=views_of(left), observations=replace(kept, view=place[kept.view]))), left


def _intersected(model: LocalModel) -> LocalModel:
    """The points of a model intersected again from its observations."""
    obs = model.observations
    solved = triangulate(model.views, obs.point, obs.view, obs.pixel, obs.sigma_px, len(model))
    again = replace(model, points=solved.points, cov=solved.cov)
    return again.take(well_determined(again))


def _rows(index: int, structure: ImageStructure) -> NDArray[np.int64]:
    """(P, 3): reference, row of its structure, keypoint."""
    return np.column_stack([np.full(len(structure), index), np.arange(len(structure)), structure.keypoint])


def _unlikeness(
    rows: NDArray[np.int64], points: Array, posed: Mapping[int, PosedFeatures], world_from_cam: Rigid3, camera: Camera
) -> Array:
    """How differently (n,) references see points (n, 3) than the query does; infinite where it is too much."""
    out = np.full(len(rows), np.inf)
    to_query = points - world_from_cam.translation
    distance = np.linalg.norm(to_query, axis=1)
    for index, image in posed.items():
        here = rows[:, 0] == index
        to_reference = points[here] - image.world_from_cam.translation
        own = np.linalg.norm(to_reference, axis=1)
        cosine = np.einsum("ni,ni->n", to_reference, to_query[here]) / np.maximum(own * distance[here], 1e-12)
        angle = np.arccos(np.clip(cosine, -1.0, 1.0))
        ratio = np.abs(np.log2((own / image.camera.fx) / (distance[here] / camera.fx)))
        possible = (angle <= np.radians(_LARGEST_ANGLE_DEG)) & (ratio <= np.log2(_LARGEST_SCALE_RATIO))
        out[here] = np.where(possible, angle / _ANGLE_OF_DOUBLE_RAD + ratio, np.inf)
    return out


def _inside(points: Array, world_from_cam: Rigid3, camera: Camera) -> NDArray[np.bool_]:
    pixel = Views.of([world_from_cam], [camera]).project(np.zeros(len(points), np.int64), points)
    return np.asarray(((pixel >= 0) & (pixel <= [camera.width, camera.height])).all(axis=1))


def _most_alike(track: NDArray[np.int64], unlike: Array) -> NDArray[np.int64]:
    """Rows of the `_LOOKS` least unlike looks of each track."""
    order = np.lexsort((unlike, track))
    order = order[np.isfinite(unlike[order])]
    start = np.flatnonzero(np.diff(track[order], prepend=-1))
    rank = np.arange(len(order)) - np.repeat(start, np.diff(np.append(start, len(order))))
    return order[rank < _LOOKS]


def _within_discs(seen: SeenTracks, observed: QueryImage, estimate: EstimatedPose) -> NDArray[np.int64]:
    """Pairs (K, 2) of tracks and keypoints whose distance is within what their covariances allow."""
    views = Views.of([estimate.world_from_cam], [observed.camera])
    lin = linearize(views, np.zeros(len(seen), np.int64), seen.points)
    expected = lin.by_pose @ estimate.cov @ np.swapaxes(lin.by_pose, 1, 2)
    expected += lin.by_point @ seen.cov @ np.swapaxes(lin.by_point, 1, 2)
    largest = float(observed.sigma_px.max(initial=0.0))
    spread = np.sqrt(_GATE * (np.linalg.eigvalsh(expected)[:, -1] + largest**2))
    limit = _LARGEST_RADIUS_SHARE * max(observed.camera.width, observed.camera.height)
    near = KDTree(observed.pixels).query_ball_point(lin.pixel, np.minimum(spread, limit))
    track = np.repeat(np.arange(len(seen)), [len(found) for found in near])
    keypoint = np.concatenate([np.zeros(0, np.int64), *(np.array(found, np.int64) for found in near)])
    off = observed.pixels[keypoint] - lin.pixel[track]
    cov = expected[track] + np.square(observed.sigma_px[keypoint])[:, None, None] * np.eye(2)
    statistic = np.einsum("ni,nij,nj->n", off, np.linalg.inv(cov), off)
    return np.column_stack([track, keypoint])[statistic <= _GATE]
