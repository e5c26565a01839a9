"""The street without rendering: natural points as features of the images that see them, with chosen noise.

Keypoints are exact projections plus noise in proportion to their scale; the views of one point share a descriptor,
with a little noise, so that matchers work for real. Blunders keep the descriptor of their point and stand elsewhere.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from georef.geometry.rigid import Array
from georef.simulate.survey import Sightings, sight
from georef.simulate.world import REFERENCE, StreetWorld, WorldImage
from georef.types.features import Features

_DIMENSION, _DESCRIPTOR_NOISE = 64, 0.04
_SCALES_PX = np.array([1.0, 1.5, 2.5])
_FARTHEST_BLUNDER = 3.0  # factor e^x on the nearest
_NOBODYS = -1
_FARTHEST_M = 40.0  # of points on surfaces
_MOVING_KINDS = ("tree", "hedge")  # leaves stay nowhere


@dataclass(frozen=True)
class ObservationNoise:
    """How features differ from exact projections."""

    keypoint_sigma: float = 0.4  # px at scale 1
    detected: float = 0.85  # share of the visible points that an image has a feature of
    blunders: float = 0.0  # share of its features that stand elsewhere
    nearest_blunder_px: float = 25.0
    clutter: int = 0  # features of an image that no point belongs to
    reach_m: float = 50.0


@dataclass(frozen=True, eq=False)
class NaturalMap:
    """All natural points of an epoch, with the descriptors that their views share."""

    points_in_world: Array  # (Q, 3)
    descriptors: NDArray[np.float32]  # (Q, D) unit vectors


@dataclass(frozen=True, eq=False)
class Observed:
    """Features of an image, and which natural point each is of (-1: none)."""

    features: Features
    point: NDArray[np.int64]  # (N,)
    blunder: NDArray[np.bool_]  # (N,)


def natural_map(world: StreetWorld, texture_points: int = 1500) -> NaturalMap:
    """Points that both epochs have: natural ones, and others on surfaces that the first drive sees."""
    natural = world.scene("first").natural_points()
    points = np.vstack([natural.points_in_world[natural.in_both_epochs], surface_points(world, texture_points)])
    return NaturalMap(points, _unit(world.rng("descriptors").normal(size=(len(points), _DIMENSION))))


def surface_points(world: StreetWorld, count: int) -> Array:
    """Up to `count` points (N, 3) where rays of the reference images meet things that are the same in both epochs."""
    rng, images = world.rng("surface"), world.images_of(REFERENCE)
    steady = [i.number for i in world.street.items if i.versions[0] == i.versions[1] and i.kind not in _MOVING_KINDS]
    found = []
    for image, share in zip(images, np.array_split(np.arange(count), len(images)), strict=True):
        pixels = rng.uniform(0.0, 1.0, (len(share), 2)) * [image.lens.width, image.lens.height]
        directions = image.lens.rays(pixels) @ image.world_from_cam.rotation.T
        hits = world.scene("first").cast(image.world_from_cam.translation, directions)
        kept = (hits.distance_m < _FARTHEST_M) & np.isin(hits.item_number, steady)
        found.append(image.world_from_cam.translation + hits.distance_m[kept, None] * directions[kept])
    return np.concatenate(found)


def sightings(
    world: StreetWorld, images: Sequence[WorldImage], points: NaturalMap, noise: ObservationNoise
) -> list[Sightings]:
    """Exact pixels of the points that each image sees; the same for every draw of noise."""
    return [
        sight(world.scene(image.epoch), [image], points.points_in_world, noise.reach_m, margin_px=4.0)
        for image in images
    ]


def observe(
    image: WorldImage, seen: Sightings, points: NaturalMap, noise: ObservationNoise, rng: np.random.Generator
) -> Observed:
    """A draw of an image's features."""
    here = rng.random(len(seen.point)) < noise.detected
    point, pixel = seen.point[here], seen.pixel[here]
    scale = rng.choice(_SCALES_PX, len(point) + noise.clutter)
    size = np.array([image.lens.width, image.lens.height], dtype=np.float64)
    keypoints = np.concatenate([pixel, rng.uniform(0.0, 1.0, (noise.clutter, 2)) * size])
    keypoints[: len(point)] += noise.keypoint_sigma * scale[: len(point), None] * rng.normal(size=(len(point), 2))
    blunder = np.zeros(len(keypoints), bool)
    blunder[: len(point)] = rng.random(len(point)) < noise.blunders
    away = noise.nearest_blunder_px * np.exp(rng.uniform(0.0, _FARTHEST_BLUNDER, int(blunder.sum())))
    angle = rng.uniform(0.0, 2.0 * np.pi, len(away))
    keypoints[blunder] += np.column_stack([np.cos(angle), np.sin(angle)]) * away[:, None]
    strange = _unit(rng.normal(size=(noise.clutter, _DIMENSION)))
    descriptors = np.concatenate([points.descriptors[point], strange])
    descriptors = _unit(descriptors + _DESCRIPTOR_NOISE * rng.normal(size=descriptors.shape))
    order = rng.permutation(len(keypoints))  # features are sorted by score, which says nothing here
    features = Features(
        (image.lens.width, image.lens.height),
        keypoints[order].astype(np.float32),
        np.linspace(1.0, 0.1, len(order), dtype=np.float32),
        scale[order].astype(np.float32),
        descriptors[order],
        np.zeros((len(order), 3), np.uint8),
    )
    point = np.concatenate([point, np.full(noise.clutter, _NOBODYS)])
    return Observed(features, point[order], blunder[order])


def _unit(vectors: Array) -> NDArray[np.float32]:
    return (vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)).astype(np.float32)
