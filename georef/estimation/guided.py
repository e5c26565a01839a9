"""Matching of two images whose poses are known: mutual nearest descriptors within the epipolar band.

Epipolar geometry holds for rays, of any camera: two rays and the base lie in one plane. How far they are from it is
told in pixels of each image.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from georef.config import LocalizeConfig
from georef.features.nearest import similarity
from georef.geometry.camera import Camera, ray_derivatives, rays_from_pixels
from georef.geometry.rigid import Array, Rigid3, skew
from georef.types.features import Features, Matches

_ROUNDING = 1.001  # of single precision
_NEVER = -2.0  # below any cosine
_DENSE_SHARE = 0.02  # of all pairs that are similar: beyond it the band itself is found at less cost


@dataclass(frozen=True, eq=False)
class Bearings:
    """Where the keypoints of an image look, in its camera frame; NaN for a keypoint outside of what the lens shows."""

    rays: Array  # (N, 3), of z = 1 or of unit length
    by_pixel: Array  # (N, 3, 2) derivatives of the rays

    @staticmethod
    def of(camera: Camera, pixels: Array) -> Bearings:
        rays = rays_from_pixels(camera, pixels)
        return Bearings(rays, ray_derivatives(camera, rays))

    def take(self, indices: NDArray[np.integer] | slice) -> Bearings:
        return Bearings(self.rays[indices], self.by_pixel[indices])


@dataclass(frozen=True, eq=False)
class PosedFeatures:
    """The features of an image with its camera, its pose and the viewing directions of its keypoints."""

    features: Features
    camera: Camera
    world_from_cam: Rigid3
    bearings: Bearings

    @staticmethod
    def of(features: Features, camera: Camera, world_from_cam: Rigid3) -> PosedFeatures:
        pixels = features.keypoints_px.astype(np.float64)
        return PosedFeatures(features, camera, world_from_cam, Bearings.of(camera, pixels))

    @cached_property
    def pixels(self) -> Array:
        """The observed keypoints (N, 2), float64."""
        return self.features.keypoints_px.astype(np.float64)

    def posed(self, world_from_cam: Rigid3) -> PosedFeatures:
        return PosedFeatures(self.features, self.camera, world_from_cam, self.bearings)

    def head(self, count: int) -> PosedFeatures:
        """The same image with its `count` best features."""
        return PosedFeatures(
            self.features.head(count), self.camera, self.world_from_cam, self.bearings.take(slice(count))
        )


@dataclass(frozen=True)
class GuidedOptions:
    gate: float  # largest distance from the epipolar line, in keypoint scales
    min_similarity: float  # cosine of descriptors
    ratio: float  # best descriptor distance over the second best in the band

    @staticmethod
    def of(config: LocalizeConfig) -> GuidedOptions:
        """As configured."""
        return GuidedOptions(config.guided_gate, config.guided_min_similarity, config.guided_ratio)

    @property
    def least_rival(self) -> float:
        """The least similarity of a second best that can make a match ambiguous."""
        return 1.0 - (1.0 - self.min_similarity) / self.ratio**2


def essential_matrix(a: PosedFeatures, b: PosedFeatures) -> Array:
    """E (3, 3) with d_b^T E d_a = 0 for rays d of one point. Hartley and Zisserman (2004), section 9.6."""
    b_from_a = b.world_from_cam.inverse() @ a.world_from_cam
    return skew(b_from_a.translation) @ b_from_a.rotation


def guided_matches(a: PosedFeatures, b: PosedFeatures, options: GuidedOptions, known: Matches | None = None) -> Matches:
    """One-to-one matches along epipolar lines; scores are cosine similarities.

    `known` matches that lie in the band are kept as they are, the others are looked for among what they leave.
    """
    if len(a.features) == 0 or len(b.features) == 0:
        return Matches.empty()
    kept = known or Matches.empty()
    in_band = within_band(a, b, kept.indices, options.gate)
    kept = Matches(kept.indices[in_band], kept.scores[in_band])
    cosine = similarity(a.features.descriptors, b.features.descriptors)
    cosine[kept.indices[:, 0], :] = _NEVER
    cosine[:, kept.indices[:, 1]] = _NEVER
    pairs = _similar_in_band(a, b, cosine, options)
    score = cosine[pairs[:, 0], pairs[:, 1]]
    best = mutual_best(pairs, score, options)
    indices = np.concatenate([kept.indices, pairs[best].astype(np.int32)])
    return Matches(indices, np.concatenate([kept.scores, score[best]]))


def _similar_in_band(
    a: PosedFeatures, b: PosedFeatures, cosine: NDArray[np.float32], options: GuidedOptions
) -> NDArray[np.int64]:
    """Pairs (K, 2) in the band that are a match or a rival of one, by their similarities (N, M)."""
    similar = cosine >= max(options.least_rival, -1.0)
    if np.count_nonzero(similar) > _DENSE_SHARE * similar.size:
        similar &= _nearly_in_band(a, b, options.gate)
    pairs = np.column_stack(np.divmod(np.flatnonzero(similar.ravel()), cosine.shape[1]))
    return pairs[within_band(a, b, pairs, options.gate)]


def mutual_best(pairs: NDArray[np.integer], score: NDArray[np.float32], options: GuidedOptions) -> NDArray[np.int64]:
    """Which pairs (K, 2) are the most similar ones of both their members, and clearly so for the first member.

    The pairs must include all that are at least `options.least_rival` similar and otherwise allowed.
    """
    by_first = np.lexsort((pairs[:, 1], -score, pairs[:, 0]))
    by_second = np.lexsort((pairs[:, 0], -score, pairs[:, 1]))
    best_of_second = np.zeros(len(pairs), bool)
    best_of_second[by_second[_starts(pairs[by_second, 1])]] = True
    start = _starts(pairs[by_first, 0])
    best = by_first[start]
    rival = np.full(len(best), -1.0, np.float32)
    has_rival = np.diff(np.append(start, len(pairs))) > 1
    rival[has_rival] = score[by_first[start[has_rival] + 1]]
    distinct = np.maximum(1.0 - score[best], 0.0) <= options.ratio**2 * np.maximum(1.0 - rival, 1e-9)
    return best[distinct & best_of_second[best] & (score[best] >= options.min_similarity)]


def _starts(sorted_values: NDArray[np.integer]) -> NDArray[np.int64]:
    """Where runs of equal values begin."""
    return np.flatnonzero(np.diff(sorted_values, prepend=-1))


def epipolar_distances(a: PosedFeatures, b: PosedFeatures, indices: NDArray[np.integer]) -> Array:
    """Distances (M, 2) in pixels of matched keypoints (M, 2) from each other's epipolar curves, in a and in b.

    The misclosure d_b^T E d_a over its derivative by the pixel: exact in a pinhole image, of first order in others.
    """
    essential = essential_matrix(a, b)
    in_a, in_b = a.bearings.take(indices[:, 0]), b.bearings.take(indices[:, 1])
    normal_in_a, normal_in_b = in_b.rays @ essential, in_a.rays @ essential.T
    off = np.abs(np.einsum("ni,ni->n", in_b.rays, normal_in_b))
    rates = [
        np.linalg.norm(np.einsum("ni,nik->nk", normal, bearings.by_pixel), axis=1)
        for normal, bearings in ((normal_in_a, in_a), (normal_in_b, in_b))
    ]
    with np.errstate(divide="ignore", invalid="ignore"):
        return off[:, None] / np.column_stack(rates)


def within_band(a: PosedFeatures, b: PosedFeatures, pairs: NDArray[np.integer], gate: float) -> NDArray[np.bool_]:
    """Whether keypoints (M, 2) lie within `gate` keypoint scales of each other's epipolar curves, in both images.

    Images from one place have no epipolar planes: no pair does.
    """
    limits = gate * np.column_stack([a.features.scales_px[pairs[:, 0]], b.features.scales_px[pairs[:, 1]]])
    return np.asarray((epipolar_distances(a, b, pairs) <= limits).all(axis=1))


def epipolar_band(a: PosedFeatures, b: PosedFeatures, gate: float) -> NDArray[np.bool_]:
    """(N, M) pairs within `gate` keypoint scales of each other's epipolar curves in both images (`within_band`)."""
    near = _nearly_in_band(a, b, gate)
    pairs = np.argwhere(near)
    outside = pairs[~within_band(a, b, pairs, gate)]
    near[outside[:, 0], outside[:, 1]] = False
    return near


def _nearly_in_band(a: PosedFeatures, b: PosedFeatures, gate: float) -> NDArray[np.bool_]:
    """The band, and pairs a little beyond it: with the largest rate of the misclosure that a keypoint can have."""
    essential = essential_matrix(a, b).astype(np.float32)
    in_a, in_b = a.bearings.rays.astype(np.float32), b.bearings.rays.astype(np.float32)
    reach_a, reach_b = (gate * _ROUNDING * i.features.scales_px * _largest_rate(i.bearings) for i in (a, b))
    normals_in_b, normals_in_a = in_a @ essential.T, in_b @ essential
    with np.errstate(divide="ignore", invalid="ignore"):
        normals_in_b /= np.linalg.norm(normals_in_b, axis=1, keepdims=True)
        normals_in_a /= np.linalg.norm(normals_in_a, axis=1, keepdims=True)
        near_in_b = np.abs(normals_in_b @ in_b.T) <= reach_b[None, :]
        near_in_a = np.abs(in_a @ normals_in_a.T) <= reach_a[:, None]
    return near_in_b & near_in_a


def _largest_rate(bearings: Bearings) -> NDArray[np.float32]:
    """By how much a pixel moves a ray at most: the largest singular values (N,) of the derivatives."""
    square = np.swapaxes(bearings.by_pixel, 1, 2) @ bearings.by_pixel
    half_trace = 0.5 * (square[:, 0, 0] + square[:, 1, 1])
    spread = np.hypot(0.5 * (square[:, 0, 0] - square[:, 1, 1]), square[:, 0, 1])
    return np.sqrt(half_trace + spread).astype(np.float32)
