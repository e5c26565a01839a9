"""Gross errors of a simulated drive: stretches that were localized against a shifted reference, and single outliers."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from georef.estimation.adjustment.block import KINDS_OF_POINT, Block
from georef.geometry.poses import Poses
from georef.geometry.rigid import Array

_NONE = -1


@dataclass(frozen=True)
class DriveBlunders:
    """Shares of what is wrong, and how wrong.

    shift_m: lengths of the shifts of wrong stretches, between these, in random directions; each its own, or one for
    all. Single outliers lie between `nearest` and e^farther times that away.
    """

    poses: float = 0.0  # of the localized poses, in whole stretches
    points_in_stretches: float = 0.0  # of the automatic control points, in whole stretches
    shift_m: tuple[float, float] = (0.3, 1.5)
    one_shift: bool = False
    points: float = 0.0  # of the automatic control points, one by one
    nearest_point_m: float = 0.2
    observations: float = 0.0  # of the image observations, one by one
    nearest_px: float = 10.0
    farther: float = 2.5


@dataclass(frozen=True, eq=False)
class Wrong:
    """Which rows of a block are blunders: masks, and of rows of wrong stretches the index of the stretch, else -1."""

    observations: NDArray[np.bool_]  # (n,)
    poses: NDArray[np.bool_]  # (K,)
    pose_stretch: NDArray[np.int64]  # (K,)
    points: NDArray[np.bool_]  # (K,)
    point_stretch: NDArray[np.int64]  # (K,)
    shifts_m: Array  # (B, 3) of the wrong stretches, in world


def with_blunders(
    block: Block, street_of_point: NDArray[np.int64], street: NDArray[np.int64], design: DriveBlunders, seed: int
) -> tuple[Block, Wrong]:
    """The block with gross errors. Streets are those of stations (S,) and of point priors (K,)."""
    automatic = block.point_priors.kind == KINDS_OF_POINT.index("automatic")
    street_of_pose = street[block.station[block.pose_priors.image]]
    pose_stretch = _stretches(street_of_pose, design.poses, np.ones(len(street_of_pose), bool), _stream(seed, "poses"))
    point_stretch = _stretches(street_of_point, design.points_in_stretches, automatic, _stream(seed, "stretches"))
    point_stretch = np.where(point_stretch >= 0, point_stretch + pose_stretch.max(initial=_NONE) + 1, _NONE)
    count = int(max(pose_stretch.max(initial=_NONE), point_stretch.max(initial=_NONE))) + 1
    shifts = _directions(count, _stream(seed, "shifts")) * _stream(seed, "lengths").uniform(*design.shift_m, (count, 1))
    if design.one_shift:
        shifts = np.repeat(shifts[:1], count, axis=0)
    moved = np.concatenate([shifts, np.zeros((1, 3))])  # the last is that of -1
    points, single = _single_points(block.point_priors.position + moved[point_stretch], automatic, design, seed)
    observations, wrong_observations = _single_observations(block, design, seed)
    poses = block.pose_priors
    there = Poses(poses.world_from_cam.rotation, poses.world_from_cam.translation + moved[pose_stretch])
    wrong_points = (point_stretch >= 0) | single
    wrong = Wrong(wrong_observations, pose_stretch >= 0, pose_stretch, wrong_points, point_stretch, shifts)
    changed = replace(
        block,
        observations=replace(block.observations, pixel=observations),
        pose_priors=replace(poses, world_from_cam=there),
        point_priors=replace(block.point_priors, position=points),
    )
    return changed, wrong


def without(block: Block, wrong: Wrong) -> Block:
    """The block that lacks the blunders: what an oracle would adjust."""
    return replace(
        block,
        observations=block.observations.take(~wrong.observations),
        pose_priors=block.pose_priors.take(~wrong.poses),
        point_priors=block.point_priors.take(~wrong.points),
    )


def _stream(seed: int, name: str) -> np.random.Generator:
    return np.random.default_rng([seed, *b"blunders", *name.encode()])


def _stretches(
    street: NDArray[np.int64], share: float, eligible: NDArray[np.bool_], rng: np.random.Generator
) -> NDArray[np.int64]:
    """Streets at random until they hold a share of the eligible rows, the last cut off there: number, or -1 (K,)."""
    out, missing = np.full(len(street), _NONE), round(share * int(eligible.sum()))
    for number, chosen in enumerate(rng.permutation(np.unique(street[eligible]))):
        rows = np.flatnonzero(eligible & (street == chosen))[:missing]
        out[rows] = number
        missing -= len(rows)
        if missing <= 0:
            break
    return out


def _directions(count: int, rng: np.random.Generator) -> Array:
    vectors = rng.normal(size=(count, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def _single_points(
    position: Array, automatic: NDArray[np.bool_], design: DriveBlunders, seed: int
) -> tuple[Array, NDArray[np.bool_]]:
    rng, wrong = _stream(seed, "points"), np.zeros(len(position), bool)
    wrong[rng.permutation(np.flatnonzero(automatic))[: round(design.points * int(automatic.sum()))]] = True
    n = int(wrong.sum())
    away = design.nearest_point_m * np.exp(rng.uniform(0.0, design.farther, (n, 1))) * _directions(n, rng)
    out = position.copy()
    out[wrong] += away
    return out, wrong


def _single_observations(block: Block, design: DriveBlunders, seed: int) -> tuple[Array, NDArray[np.bool_]]:
    rng, pixel = _stream(seed, "observations"), block.observations.pixel.copy()
    wrong = np.zeros(len(pixel), bool)
    wrong[rng.permutation(len(pixel))[: round(design.observations * len(pixel))]] = True
    n = int(wrong.sum())
    angle, away = rng.uniform(0.0, 2.0 * np.pi, n), design.nearest_px * np.exp(rng.uniform(0.0, design.farther, n))
    pixel[wrong] += away[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    return pixel, wrong
