"""A world without rendering: points on the walls of a court, cameras in it, and features that know their point.

Reference cameras have exact poses and given ones with errors; keypoints are exact projections plus noise in
proportion to their scale; descriptors are random unit vectors that the views of one point share, with a little noise,
so that matchers work for real. Blunders keep the descriptor of their point and stand somewhere else.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from georef.estimation.guided import PosedFeatures
from georef.estimation.reference_map import ReferenceMap
from georef.evaluation.statistics import nees
from georef.geometry.camera import Camera, project
from georef.geometry.covariance import pose_cov_from_parts
from georef.geometry.rigid import Array, Rigid3, exp_so3
from georef.types.campaign import Campaign, Image, PositionPrior
from georef.types.features import Features, Matches
from georef.types.results import ReferenceNoise

CAMERA = Camera("wide", 3000, 2000, 2000.0, 2010.0, 1490.0, 1010.0, (-0.05, 0.01, 2e-4, -1e-4))
NOISE = ReferenceNoise(0.4, (0.006, 0.006, 0.006), (2e-4, 2e-4, 2e-4), "declared")
_LEVEL_NORTH = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
_DIMENSION, _DESCRIPTOR_NOISE = 64, 0.04
_SCALES_PX = np.array([1.0, 1.5, 2.5])


@dataclass(frozen=True, eq=False)
class Seen:
    """One photograph of the world: its true pose, its features, and which point each keypoint is of (-1: clutter)."""

    truth: Rigid3
    features: Features
    point: NDArray[np.int64]  # (N,)
    blunder: NDArray[np.bool_]  # (N,)
    camera: Camera = CAMERA

    def posed(self, world_from_cam: Rigid3 | None = None) -> PosedFeatures:
        return PosedFeatures.of(self.features, self.camera, world_from_cam or self.truth)


@dataclass(frozen=True, eq=False)
class World:
    points: Array  # (P, 3)
    descriptors: Array  # (P, D)
    references: tuple[Rigid3, ...]  # true poses
    queries: tuple[Rigid3, ...]


def court(
    seed: int, *, points: int = 300, references: int = 6, queries: int = 4, origin: Sequence[float] = (0.0, 0.0, 0.0)
) -> World:
    """Three walls with relief around cameras that look north; `origin` moves everything."""
    rng = np.random.default_rng(seed)
    wall = rng.integers(0, 4, points)  # twice the share for the wall ahead
    along, depth, height = rng.uniform(-12, 12, points), rng.uniform(-0.5, 0.5, points), rng.uniform(0, 8, points)
    ahead = np.column_stack([along, 14.0 + depth, height])
    aside = np.column_stack([np.where(wall == 0, -12.0, 12.0) + depth, 8.0 + along / 2.0, height])
    position = np.where((wall >= 2)[:, None], ahead, aside) + origin
    return World(
        position,
        unit(rng.normal(size=(points, _DIMENSION))),
        _row(rng, references, half_width=6.0, y=(-1.0, 1.0), origin=origin),
        _row(rng, queries, half_width=4.0, y=(1.5, 4.0), origin=origin),
    )


def hall(seed: int, *, points: int = 300, references: int = 6, queries: int = 4) -> World:
    """A hall whose walls, floor and ceiling stand on all sides of its cameras: for lenses that see to the side."""
    rng = np.random.default_rng(seed)
    half = np.array([9.0, 9.0, 4.0])
    face, position = rng.integers(0, 6, points), rng.uniform(-half, half, (points, 3))
    axis = face % 3
    position[np.arange(points), axis] = np.where(face < 3, -1, 1) * half[axis] + rng.uniform(-0.4, 0.4, points)
    descriptors = unit(rng.normal(size=(points, _DIMENSION)))
    middle = (0.0, 0.0, -1.6)
    return World(
        position,
        descriptors,
        _row(rng, references, half_width=3.0, y=(-1.0, 1.0), origin=middle),
        _row(rng, queries, half_width=2.0, y=(0.5, 2.0), origin=middle),
    )


def flat_wall(seed: int, *, points: int = 300, references: int = 6) -> World:
    """A wall without relief, and a query that looks at it square on: focal length and distance look alike."""
    rng = np.random.default_rng(seed)
    position = np.column_stack([rng.uniform(-8, 8, points), np.full(points, 14.0), rng.uniform(-2, 6, points)])
    query = Rigid3(_LEVEL_NORTH, np.array([0.3, 2.0, 2.0]))
    rows = _row(rng, references, half_width=6.0, y=(-1.0, 1.0), origin=(0.0, 0.0, 0.0))
    return World(position, unit(rng.normal(size=(points, _DIMENSION))), rows, (query,))


def _row(
    rng: np.random.Generator, count: int, *, half_width: float, y: tuple[float, float], origin: Sequence[float]
) -> tuple[Rigid3, ...]:
    """Cameras from west to east that look about north."""
    poses = []
    for x in np.linspace(-half_width, half_width, count):
        turn = exp_so3(rng.uniform([-0.08, -0.2, -0.03], [0.12, 0.2, 0.03]))
        position = np.array([x + rng.uniform(-0.5, 0.5), rng.uniform(*y), rng.uniform(1.4, 1.9)])
        poses.append(Rigid3(_LEVEL_NORTH @ turn, position + origin))
    return tuple(poses)


def unit(vectors: Array) -> Array:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def photograph(
    world: World,
    pose: Rigid3,
    rng: np.random.Generator,
    *,
    keypoint_sigma: float = NOISE.keypoint_sigma,
    blunders: float = 0.0,
    clutter: int = 0,
    detected: float = 0.85,
    camera: Camera = CAMERA,
) -> Seen:
    """What a camera at a pose sees: keypoint noise of keypoint_sigma times scale, a share of blunders, clutter."""
    pixel = project(camera, pose.inverse().apply(world.points))
    size = np.array([camera.width, camera.height])
    point = np.flatnonzero(((pixel > 0) & (pixel < size)).all(axis=1) & (rng.random(len(pixel)) < detected))
    scale = rng.choice(_SCALES_PX, len(point) + clutter)
    keypoints = np.concatenate([pixel[point], rng.uniform(0, size, (clutter, 2))])
    keypoints[: len(point)] += rng.normal(size=(len(point), 2)) * keypoint_sigma * scale[: len(point), None]
    blunder = np.zeros(len(keypoints), bool)
    blunder[: len(point)] = rng.random(len(point)) < blunders
    away = 25.0 * np.exp(rng.uniform(0.0, 3.0, int(blunder.sum())))
    angle = rng.uniform(0, 2 * np.pi, len(away))
    keypoints[blunder] += np.column_stack([np.cos(angle), np.sin(angle)]) * away[:, None]
    descriptors = np.concatenate([world.descriptors[point], unit(rng.normal(size=(clutter, _DIMENSION)))])
    descriptors = unit(descriptors + _DESCRIPTOR_NOISE * rng.normal(size=descriptors.shape))
    order = rng.permutation(len(keypoints))  # keypoints are sorted by score, which says nothing here
    features = Features(
        (camera.width, camera.height),
        keypoints[order].astype(np.float32),
        np.linspace(1.0, 0.1, len(order), dtype=np.float32),
        scale[order].astype(np.float32),
        descriptors[order].astype(np.float32),
        np.zeros((len(order), 3), np.uint8),
    )
    return Seen(pose, features, np.concatenate([point, np.full(clutter, -1)])[order], blunder[order], camera)


def common(a: Seen, b: Seen) -> Matches:
    """All keypoints of two photographs that are of one point, blunders included."""
    _, in_a, in_b = np.intersect1d(a.point, b.point, return_indices=True)
    here = a.point[in_a] >= 0
    pairs = np.column_stack([in_a[here], in_b[here]]).astype(np.int32)
    return Matches(pairs, np.ones(len(pairs), np.float32))


def disturbed(pose: Rigid3, noise: ReferenceNoise, rng: np.random.Generator) -> Rigid3:
    """A pose with the errors that a noise states: position in world axes, rotation about camera axes."""
    turn = Rigid3.exp([*rng.normal(size=3) * noise.rotation_sigma_rad, 0.0, 0.0, 0.0])
    shift = rng.normal(size=3) * noise.position_sigma_m
    return Rigid3(pose.rotation @ turn.rotation, pose.translation + shift)


def loose_cov(pose: Rigid3, position_m: float, rotation_rad: float) -> Array:
    return pose_cov_from_parts(pose, np.eye(3) * position_m**2, np.eye(3) * rotation_rad**2)


def reference_map(seen: Sequence[Seen], given: Sequence[Rigid3], noise: ReferenceNoise = NOISE) -> ReferenceMap:
    """Photographs as reference images r0, r1, ... at their given poses."""
    images = tuple(
        Image(f"r{i}", Path(f"r{i}.jpg"), photo.camera, "reference", world_from_cam=pose)
        for i, (photo, pose) in enumerate(zip(seen, given, strict=True))
    )

    def read(image_id: str, count: int | None) -> Features:
        features = seen[int(image_id[1:])].features
        return features if count is None else features.head(count)

    return ReferenceMap(Campaign("reference", images), read, noise)


def new_image(
    name: str,
    gnss: Array | None = None,
    sigma_m: float = 2.0,
    heading_rad: float | None = None,
    camera: Camera = CAMERA,
) -> Image:
    prior = None if gnss is None else PositionPrior(np.asarray(gnss, float), np.eye(3) * sigma_m**2)
    return Image(name, Path(f"{name}.jpg"), camera, "new", gnss=prior, heading_rad=heading_rad)


def pose_nees(truth: Rigid3, estimate: Rigid3, cov: Array) -> float:
    """NEES (6 degrees of freedom) of a pose."""
    return nees(truth.local(estimate), cov)


def scaled_noise(noise: ReferenceNoise, keypoint: float = 1.0, poses: float = 1.0) -> ReferenceNoise:
    """A noise with its keypoint sigma and its pose sigmas multiplied."""
    return replace(
        noise,
        keypoint_sigma=noise.keypoint_sigma * keypoint,
        position_sigma_m=tuple(poses * s for s in noise.position_sigma_m),
        rotation_sigma_rad=tuple(poses * s for s in noise.rotation_sigma_rad),
    )
