"""Points on facades, on the road and on poles, and the images of a drive that each is found in.

A point is where a ray through a random pixel of some image meets the city. It is looked for in 3 to 6 stations around,
and in stations of other streets and of later passages near by; of the images that see it 4 to 8 are kept.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from georef.geometry.camera import Camera, rays_from_pixels
from georef.geometry.poses import Poses
from georef.geometry.projection import Views
from georef.geometry.rigid import Array
from georef.simulate.axis import SLOPE_EAST, SLOPE_NORTH, ground_height
from georef.simulate.drive_city import REACH_M, Route

_CHUNK = 20_000  # points looked at together
_NEAREST_M, _GROUND_REACH_M, _LINK_REACH_M = 3.0, 35.0, 60.0
_GROUND_KEPT, _POLES = 0.5, 0.1
_RELIEF_M = 0.15
_WINDOW, _LINKED, _LINKS, _LINK_STATIONS = (4, 6), 0.3, 3, 2
_RAYS, _FEWEST_RAYS = (4, 8), 3
_ANOTHER_PASSAGE = 12  # stations on
_LINKABLE = 32  # stations remembered of each


@dataclass(frozen=True, eq=False)
class Tracks:
    """P points with n exact observations, in the order of the points, which is that of their anchors."""

    points: Array  # (P, 3) in world
    anchor: NDArray[np.int64]  # (P,) station that a point was first seen from
    point: NDArray[np.int64]  # (n,)
    image: NDArray[np.int64]  # (n,)
    pixel: Array  # (n, 2)


@dataclass(frozen=True, eq=False)
class _Survey:
    """The images of a drive: image station * C + camera."""

    route: Route
    rig_from_cam: Poses
    cameras: tuple[Camera, ...]
    world_from_cam: Poses
    views: Views
    linkable: NDArray[np.int64]  # (S, K) stations near by of other passages; -1: none


def draw_tracks(
    route: Route,
    rig_from_cam: Poses,
    cameras: tuple[Camera, ...],
    observations: int,
    rng: np.random.Generator,
) -> Tracks:
    """Whole tracks until there are so many observations, or up to 7 more."""
    survey = _survey(route, rig_from_cam, cameras, rng)
    count, parts, missing = len(survey.world_from_cam), [], observations
    anchors = np.zeros(0, np.int64)
    while missing > 0:
        if len(anchors) < _CHUNK:
            anchors = np.concatenate([anchors, rng.permutation(count)])
        part = _chunk(survey, anchors[:_CHUNK], rng)
        anchors = anchors[_CHUNK:]
        if len(part.point) > missing:
            ends = np.cumsum(np.bincount(part.point, minlength=len(part.points)))
            part = _first(part, int(np.searchsorted(ends, missing)) + 1)
        parts.append(part)
        missing -= len(part.point)
    return _joined(parts)


def _survey(route: Route, rig_from_cam: Poses, cameras: tuple[Camera, ...], rng: np.random.Generator) -> _Survey:
    stations, heads = len(route.s_m), len(cameras)
    station, camera = np.repeat(np.arange(stations), heads), np.tile(np.arange(heads), stations)
    poses = route.world_from_rig.take(station) @ rig_from_cam.take(camera)
    inverse, lenses = poses.inverse(), Views.of([], cameras)
    views = Views(inverse.rotation, inverse.translation, lenses.model[camera], lenses.parameters[camera])
    return _Survey(route, rig_from_cam, cameras, poses, views, _linkable(route, rng))


def _linkable(route: Route, rng: np.random.Generator) -> NDArray[np.int64]:
    places = route.world_from_rig.translation[:, :2]
    out = np.full((len(places), _LINKABLE), -1, np.int64)
    for station, near in enumerate(KDTree(places).query_ball_point(places, _LINK_REACH_M)):
        others = np.array([n for n in near if abs(n - station) > _ANOTHER_PASSAGE], dtype=np.int64)
        if len(others):
            closeness = 1.0 / (5.0 + np.linalg.norm(places[others] - places[station], axis=1))
            out[station] = rng.choice(others, _LINKABLE, p=closeness / closeness.sum())
    return out


def _chunk(survey: _Survey, anchors: NDArray[np.int64], rng: np.random.Generator) -> Tracks:
    """Tracks that start in images (N,); rays that meet nothing, and points that too few images see, are dropped."""
    points, met = _points(survey, anchors, rng)
    points, anchors = points[met], anchors[met] // len(survey.cameras)
    point, image = _candidates(survey, points, _slots(survey, anchors, rng))
    point, image = _thinned(point, image, anchors, len(survey.cameras), len(points), rng)
    pixel = survey.views.project(image, points[point])
    sizes = np.array([(c.width, c.height) for c in survey.cameras], dtype=np.float64)[image % len(survey.cameras)]
    with np.errstate(invalid="ignore"):
        shown = np.all((pixel > 1.0) & (pixel < sizes - 1.0), axis=1)
    point, image, pixel = point[shown], image[shown], pixel[shown]
    station = image // len(survey.cameras)
    first, last = np.full(len(points), len(survey.route.s_m)), np.full(len(points), -1)
    np.minimum.at(first, point, station)
    np.maximum.at(last, point, station)
    good = (np.bincount(point, minlength=len(points)) >= _FEWEST_RAYS) & (last > first)
    kept = good[point]
    renumbered = np.cumsum(good) - 1
    return Tracks(points[good], anchors[good], renumbered[point[kept]], image[kept], pixel[kept])


def _points(survey: _Survey, anchors: NDArray[np.int64], rng: np.random.Generator) -> tuple[Array, NDArray[np.bool_]]:
    """Where rays through random pixels of images (N,) meet something (N, 3), and whether they do so within reach."""
    directions = np.empty((len(anchors), 3))
    for index, camera in enumerate(survey.cameras):
        here = anchors % len(survey.cameras) == index
        pixels = rng.uniform(0.02, 0.98, (int(here.sum()), 2)) * [camera.width, camera.height]
        rays = np.nan_to_num(rays_from_pixels(camera, pixels), nan=0.0)
        directions[here] = rays / np.maximum(np.linalg.norm(rays, axis=1), 1e-9)[:, None]
    directions = np.einsum("nij,nj->ni", survey.world_from_cam.rotation[anchors], directions)
    origins = survey.world_from_cam.translation[anchors]
    level = np.maximum(np.linalg.norm(directions[:, :2], axis=1), 1e-9)
    facade, height = survey.route.city.first_facade(origins[:, :2], directions[:, :2] / level[:, None])
    facade = facade / level
    normal = np.array([-SLOPE_EAST, -SLOPE_NORTH, 1.0])
    falling = directions @ normal
    ground = np.where(falling < -1e-6, -(origins @ normal) / np.minimum(falling, -1e-6), np.inf)
    on_ground = ground < facade
    pole = ~on_ground & (rng.random(len(anchors)) < _POLES)
    distance = np.where(on_ground, ground, facade - np.abs(_RELIEF_M * rng.normal(size=len(anchors))))
    distance = np.where(pole, rng.uniform(0.3, 1.0, len(anchors)) * distance, distance)
    points = origins + np.where(np.isfinite(distance), distance, 0.0)[:, None] * directions
    above = points[:, 2] - ground_height(points[:, 0], points[:, 1])
    kept = np.where(on_ground, rng.random(len(anchors)) < _GROUND_KEPT, above < height)
    return points, kept & (distance > _NEAREST_M) & (distance < np.where(on_ground, _GROUND_REACH_M, REACH_M))


def _slots(survey: _Survey, anchors: NDArray[np.int64], rng: np.random.Generator) -> NDArray[np.int64]:
    """Stations (N, K) in which points of anchor stations (N,) are looked for; -1: none."""
    stations, n = len(survey.route.s_m), len(anchors)
    width = rng.integers(_WINDOW[0], _WINDOW[1] + 1, n)
    start = anchors - np.floor(rng.random(n) * width).astype(np.int64)
    steps = np.arange(_WINDOW[1])
    window = np.where(steps < width[:, None], start[:, None] + steps, -1)
    linked = survey.linkable[anchors[:, None], rng.integers(0, _LINKABLE, (n, _LINKS))]
    linked = np.where(rng.random(n)[:, None] < _LINKED, linked, -1)
    following = np.where(linked[:, :, None] < 0, -1, linked[:, :, None] + np.arange(_LINK_STATIONS)).reshape(n, -1)
    slots = np.concatenate([window, following], axis=1)
    return np.where(slots < stations, slots, -1)


def _candidates(
    survey: _Survey, points: Array, slots: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """All pairs of a point and an image of its slots that has it about in view, with nothing in between; each once."""
    point, column = np.nonzero(slots >= 0)
    station = slots[point, column]
    poses = survey.route.world_from_rig
    near = np.linalg.norm(points[point] - poses.translation[station], axis=1) < REACH_M
    point, station = point[near], station[near]
    seen = survey.route.city.sees(poses.translation[station], points[point])
    point, station = point[seen], station[seen]
    in_rig = np.einsum("nji,nj->ni", poses.rotation[station], points[point] - poses.translation[station])
    found_point, found_image = [], []
    for index, camera in enumerate(survey.cameras):
        in_cam = (in_rig - survey.rig_from_cam.translation[index]) @ survey.rig_from_cam.rotation[index]
        far = np.linalg.norm(in_cam, axis=1)
        shown = (in_cam[:, 2] > np.cos(camera.half_view_angle_rad) * far) & (far > 0.8 * _NEAREST_M)
        found_point.append(point[shown])
        found_image.append(station[shown] * len(survey.cameras) + index)
    images = len(survey.world_from_cam)
    once = np.unique(np.concatenate(found_point) * images + np.concatenate(found_image))
    return once // images, once % images


def _thinned(
    point: NDArray[np.int64],
    image: NDArray[np.int64],
    anchors: NDArray[np.int64],
    heads: int,
    points: int,
    rng: np.random.Generator,
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """At most 4 to 8 images a point, those of other passages rather than others."""
    away = np.abs(image // heads - anchors[point]) > _ANOTHER_PASSAGE
    urgency = rng.random(len(point)) - np.where(away, 0.3, 0.0)
    order = np.lexsort((urgency, point))
    starts = np.concatenate([[0], np.cumsum(np.bincount(point, minlength=points))])[:-1]
    rank = np.empty(len(point), np.int64)
    rank[order] = np.arange(len(point)) - starts[point[order]]
    kept = rank < rng.integers(_RAYS[0], _RAYS[1] + 1, points)[point]
    return point[kept], image[kept]


def _first(part: Tracks, points: int) -> Tracks:
    kept = part.point < points
    return Tracks(part.points[:points], part.anchor[:points], part.point[kept], part.image[kept], part.pixel[kept])


def _joined(parts: list[Tracks]) -> Tracks:
    """All tracks in the order of their anchors."""
    before = np.cumsum([0, *(len(part.points) for part in parts)])
    points, anchor = np.concatenate([p.points for p in parts]), np.concatenate([p.anchor for p in parts])
    point = np.concatenate([p.point + start for p, start in zip(parts, before[:-1], strict=True)])
    image, pixel = np.concatenate([p.image for p in parts]), np.concatenate([p.pixel for p in parts])
    order = np.argsort(anchor, kind="stable")
    place = np.empty(len(order), np.int64)
    place[order] = np.arange(len(order))
    rows = np.argsort(place[point], kind="stable")
    return Tracks(points[order], anchor[order], place[point[rows]], image[rows], pixel[rows])
