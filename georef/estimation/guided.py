"""Matching of two images whose poses are known: mutual nearest descriptors within the epipolar band.

Epipolar geometry holds for rays, of any camera: two rays and the base lie in one plane. How far they are from it is
told in pixels of each image.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from georef.features.nearest import similarity
from georef.geometry.camera import Camera, ray_derivatives, rays_from_pixels
from georef.geometry.rigid import Array, Rigid3, skew
from georef.types.features import Features, Matches

_ROUNDING = 1.001  # of single precision


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
    allowed = epipolar_band(a, b, options.gate)
    kept = known or Matches.empty()
    in_band = allowed[kept.indices[:, 0], kept.indices[:, 1]]
    kept = Matches(kept.indices[in_band], kept.scores[in_band])
    allowed[kept.indices[:, 0], :] = False
    allowed[:, kept.indices[:, 1]] = False
    cosine = np.where(allowed, similarity(a.features.descriptors, b.features.descriptors), -1.0)
    best_b = cosine.argmax(axis=1)
    best_a = cosine.argmax(axis=0)
    rows = np.arange(len(cosine))
    score = cosine[rows, best_b]
    keep = (best_a[best_b] == rows) & (score >= options.min_similarity)
    keep &= _distinct(cosine, rows, best_b, score, options.ratio)
    pairs = np.column_stack([rows[keep], best_b[keep]]).astype(np.int32)
    return Matches(np.concatenate([kept.indices, pairs]), np.concatenate([kept.scores, score[keep].astype(np.float32)]))


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


def epipolar_band(a: PosedFeatures, b: PosedFeatures, gate: float) -> NDArray[np.bool_]:
    """(N, M) pairs whose distance from each other's epipolar curve is at most `gate` keypoint scales in both images.

    Images from one place have no epipolar planes: no pair.
    """
    near = _nearly_in_band(a, b, gate)
    pairs = np.argwhere(near)
    limits = gate * np.column_stack([a.features.scales_px[pairs[:, 0]], b.features.scales_px[pairs[:, 1]]])
    inside = (epipolar_distances(a, b, pairs) <= limits).all(axis=1)
    near[pairs[~inside, 0], pairs[~inside, 1]] = False
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


def _distinct(cosine: Array, rows: NDArray[np.integer], best: NDArray[np.integer], score: Array, ratio: float) -> Array:
    """Whether the second best of each row is farther by the ratio of descriptor distances."""
    second = cosine.copy()
    second[rows, best] = -1.0
    runner_up = second.max(axis=1)
    return np.maximum(1.0 - score, 0.0) <= ratio * ratio * np.maximum(1.0 - runner_up, 1e-9)
