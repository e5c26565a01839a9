"""The street without rendering: its drives and natural points as an adjustment problem with surveyed check points.

Many draws of all errors over a few streets: who sees what is computed once a street, noise anew for every seed. The
reference is drawn from its declared sigmas; a smooth deformation, which nothing declares, moves the truth along.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import combinations
from pathlib import Path

import numpy as np

from georef.config import AdjustConfig
from georef.estimation.adjustment.problem import Problem
from georef.estimation.epoch_problem import epoch_problem
from georef.estimation.guided import PosedFeatures
from georef.estimation.reference_map import ReferenceMap
from georef.estimation.tracks import PairMatches
from georef.evaluation.forward_intersection import Intersection, PosedImages, intersect, spread
from georef.evaluation.statistics import nees
from georef.geometry.camera import Camera
from georef.geometry.rigid import Array, Rigid3
from georef.simulate.observations import NaturalMap, ObservationNoise, Observed, natural_map, observe, sightings
from georef.simulate.reference_errors import Deformation, ReferenceQuality, published
from georef.simulate.survey import Sightings, SurveyQuality, intersection_sigmas, sight, spread_out
from georef.simulate.trajectory import GnssImu, measure
from georef.simulate.world import REFERENCE, StreetWorld, WorldImage, WorldOptions
from georef.types.campaign import Campaign, Image, PositionPrior
from georef.types.constraints import CheckKind, CheckPoint, Mark
from georef.types.features import Features, Matches
from georef.types.results import Localized, ReferenceMatches, ReferenceNoise
from tests.worlds.adjusted import Outcome, adjusted
from tests.worlds.points import loose_cov

QUALITY = ReferenceQuality(absolute_m=0.0)
NOISE = ObservationNoise()
GNSS = GnssImu(drift_length_m=1e-3)  # independent errors: the product does not know of drift
CHECK = SurveyQuality(points=8)
STATIONS, MOST_POINTS = 4, 400


@dataclass(frozen=True, eq=False)
class Place:
    """A street with all that does not depend on noise."""

    world: StreetWorld
    points: NaturalMap
    old: list[WorldImage]
    new: list[WorldImage]

    @cached_property
    def seen_old(self) -> list[Sightings]:
        return sightings(self.world, self.old, self.points, NOISE)

    @cached_property
    def seen_new(self) -> list[Sightings]:
        return sightings(self.world, self.new, self.points, NOISE)

    @cached_property
    def checks(self) -> tuple[Array, Sightings]:
        """Check points (C, 3), well seen by the new images, and their exact marks."""
        candidates = self.points.points_in_world
        scene = self.world.scene("second")
        seen = sight(scene, self.new, candidates, CHECK.reach_m, CHECK.margin_px)
        sigmas = intersection_sigmas(self.new, seen, candidates, CHECK.mark_sigma_px)
        good = np.flatnonzero((seen.count(len(candidates)) >= 3) & (sigmas < 2.0 * CHECK.worst_sigma_m))
        chosen = good[spread_out(candidates[good], CHECK.points)]
        number = np.full(len(candidates), -1)
        number[chosen] = np.arange(len(chosen))
        kept = seen.take(number[seen.point] >= 0)
        return candidates[chosen], Sightings(kept.image, number[kept.point], kept.pixel)


@lru_cache(maxsize=8)
def place(seed: int) -> Place:
    world = StreetWorld(WorldOptions(seed, 40.0, max_stations=STATIONS))
    points = natural_map(world, 2 * MOST_POINTS)
    some = world.rng("some").permutation(len(points.points_in_world))[:MOST_POINTS]
    points = NaturalMap(points.points_in_world[some], points.descriptors[some])
    return Place(world, points, world.images_of(REFERENCE), world.images_of("second"))


@dataclass(frozen=True, eq=False)
class StreetBlock:
    """One draw of all errors of a street: the problem of its new images, and check points to judge the result."""

    place: Place
    problem: Problem
    check: tuple[CheckPoint, ...]
    planted: frozenset[tuple[int, int]]  # (view, keypoint) of blunders in new images
    truth: tuple[Rigid3, ...]  # of the new images, relative to the reference where that is deformed

    def judged(self, found: Outcome) -> Judged:
        """Errors of an adjustment of the problem, beside what it predicts of them."""
        poses = tuple(found.poses)
        cameras = tuple(camera_of(image) for image in self.place.new)
        ids = tuple(image.image_id for image in self.place.new)
        images = PosedImages(ids, cameras, poses, found.joint)
        pairs = [(point, intersect(point, images)) for point in self.check]
        cuts = [(point, cut) for point, cut in pairs if isinstance(cut, Intersection)]
        pose_error = np.concatenate([t.local(p) for t, p in zip(self.truth, poses, strict=True)])
        return _judged(pose_error, found.cov, cuts, len(ids))


@dataclass(frozen=True, eq=False)
class Judged:
    """Errors of all poses and check points, and their joint predicted covariance with its cross terms."""

    error: Array  # (6M + 3C,)
    cov: Array
    poses: int  # 6M

    @property
    def nees(self) -> dict[str, tuple[float, int]]:
        """NEES and degrees of freedom of everything, of the poses, of the check points."""
        pose, point = slice(0, self.poses), slice(self.poses, None)
        parts = {"joint": slice(None), "poses": pose, "points": point}
        return {
            name: (nees(self.error[part], self.cov[part, part]), len(self.error[part])) for name, part in parts.items()
        }


def _judged(pose_error: Array, poses_cov: Array, found: list[tuple[CheckPoint, Intersection]], images: int) -> Judged:
    every = list(range(images))
    by_poses = np.vstack([spread(cut.point_by_poses, cut.images, every) for _, cut in found])
    derivative = np.vstack([np.eye(6 * images), by_poses])
    cov = derivative @ poses_cov @ derivative.T
    for i, (point, cut) in enumerate(found):
        rows = slice(6 * images + 3 * i, 6 * images + 3 * i + 3)
        cov[rows, rows] += cut.mark_cov + point.cov
    differences = np.concatenate([cut.point - point.point_in_world for point, cut in found])
    return Judged(np.concatenate([pose_error, differences]), 0.5 * (cov + cov.T), 6 * images)


def street_block(
    seed: int,
    *,
    streets: int = 3,
    noise: ObservationNoise = NOISE,
    quality: ReferenceQuality = QUALITY,
    stated_poses: float = 1.0,
    config: AdjustConfig | None = None,
) -> StreetBlock:
    """A draw of all errors. stated_poses scales the sigmas of the reference that are declared, not its errors."""
    where = place(seed % streets)
    rng = np.random.default_rng([seed, 5])
    deformation = Deformation.draw(where.world.street.axis, quality, rng)
    given = published([image.world_from_cam for image in where.old], deformation, quality, rng)
    old = [observe(i, s, where.points, noise, rng) for i, s in zip(where.old, where.seen_old, strict=True)]
    new = [observe(i, s, where.points, noise, rng) for i, s in zip(where.new, where.seen_new, strict=True)]
    localized = [_localized(where, i, o, old, rng) for i, o in zip(where.new, new, strict=True)]
    problem = epoch_problem(
        _images(where, rng),
        localized,
        [
            PosedFeatures.of(o.features, camera_of(i), r.world_from_cam)
            for i, o, r in zip(where.new, new, localized, strict=True)
        ],
        [PairMatches(a, b, common(new[a], new[b]).indices) for a, b in combinations(range(len(new)), 2)],
        _reference(where, old, given, stated(noise, quality, stated_poses)),
        (),
        config or AdjustConfig(),
    )
    planted = frozenset((view, int(k)) for view, o in enumerate(new) for k in np.flatnonzero(o.blunder))
    poses = tuple(deformation.moved_pose(image.world_from_cam) for image in where.new)
    return StreetBlock(where, problem, _checks(where, deformation, rng), planted, poses)


def adjusted_block(block: StreetBlock, config: AdjustConfig | None = None) -> Outcome:
    return adjusted(block.problem, config)


def stated(noise: ObservationNoise, quality: ReferenceQuality, factor: float = 1.0) -> ReferenceNoise:
    position, rotation = factor * quality.relative_m, factor * float(np.radians(quality.relative_deg))
    return ReferenceNoise(
        noise.keypoint_sigma, (position, position, position), (rotation, rotation, rotation), "declared"
    )


def common(a: Observed, b: Observed) -> Matches:
    """All keypoints of two images that are of one point, blunders included."""
    _, in_a, in_b = np.intersect1d(a.point, b.point, return_indices=True)
    here = a.point[in_a] >= 0
    pairs = np.column_stack([in_a[here], in_b[here]]).astype(np.int32)
    return Matches(pairs, np.ones(len(pairs), np.float32))


def camera_of(image: WorldImage) -> Camera:
    camera = image.lens.camera
    assert camera is not None
    return camera


def _localized(
    where: Place, image: WorldImage, new: Observed, old: list[Observed], rng: np.random.Generator
) -> Localized:
    """A localization with matches of all references that share at least fifteen points."""
    cov = loose_cov(image.world_from_cam, 0.05, 0.003)
    start = image.world_from_cam.retract(np.linalg.cholesky(cov) @ rng.normal(size=6))
    pairs = [(other.image_id, common(new, seen).indices) for other, seen in zip(where.old, old, strict=True)]
    matches = tuple(ReferenceMatches(name, indices) for name, indices in pairs if len(indices) >= 15)
    everything = np.arange(len(where.points.points_in_world))
    return Localized(image.image_id, start, cov, cov, 100, 1.0, matches, where.points.points_in_world, everything)


def _reference(where: Place, old: list[Observed], given: list[Rigid3], noise: ReferenceNoise) -> ReferenceMap:
    images = tuple(
        Image(i.image_id, Path(i.image_id), camera_of(i), "reference", world_from_cam=pose)
        for i, pose in zip(where.old, given, strict=True)
    )
    index = {image.image_id: k for k, image in enumerate(where.old)}

    def read(image_id: str, count: int | None) -> Features:
        features = old[index[image_id]].features
        return features if count is None else features.head(count)

    return ReferenceMap(Campaign("reference", images), read, noise)


def _images(where: Place, rng: np.random.Generator) -> list[Image]:
    """The new images with their measured positions."""
    measured = measure(where.world.trajectories["second"], GNSS, rng)
    out = []
    for image in where.new:
        centre = (measured.world_from_rigs[image.station] @ image.head.rig_from_cam).translation
        prior = PositionPrior(centre, np.diag(np.square(measured.sigma_m[image.station])))
        out.append(Image(image.image_id, Path(image.image_id), camera_of(image), "second", gnss=prior))
    return out


def _checks(where: Place, deformation: Deformation, rng: np.random.Generator) -> tuple[CheckPoint, ...]:
    exact, seen = where.checks
    positions = deformation.moved(exact) + CHECK.sigma_m * rng.normal(size=exact.shape)
    pixels = seen.pixel + CHECK.mark_sigma_px * rng.normal(size=seen.pixel.shape)
    cov = np.eye(3) * CHECK.sigma_m**2
    out = []
    for i, position in enumerate(positions):
        rows = np.flatnonzero(seen.point == i)
        names = [where.new[seen.image[k]].image_id for k in rows]
        marks = tuple(Mark(name, pixels[k], CHECK.mark_sigma_px) for name, k in zip(names, rows, strict=True))
        out.append(CheckPoint(f"P{i}", CheckKind.ABSOLUTE, position, cov, marks))
    return tuple(out)
