"""Verified reference tracks: keypoints of reference images that are one point, with where it is and how well.

References are matched along the epipolar lines of their known poses, and the matches joined to tracks: the most similar
first, and never so that a track would have two keypoints in one image. Points are intersected from all observations
that agree, each weighted by its keypoint and by how far its ray is from the others; what does not agree makes tracks
of its own where it can. All of it is done once, before any query.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from georef.estimation.global_model import Pair
from georef.estimation.guided import PosedFeatures
from georef.estimation.local_model import LocalModel, triangulate_consistent
from georef.estimation.tracks import nearest_ray_angles
from georef.geometry.projection import Views, linearize
from georef.geometry.rigid import Array
from georef.geometry.triangulation import triangulate
from georef.types.features import Matches
from georef.types.results import ReferenceNoise
from georef.types.scene import ImageStructure, Observations

_GATE = 3.5  # sigmas of keypoint and poses, as for the points of a query
_ROUNDS = 2  # what a round leaves over makes tracks of its own in the next


@dataclass(frozen=True, eq=False)
class Tracks:
    """P verified tracks of a number of images."""

    points: Array  # (P, 3) in world
    cov: Array  # (P, 3, 3) of the image noise
    observations: Observations  # sorted by point, then view; view is the place in the list of images

    def __len__(self) -> int:
        return len(self.points)


def verified_tracks(
    images: Sequence[PosedFeatures],
    matches: Mapping[Pair, Matches],
    noise: ReferenceNoise,
    pose_covs: Sequence[Array],
) -> Tracks:
    """The tracks of images at their given poses, whose covariances are (6, 6).

    matches: of pairs of places (a, b) in `images`, verified along epipolar lines.
    """
    links = _links(images, matches)
    views = Views.of([i.world_from_cam for i in images], [i.camera for i in images])
    free = np.ones(sum(len(image.features) for image in images), bool)
    parts = []
    for _ in range(_ROUNDS):
        label = joined(links.ends[free[links.ends].all(axis=1)], links.view)
        tracks = consistent_tracks(views, links.observations(label, noise), noise, np.array(pose_covs))
        parts.append(tracks)
        used = links.start[tracks.observations.view] + tracks.observations.keypoint
        free[used] = False
        if len(tracks) == 0:
            break
    return _concatenated(parts)


def block_tracks(
    block: Sequence[int],
    images: Mapping[int, PosedFeatures],
    matches: Mapping[Pair, Matches],
    noise: ReferenceNoise,
    pose_covs: Mapping[int, Array],
) -> dict[int, ImageStructure]:
    """The structure of the images of a block from its tracks and those of the images that it was matched with.

    images: those of the block and their partners, by their place among all references; matches: of pairs of them.
    """
    members = sorted(images)
    place = {image: k for k, image in enumerate(members)}
    local = {(place[a], place[b]): found for (a, b), found in matches.items()}
    tracks = verified_tracks([images[i] for i in members], local, noise, [pose_covs[i] for i in members])
    named = np.array(members, dtype=np.int64)
    return {image: structure_of(place[image], named, tracks) for image in block}


def joined(ends: NDArray[np.int64], view: NDArray[np.int64]) -> NDArray[np.int64]:
    """Labels (N,) of keypoints that links (K, 2), the best first, join; -1 for a keypoint without a link.

    view: (N,) the image of each keypoint. A link that would give a track two keypoints of one image is left out.
    """
    label = np.full(len(view), -1, np.int64)
    members: dict[int, list[int]] = {}
    seen_in: dict[int, set[int]] = {}
    views = view.tolist()
    for a, b in ends.tolist():
        for node in (a, b):
            if label[node] < 0:
                label[node] = node
                members[node], seen_in[node] = [node], {views[node]}
        large, small = int(label[a]), int(label[b])
        if large == small or not seen_in[large].isdisjoint(seen_in[small]):
            continue
        if len(members[large]) < len(members[small]):
            large, small = small, large
        label[members[small]] = large
        members[large] += members.pop(small)
        seen_in[large] |= seen_in.pop(small)
    return label


@dataclass(frozen=True, eq=False)
class _Links:
    """All matches of a number of images as pairs of nodes, a node being a keypoint of one of the images."""

    ends: NDArray[np.int64]  # (K, 2) nodes, the most similar pairs first
    start: NDArray[np.int64]  # (V,) first node of each image
    view: NDArray[np.int64]  # (N,) image of each node
    pixel: Array  # (N, 2)
    scale_px: Array  # (N,)

    def observations(self, label: NDArray[np.int64], noise: ReferenceNoise) -> Observations:
        """The observations of the labelled nodes, a point for each label, sorted by point and view."""
        node = np.flatnonzero(label >= 0)
        _, point = np.unique(label[node], return_inverse=True)
        order = np.lexsort((node, point))
        node, point = node[order], point[order].astype(np.int64)
        view = self.view[node]
        sigma = noise.keypoint_sigma * self.scale_px[node]
        return Observations(point, view, self.pixel[node], sigma, node - self.start[view])


def _links(images: Sequence[PosedFeatures], matches: Mapping[Pair, Matches]) -> _Links:
    count = np.array([len(image.features) for image in images], dtype=np.int64)
    start = np.cumsum(count) - count
    parts = [m.indices.astype(np.int64) + np.array([start[a], start[b]]) for (a, b), m in matches.items()]
    score = np.concatenate([np.zeros(0, np.float32), *(m.scores for m in matches.values())])
    ends = np.concatenate([np.zeros((0, 2), np.int64), *parts])[np.argsort(-score, kind="stable")]
    return _Links(
        ends,
        start,
        np.repeat(np.arange(len(images)), count),
        np.concatenate([np.zeros((0, 2)), *(image.pixels for image in images)]),
        np.concatenate([np.zeros(0), *(image.features.scales_px.astype(np.float64) for image in images)]),
    )


def consistent_tracks(views: Views, observations: Observations, noise: ReferenceNoise, pose_covs: Array) -> Tracks:
    """Points from the observations that agree within their noise and what the errors of the poses do to them.

    observations: with the sigmas of their keypoints alone; pose_covs: (V, 6, 6) of the views.
    """
    count = int(observations.point.max()) + 1 if len(observations) else 0
    rough = triangulate(
        views, observations.point, observations.view, observations.pixel, observations.sigma_px, count
    ).points
    spread = _spread_px(views, observations, rough, pose_covs)
    numbered = replace(
        observations,
        sigma_px=np.hypot(observations.sigma_px, spread),
        keypoint=np.arange(len(observations)),
    )
    agreed = triangulate_consistent(views, np.arange(count), numbered, _GATE)
    kept = observations.take(agreed.observations.keypoint).with_points(agreed.observations.point)
    return _solved(views, kept, agreed, noise)


def _solved(views: Views, observations: Observations, agreed: LocalModel, noise: ReferenceNoise) -> Tracks:
    angle = nearest_ray_angles(agreed.points, observations, views.centres)
    obs = replace(observations, sigma_px=observations.sigma_px * noise.widening(angle))
    solved = triangulate(views, obs.point, obs.view, obs.pixel, obs.sigma_px, len(agreed))
    known = np.asarray(np.isfinite(solved.points).all(axis=1) & np.isfinite(solved.cov).all(axis=(1, 2)))
    kept = obs.take(known[obs.point])
    return Tracks(solved.points[known], solved.cov[known], kept.with_points((np.cumsum(known) - 1)[kept.point]))


def _spread_px(views: Views, observations: Observations, points: Array, pose_covs: Array) -> Array:
    """By how much (n,) the errors of the poses move a projection: root mean square of its two coordinates."""
    lin = linearize(views, observations.view, points[observations.point])
    square = np.einsum("nki,nij,nkj->n", lin.by_pose, pose_covs[observations.view], lin.by_pose)
    return np.sqrt(np.nan_to_num(square, nan=0.0) / 2.0)


def _concatenated(parts: Sequence[Tracks]) -> Tracks:
    offset = np.cumsum([0, *(len(part) for part in parts)])
    obs = [p.observations.with_points(p.observations.point + o) for p, o in zip(parts, offset, strict=False)]
    return Tracks(
        np.concatenate([p.points for p in parts]),
        np.concatenate([p.cov for p in parts]),
        Observations.joined(obs),
    )


def structure_of(own: int, members: NDArray[np.int64], tracks: Tracks) -> ImageStructure:
    """The tracks that one of the images (its view) sees, in the order of its keypoints; members name the views."""
    obs = tracks.observations
    here = np.flatnonzero(obs.view == own)
    here = here[np.argsort(obs.keypoint[here], kind="stable")]
    chosen = obs.point[here]
    first = np.flatnonzero(np.diff(obs.point, prepend=-1))[chosen]
    place = np.full(len(tracks), -1, np.int64)
    place[chosen] = np.arange(len(chosen))
    kept = obs.take(place[obs.point] >= 0)
    kept = kept.take(np.argsort(place[kept.point], kind="stable"))
    return ImageStructure(
        obs.keypoint[here],
        np.column_stack([members[obs.view[first]], obs.keypoint[first]]).reshape(-1, 2),
        tracks.points[chosen],
        tracks.cov[chosen],
        replace(kept.with_points(place[kept.point]), view=members[kept.view]),
    )
