"""What surveyors measured in the street: control and check points with marks, and the natural tie points of the truth.

Coordinates of an absolute point are exact plus survey noise. Those of a relative point are what the reference says of
it: intersected from marks in the reference images at their published poses, so that it shares their errors, the smooth
and the small ones. New images adjusted to the reference are judged by relative points without those errors, and by
absolute points with them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from georef.geometry.rigid import Array, Rigid3
from georef.simulate.scene import Scene
from georef.simulate.world import REFERENCE, StreetWorld, WorldImage
from georef.types.constraints import CheckKind

_LEAST_IMAGES = 3
_CONTROL_EVERY = 6
Indices = NDArray[np.int64]


@dataclass(frozen=True)
class SurveyQuality:
    """How well points are surveyed and marked, and how many."""

    points: int = 48
    tie_points: int = 200
    sigma_m: float = 0.005
    mark_sigma_px: float = 0.3
    reach_m: float = 35.0  # from which a point is still marked
    margin_px: float = 8.0
    worst_sigma_m: float = 0.012  # of a point from its marks, along its worst direction


@dataclass(frozen=True, eq=False)
class Sightings:
    """Which point (of some list) is seen where in which image (of some list): exact observed pixels."""

    image: Indices  # (n,)
    point: Indices  # (n,)
    pixel: Array  # (n, 2)

    def take(self, keep: NDArray[np.bool_]) -> Sightings:
        return Sightings(self.image[keep], self.point[keep], self.pixel[keep])

    def count(self, points: int) -> Indices:
        """In how many images each of the points is seen."""
        return np.bincount(self.point, minlength=points)


@dataclass(frozen=True, eq=False)
class SurveyedPoint:
    """A control or check point: what its table says and what is true."""

    point_id: str
    role: Literal["control", "check"]
    kind: CheckKind
    given: Array  # (3,) in world
    exact: Array  # (3,)
    sigma_m: float


@dataclass(frozen=True, eq=False)
class SurveyMark:
    point_id: str
    image_id: str
    pixel: Array  # (2,)
    sigma_px: float


@dataclass(frozen=True, eq=False)
class TiePoint:
    """A natural point that images of both epochs show, with its exact pixel in each."""

    point_id: str
    point_in_world: Array  # (3,)
    pixels: dict[str, Array]  # image id -> (2,)


def sight(scene: Scene, images: Sequence[WorldImage], points: Array, reach_m: float, margin_px: float) -> Sightings:
    """Where images see points (Q, 3): in the picture, within reach, not hidden."""
    found: list[tuple[Indices, Indices, Array]] = []
    for index, image in enumerate(images):
        near = np.flatnonzero(np.linalg.norm(points - image.world_from_cam.translation, axis=1) < reach_m)
        if not len(near):
            continue
        pixels, visible = scene.visible(points[near], image.world_from_cam, image.lens)
        limit = np.array([image.lens.width, image.lens.height]) - margin_px
        with np.errstate(invalid="ignore"):
            inside = visible & ((pixels > margin_px) & (pixels < limit)).all(axis=1)
        found.append((np.full(int(inside.sum()), index), near[inside], pixels[inside]))
    if not found:
        return Sightings(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 2)))
    return Sightings(*(np.concatenate(part) for part in zip(*found, strict=True)))


def intersection_sigmas(images: Sequence[WorldImage], seen: Sightings, points: Array, sigma_px: float) -> Array:
    """1-sigma (Q,), metres, of points (Q, 3) from their sightings, along the worst direction; inf: not determined."""
    centres = np.array([image.world_from_cam.translation for image in images]).reshape(-1, 3)
    angles = np.array([image.lens.pixel_angle_rad for image in images])
    ray = points[seen.point] - centres[seen.image]
    distance = np.linalg.norm(ray, axis=1)
    ray /= distance[:, None]
    across = np.eye(3) - ray[:, :, None] * ray[:, None, :]
    weight = 1.0 / np.square(sigma_px * angles[seen.image] * distance)
    normal = np.zeros((len(points), 3, 3))
    np.add.at(normal, seen.point, across * weight[:, None, None])
    least = np.linalg.eigvalsh(normal)[:, 0] if len(points) else np.zeros(0)
    return np.where(least > 1.0, 1.0 / np.sqrt(np.maximum(least, 1e-12)), np.inf)


def spread_out(points: Array, count: int) -> Indices:
    """Indices of `count` of the points (Q, 3), each the farthest from those before it."""
    if not len(points):
        return np.zeros(0, np.int64)
    chosen = [int(np.argmin(points @ [1.0, 1.0, 0.3]))]
    distance = np.linalg.norm(points - points[chosen[0]], axis=1)
    while len(chosen) < min(count, len(points)):
        chosen.append(int(np.argmax(distance)))
        distance = np.minimum(distance, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return np.array(chosen)


@dataclass(frozen=True, eq=False)
class PointSurvey:
    points: tuple[SurveyedPoint, ...]
    marks: tuple[SurveyMark, ...]
    ties: tuple[TiePoint, ...]


def survey_points(world: StreetWorld, quality: SurveyQuality | None = None) -> PointSurvey:
    """Control and check points with their marks in the images of the campaign `second`, and tie points."""
    quality = quality or SurveyQuality()
    natural = world.scene("second").natural_points()
    points = natural.points_in_world[natural.in_both_epochs]
    new, old = world.images_of("second"), world.images_of(REFERENCE)
    in_new = sight(world.scene("second"), new, points, quality.reach_m, quality.margin_px)
    sigmas = intersection_sigmas(new, in_new, points, quality.mark_sigma_px)
    good = np.flatnonzero((in_new.count(len(points)) >= _LEAST_IMAGES) & (sigmas < quality.worst_sigma_m))
    chosen = good[spread_out(points[good], quality.points)]
    in_old = sight(world.scene("first"), old, points, quality.reach_m, quality.margin_px)
    surveyed = _surveyed(world, points[chosen], old, _chosen(in_old, chosen, len(points)), quality)
    marks = _marks(world, new, in_new, chosen, surveyed, quality)
    both = (in_new.count(len(points)) >= 2) & (in_old.count(len(points)) >= 2)
    tied = np.flatnonzero(both)[spread_out(points[both], quality.tie_points)]
    return PointSurvey(surveyed, marks, _ties(points, tied, ((old, in_old), (new, in_new))))


def intersected(images: Sequence[WorldImage], poses: Sequence[Rigid3], seen: Sightings, near: Array) -> Array:
    """Points (Q, 3) by least squares from their sightings in images at given poses; near: rough positions (Q, 3)."""
    rotations, centres = np.array([p.rotation for p in poses]), np.array([p.translation for p in poses])
    ray = np.empty((len(seen.point), 3))
    for index, image in enumerate(images):
        here = seen.image == index
        ray[here] = image.lens.rays(seen.pixel[here]) @ rotations[index].T
    angles = np.array([image.lens.pixel_angle_rad for image in images])[seen.image]
    distance = np.linalg.norm(near[seen.point] - centres[seen.image], axis=1)
    across = (np.eye(3) - ray[:, :, None] * ray[:, None, :]) / np.square(angles * distance)[:, None, None]
    normal, right = np.zeros((len(near), 3, 3)), np.zeros((len(near), 3))
    np.add.at(normal, seen.point, across)
    np.add.at(right, seen.point, np.einsum("nij,nj->ni", across, centres[seen.image]))
    known = seen.count(len(near)) >= 2
    out = np.full((len(near), 3), np.nan)
    out[known] = np.linalg.solve(normal[known], right[known][..., None])[..., 0]
    return out


def _surveyed(
    world: StreetWorld, exact: Array, old: Sequence[WorldImage], in_old: Sightings, quality: SurveyQuality
) -> tuple[SurveyedPoint, ...]:
    """Every sixth is control; check points are absolute and relative in turn where the reference shows them well."""
    rng = world.rng("points")
    noise = quality.sigma_m * rng.normal(size=(len(exact), 3))
    marked = Sightings(
        in_old.image, in_old.point, in_old.pixel + quality.mark_sigma_px * rng.normal(size=in_old.pixel.shape)
    )
    poses = [world.published_poses[image.image_id] for image in old]
    relative = intersected(old, poses, marked, exact)
    sigmas = np.hypot(
        intersection_sigmas(old, in_old, exact, quality.mark_sigma_px), world.options.reference.relative_m
    )
    shown = (in_old.count(len(exact)) >= _LEAST_IMAGES) & (sigmas < 2.0 * quality.worst_sigma_m)
    out = []
    for i, point in enumerate(exact):
        control = i % _CONTROL_EVERY == 0
        kind = CheckKind.ABSOLUTE if control or i % 2 or not shown[i] else CheckKind.RELATIVE
        given, sigma = (point + noise[i], quality.sigma_m) if kind is CheckKind.ABSOLUTE else (relative[i], sigmas[i])
        name = f"{'C' if control else kind.value[0].upper()}{i + 1:03d}"
        role = "control" if control else "check"
        out.append(SurveyedPoint(name, role, kind, given, point, round(float(sigma), 4)))
    return tuple(out)


def _chosen(seen: Sightings, chosen: Indices, points: int) -> Sightings:
    """Only the sightings of chosen points, numbered in their order."""
    number = np.full(points, -1)
    number[chosen] = np.arange(len(chosen))
    kept = seen.take(number[seen.point] >= 0)
    return Sightings(kept.image, number[kept.point], kept.pixel)


def _marks(
    world: StreetWorld,
    images: Sequence[WorldImage],
    seen: Sightings,
    chosen: Indices,
    surveyed: Sequence[SurveyedPoint],
    quality: SurveyQuality,
) -> tuple[SurveyMark, ...]:
    rng = world.rng("marks")
    out = []
    for row, point in zip(chosen, surveyed, strict=True):
        for k in np.flatnonzero(seen.point == row):
            pixel = seen.pixel[k] + quality.mark_sigma_px * rng.normal(size=2)
            out.append(SurveyMark(point.point_id, images[seen.image[k]].image_id, pixel, quality.mark_sigma_px))
    return tuple(out)


def _ties(
    points: Array, tied: Indices, views: Sequence[tuple[Sequence[WorldImage], Sightings]]
) -> tuple[TiePoint, ...]:
    out = []
    for number, row in enumerate(tied):
        pixels = {
            images[seen.image[k]].image_id: seen.pixel[k]
            for images, seen in views
            for k in np.flatnonzero(seen.point == row)
        }
        out.append(TiePoint(f"T{number + 1:04d}", points[row], pixels))
    return tuple(out)
