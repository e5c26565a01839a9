"""Matching of two images whose poses are known: mutual nearest descriptors within the epipolar band."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from georef.features.nearest import similarity
from georef.geometry.camera import Camera, ideal_from_observed
from georef.geometry.rigid import Array, Rigid3, skew
from georef.types.features import Features, Matches


@dataclass(frozen=True, eq=False)
class PosedFeatures:
    """The features of an image with its pose and ideal (distortion-free) keypoints."""

    features: Features
    camera: Camera
    world_from_cam: Rigid3
    ideal_px: Array  # (N, 2)

    @staticmethod
    def of(features: Features, camera: Camera, world_from_cam: Rigid3) -> PosedFeatures:
        return PosedFeatures(features, camera, world_from_cam, ideal_from_observed(camera, features.keypoints_px))

    def posed(self, world_from_cam: Rigid3) -> PosedFeatures:
        return PosedFeatures(self.features, self.camera, world_from_cam, self.ideal_px)


@dataclass(frozen=True)
class GuidedOptions:
    gate: float  # largest distance from the epipolar line, in keypoint scales
    min_similarity: float  # cosine of descriptors
    ratio: float  # best descriptor distance over the second best in the band


def fundamental_matrix(a: PosedFeatures, b: PosedFeatures) -> Array:
    """F (3, 3) with x_b^T F x_a = 0 for ideal pixels. Hartley and Zisserman (2004), eq. 9.2."""
    b_from_a = b.world_from_cam.inverse() @ a.world_from_cam
    essential = skew(b_from_a.translation) @ b_from_a.rotation
    return np.linalg.inv(b.camera.matrix).T @ essential @ np.linalg.inv(a.camera.matrix)


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
    """Distances (M, 2) in pixels of matched keypoints (M, 2) from each other's epipolar lines, in a and in b."""
    f = fundamental_matrix(a, b)
    in_a = np.column_stack([a.ideal_px[indices[:, 0]], np.ones(len(indices))])
    in_b = np.column_stack([b.ideal_px[indices[:, 1]], np.ones(len(indices))])
    line_in_a, line_in_b = in_b @ f, in_a @ f.T
    off = np.abs(np.einsum("ni,ni->n", in_b, line_in_b))
    return np.column_stack([off / np.linalg.norm(line[:, :2], axis=1) for line in (line_in_a, line_in_b)])


def epipolar_band(a: PosedFeatures, b: PosedFeatures, gate: float) -> NDArray[np.bool_]:
    """(N, M) pairs whose distance from each other's epipolar line is at most `gate` keypoint scales in both images.

    Images from one place have no epipolar lines: no pair.
    """
    f = fundamental_matrix(a, b).astype(np.float32)
    in_a, in_b = _homogeneous(a.ideal_px), _homogeneous(b.ideal_px)
    lines_in_b, lines_in_a = in_a @ f.T, in_b @ f
    with np.errstate(divide="ignore", invalid="ignore"):
        lines_in_b /= np.linalg.norm(lines_in_b[:, :2], axis=1, keepdims=True) * gate
        lines_in_a /= np.linalg.norm(lines_in_a[:, :2], axis=1, keepdims=True) * gate
        near_in_b = np.abs(lines_in_b @ in_b.T) <= b.features.scales_px[None, :]
        near_in_a = np.abs(in_a @ lines_in_a.T) <= a.features.scales_px[:, None]
    return near_in_b & near_in_a


def _distinct(cosine: Array, rows: NDArray[np.integer], best: NDArray[np.integer], score: Array, ratio: float) -> Array:
    """Whether the second best of each row is farther by the ratio of descriptor distances."""
    second = cosine.copy()
    second[rows, best] = -1.0
    runner_up = second.max(axis=1)
    return np.maximum(1.0 - score, 0.0) <= ratio * ratio * np.maximum(1.0 - runner_up, 1e-9)


def _homogeneous(pixels: Array) -> NDArray[np.float32]:
    return np.column_stack([pixels, np.ones(len(pixels))]).astype(np.float32)
