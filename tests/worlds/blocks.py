"""Adjustment problems of the points world: new images tied to references, GNSS, pose priors and surveyed control."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from georef.config import AdjustConfig
from georef.estimation.adjustment import block as adjustment
from georef.estimation.adjustment.block import KINDS_OF_POSE, PosePriors
from georef.estimation.adjustment.problem import AutomaticGcps, Problem
from georef.estimation.epoch_problem import epoch_problem
from georef.estimation.tracks import PairMatches
from georef.geometry.camera import Camera, project
from georef.geometry.poses import Poses
from georef.geometry.rigid import Array, Rigid3
from georef.types.campaign import PosePrior, PositionPrior
from georef.types.constraints import ControlPoint, Mark
from georef.types.results import Localized, ReferenceMatches, ReferenceNoise
from tests.worlds.points import (
    CAMERA,
    NOISE,
    World,
    common,
    court,
    disturbed,
    loose_cov,
    new_image,
    photograph,
    reference_map,
)

AUTO_GCPS = AdjustConfig(gnss=False)


@dataclass(frozen=True, eq=False)
class Block:
    """A world, and the problem of its new images."""

    world: World
    problem: Problem

    def errors(self, poses: Sequence[Rigid3]) -> Array:
        """Errors (6M,) of all poses, estimated minus true."""
        return np.concatenate([truth.local(pose) for truth, pose in zip(self.world.queries, poses, strict=True)])


def block(
    seed: int,
    *,
    noise: ReferenceNoise = NOISE,
    stated: ReferenceNoise | None = None,
    points: int = 180,
    references: int = 5,
    queries: int = 4,
    blunders: float = 0.0,
    config: AdjustConfig = AUTO_GCPS,
    camera: Camera = CAMERA,
    make: Callable[..., World] = court,
    unknown: Collection[int] = (),
) -> Block:
    """New images with automatic GCPs from references whose poses have errors, by the route of the pipeline.

    unknown: new images whose camera was estimated; their pose is given to 5 cm and 3 mrad, as that of all.
    """
    rng = np.random.default_rng([seed, 77])
    world = make(seed, points=points, references=references, queries=queries)
    given = [disturbed(pose, noise, rng) for pose in world.references]
    seen = [
        photograph(world, pose, rng, keypoint_sigma=noise.keypoint_sigma, camera=camera) for pose in world.references
    ]
    new = [
        photograph(world, pose, rng, keypoint_sigma=noise.keypoint_sigma, blunders=blunders, camera=camera)
        for pose in world.queries
    ]
    new = [replace(n, camera=replace(camera, estimate=("focal",))) if i in unknown else n for i, n in enumerate(new)]
    localized = []
    for i, image in enumerate(new):
        cov = loose_cov(image.truth, 0.05, 0.003)
        start = image.truth.retract(np.linalg.cholesky(cov) @ rng.normal(size=6))
        matches = tuple(ReferenceMatches(f"r{k}", common(image, other).indices) for k, other in enumerate(seen))
        everything = np.arange(len(world.points))
        localized.append(Localized(f"q{i}", start, cov, cov, 100, 1.0, matches, world.points, everything))
    problem = epoch_problem(
        [new_image(result.image_id) for result in localized],
        localized,
        [image.posed(result.world_from_cam) for image, result in zip(new, localized, strict=True)],
        [PairMatches(i, j, common(new[i], new[j]).indices) for i, j in combinations(range(len(new)), 2)],
        reference_map(seen, given, stated or noise),
        (),
        config,
    )
    return Block(world, problem)


def without_gcps(problem: Problem) -> Problem:
    return _tidy(replace(problem, gcps=AutomaticGcps.none()))


def _tidy(problem: Problem) -> Problem:
    return problem.restricted(np.ones(len(problem.observations), bool), np.ones(len(problem.gcps), bool))


def gnss(world: World, rng: np.random.Generator, sigma_m: float, bad: Collection[int] = (), off_m: float = 0.0):
    """Position priors of all new images; the bad ones stand `off_m` to the east."""
    return {
        i: PositionPrior(
            pose.translation + sigma_m * rng.normal(size=3) + [off_m * (i in bad), 0.0, 0.0], np.eye(3) * sigma_m**2
        )
        for i, pose in enumerate(world.queries)
    }


def pose_priors(world: World, rng: np.random.Generator, bad: Collection[int] = (), off_m: float = 0.0):
    """Pose priors of 2 cm and 1 mrad for all new images; the bad ones stand `off_m` to the east."""
    out = {}
    for i, truth in enumerate(world.queries):
        cov = loose_cov(truth, 0.02, 0.001)
        pose = truth.retract(np.linalg.cholesky(cov) @ rng.normal(size=6))
        shift = np.array([off_m * (i in bad), 0.0, 0.0])
        out[i] = PosePrior(Rigid3(pose.rotation, pose.translation + shift), cov)
    return out


def orientations(world: World, rng: np.random.Generator, sigma_m: float, sigma_rad: float) -> PosePriors:
    """Given exterior orientations of all new images."""
    noise = ReferenceNoise(1.0, (sigma_m, sigma_m, sigma_m), (sigma_rad, sigma_rad, sigma_rad), "declared")
    given = [disturbed(pose, noise, rng) for pose in world.queries]
    every = np.arange(len(given))
    kind = np.full(len(given), KINDS_OF_POSE.index("orientation"))
    return PosePriors(every, Poses.of(given), np.array([noise.pose_cov(pose) for pose in given]), kind)


def with_orientations(whole: adjustment.Block, given: PosePriors, images: Collection[int]) -> adjustment.Block:
    """A block with the given exterior orientations of some images beside its other priors."""
    more, there = given.take(np.isin(given.image, list(images))), whole.pose_priors
    joined = PosePriors(
        np.concatenate([there.image, more.image]),
        Poses.of([*there.world_from_cam.to_list(), *more.world_from_cam.to_list()]),
        np.concatenate([there.cov, more.cov]),
        np.concatenate([there.kind, more.kind]),
    )
    return replace(whole, pose_priors=joined)


def control(
    world: World,
    rng: np.random.Generator,
    *,
    count: int = 8,
    sigma_m: float = 0.01,
    mark_px: float = 0.5,
    bad: Collection[int] = (),
    off_m: float = 0.0,
) -> tuple[ControlPoint, ...]:
    """Control points P0, P1, ... with marks in at least three new images; the bad ones stand `off_m` to the east."""
    out: list[ControlPoint] = []
    for truth in world.points:
        marks = []
        for i, pose in enumerate(world.queries):
            pixel = project(CAMERA, pose.inverse().apply(truth[None]))[0]
            if ((pixel > 0) & (pixel < [CAMERA.width, CAMERA.height])).all():
                marks.append(Mark(f"q{i}", pixel + mark_px * rng.normal(size=2), mark_px))
        if len(marks) >= 3 and len(out) < count:
            shift = np.array([off_m * (len(out) in bad), 0.0, 0.0])
            position = truth + sigma_m * rng.normal(size=3) + shift
            out.append(ControlPoint(f"P{len(out)}", position, np.eye(3) * sigma_m**2, tuple(marks)))
    return tuple(out)
