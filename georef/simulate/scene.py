"""One epoch of the street as triangles and light: casting rays, seeing points, colours of surfaces."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from georef.geometry.rigid import Array, Rigid3
from georef.simulate.casting import LIFT_M, SurfaceHits, Surroundings
from georef.simulate.chunks import build_chunk
from georef.simulate.lenses import Lens
from georef.simulate.light import OVERCAST, SUNNY, Light
from georef.simulate.mesh import Mesh, join
from georef.simulate.shading import paint
from georef.simulate.street import CHUNK_M, Epoch, Street

REACH_M = 150.0  # how far around the camera the street is built
_CHUNKS_KEPT, _PLACES_KEPT = 16, 2
_Made = TypeVar("_Made")


@dataclass(frozen=True, eq=False)
class Hits:
    """Of N rays: distance_m, inf where nothing is hit; surface_id and item_number, -1 there; normal towards the ray."""

    distance_m: Array
    surface_id: NDArray[np.int32]
    normal: Array
    item_number: NDArray[np.int32]
    colour: Array | None = None


@dataclass(frozen=True, eq=False)
class NaturalPoints:
    """Distinctive points (Q, 3) of one epoch, with normals; equal point_ids (Q,) mean the same point."""

    points_in_world: Array
    normal: Array
    in_both_epochs: NDArray[np.bool_]
    point_ids: NDArray[np.int64]


class Scene:
    """One epoch of a street. Triangles are built piece by piece, around where they are asked for."""

    def __init__(self, street: Street, epoch: Epoch) -> None:
        self.street = street
        self.epoch: Epoch = epoch
        self.light: Light = OVERCAST if epoch == "second" and street.amount("light") > 0 else SUNNY
        self._centres = street.axis.at((np.array(list(street.chunks)) + 0.5) * CHUNK_M)
        self._chunk: Callable[[int], Mesh] = lru_cache(_CHUNKS_KEPT)(self._build_chunk)
        self._place: Callable[[frozenset[int]], Surroundings] = lru_cache(_PLACES_KEPT)(self._build_place)

    def _build_chunk(self, key: int) -> Mesh:
        return build_chunk(self.street, self.street.chunks[key], self.epoch)

    def _build_place(self, keys: frozenset[int]) -> Surroundings:
        order = sorted(keys)
        numbers = list(self.street.chunks)
        middle = np.mean([self._centres[numbers.index(key)] for key in order], axis=0)
        return Surroundings.of(join([self._chunk(key) for key in order]), middle)

    def around(self, position: ArrayLike) -> Surroundings:
        """What stands around a position (3,) in world."""
        nearest = self._nearest(np.asarray(position, np.float64)[None])[0]
        return self._at_chunk(int(nearest))

    def _nearest(self, positions: Array) -> NDArray[np.intp]:
        apart = np.linalg.norm(positions[:, None, :2] - self._centres[None, :, :2], axis=-1)
        return np.argmin(apart, axis=1)

    def _at_chunk(self, nearest: int) -> Surroundings:
        apart = np.linalg.norm(self._centres[:, :2] - self._centres[nearest, :2], axis=1)
        numbers = np.array(list(self.street.chunks))
        return self._place(frozenset(numbers[apart < REACH_M].tolist()))

    def cast(
        self, origins: ArrayLike, directions: ArrayLike, with_colour: bool = False, footprint_m: float = 0.01
    ) -> Hits:
        """First hits of rays from origins (N, 3) or (1, 3) along unit directions (N, 3)."""
        ways = np.atleast_2d(np.asarray(directions, np.float64))
        starts = np.broadcast_to(np.atleast_2d(np.asarray(origins, np.float64)), ways.shape)
        count, colour = len(ways), np.zeros((len(ways), 3)) if with_colour else None
        out = Hits(
            np.full(count, np.inf),
            np.full(count, -1, np.int32),
            np.zeros((count, 3)),
            np.full(count, -1, np.int32),
            colour,
        )
        nearest = self._nearest(starts)
        for chunk in np.unique(nearest):
            chosen = nearest == chunk
            place = self._at_chunk(int(chunk))
            hits = place.hits(starts[chosen], ways[chosen])
            out.distance_m[chosen], out.normal[chosen] = hits.distance_m, hits.normal
            out.surface_id[chosen] = hits.surface
            out.item_number[chosen] = np.where(hits.surface >= 0, place.mesh.item[hits.surface], -1)
            if colour is not None:
                colour[chosen] = self.albedo(place, hits, np.full(len(hits.surface), footprint_m), ways[chosen])
        return out

    def albedo(
        self,
        place: Surroundings,
        hits: SurfaceHits,
        footprint_m: Array,
        directions: ArrayLike,
        wanted: NDArray[np.bool_] | None = None,
    ) -> NDArray[np.float32]:
        """Linear albedo (N, 3) of hits (all, or the wanted), averaged over a footprint (N,) across the rays."""
        mesh, out = place.mesh, np.zeros((len(hits.surface), 3), np.float32)
        cosine = np.abs(np.einsum("ij,ij->i", hits.normal, np.asarray(directions)))
        looks = (mesh.material, mesh.seed, mesh.colour, mesh.values)
        surface = hits.surface if wanted is None else np.where(wanted, hits.surface, -1).astype(np.int32)
        paint(surface, hits.uv_m, hits.stretch, footprint_m, cosine, *looks, self.light.damp, out)
        return out

    def colour(self, points: ArrayLike, normal: ArrayLike, footprint_m: float = 0.01) -> Array:
        """Linear albedo (N, 3) of the surface at points (N, 3) on it, seen along its normal (N, 3)."""
        outward = np.asarray(normal, np.float64)
        starts = np.asarray(points, np.float64) + 0.01 * outward
        colour = self.cast(starts, -outward, with_colour=True, footprint_m=footprint_m).colour
        assert colour is not None
        return colour

    def natural_points(self) -> NaturalPoints:
        """Corners of windows, signs, markings and the like along the whole street."""
        meshes = [self._chunk(key) for key in self.street.chunks]
        ids = np.concatenate([mesh.point_ids for mesh in meshes])
        same = {item.number: item.versions[0] == item.versions[1] for item in self.street.items}
        return NaturalPoints(
            np.concatenate([mesh.points_in_world for mesh in meshes]),
            np.concatenate([mesh.point_normals for mesh in meshes]),
            np.array([same[number] for number in (ids // 4096).tolist()], dtype=bool),
            ids,
        )

    def visible(
        self, points: ArrayLike, world_from_cam: Rigid3, lens: Lens, tolerance_m: float = 0.02
    ) -> tuple[Array, NDArray[np.bool_]]:
        """Pixels (N, 2) of points (N, 3), NaN outside the picture, and whether (N,) each is seen unoccluded."""
        targets = np.atleast_2d(np.asarray(points, np.float64))
        pixels = lens.project(world_from_cam.inverse().apply(targets))
        seen = np.isfinite(pixels[:, 0])
        offset = targets[seen] - world_from_cam.translation
        distance = np.linalg.norm(offset, axis=1)
        near = distance < REACH_M
        seen[seen] = near
        offset, distance = offset[near], distance[near]
        if len(offset):
            hits = self.around(world_from_cam.translation).hits(world_from_cam.translation, offset / distance[:, None])
            seen[seen] = hits.distance_m > distance - tolerance_m
        return pixels, seen

    def in_sun(self, place: Surroundings, points: Array, normal: Array) -> NDArray[np.bool_]:
        """Whether the sun reaches points (N, 3) of surfaces with these normals (N, 3)."""
        sun = np.array(self.light.sun_direction)
        lit = normal @ sun > 0 if self.light.has_sun else np.zeros(len(points), dtype=bool)
        starts = points[lit] + LIFT_M * normal[lit]
        if len(starts):
            lit[lit] = ~place.blocked(starts, np.broadcast_to(sun, starts.shape))
        return lit


def build_scene(street: Street, epoch: Epoch) -> Scene:
    """One epoch of a street, to be looked at."""
    return Scene(street, epoch)
