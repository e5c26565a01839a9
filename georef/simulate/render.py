"""Renders what a camera sees: one ray a pixel, four where surfaces meet, textures filtered by the pixel's footprint."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from georef.geometry.rigid import Array, Rigid3
from georef.simulate.casting import LIFT_M, SurfaceHits, Surroundings
from georef.simulate.lenses import Lens, ray_grid
from georef.simulate.light import SKY_SAMPLES, sky_directions, sky_radiance, sky_share
from georef.simulate.materials import LEAF
from georef.simulate.photography import Photography, develop
from georef.simulate.scene import Scene
from georef.simulate.shading import find_edges, illuminate, spread_sky

__all__ = ["Photography", "linear_light", "render"]

Pixels = NDArray[np.floating]
_SKY_STEP_PX = 8
_SUBPIXELS = ((-0.125, -0.375), (0.375, -0.125), (-0.375, 0.125), (0.125, 0.375))
_BLUR_POSES = 5


def render(scene: Scene, lens: Lens, world_from_cam: Rigid3, photography: Photography) -> NDArray[np.uint8]:
    """The picture (H, W, 3), RGB."""
    way = np.array(photography.motion_blur_m)
    if not way.any():
        return develop(linear_light(scene, lens, world_from_cam), photography)
    shares = np.linspace(-0.5, 0.5, _BLUR_POSES)
    poses = [Rigid3(world_from_cam.rotation, world_from_cam.translation + share * way) for share in shares]
    light = sum(linear_light(scene, lens, pose) for pose in poses)
    return develop(np.asarray(light, np.float32) / np.float32(_BLUR_POSES), photography)


def linear_light(scene: Scene, lens: Lens, world_from_cam: Rigid3, supersample: bool = True) -> NDArray[np.float32]:
    """Linear light (H, W, 3) before the camera's own doings."""
    view = _View(scene, scene.around(world_from_cam.translation), lens, world_from_cam)
    grid = ray_grid(lens)
    x, y = np.meshgrid(np.arange(lens.width) + 0.5, np.arange(lens.height) + 0.5)
    directions = view.turn(grid.reshape(-1, 3))
    hits = view.place.hits(view.centre[None], directions)
    sky = view.coarse_sky(hits, directions)
    shaded = view.shade(x.ravel(), y.ravel(), directions, hits, sky, None)
    picture = shaded.light.reshape(lens.height, lens.width, 3)
    if supersample:
        _refine(view, picture, grid, directions, hits, shaded, sky)
    return picture


@dataclass(frozen=True, eq=False)
class _Sky:
    """How much sky is seen, on a coarse grid of the picture."""

    distance_m: Array
    normal: Array
    share: Array


@dataclass(frozen=True, eq=False)
class _Shaded:
    """Of N rays: linear light, surface, its albedo, and whether the sun reaches it."""

    light: NDArray[np.float32]
    surface: NDArray[np.int32]
    albedo: NDArray[np.float32]
    lit: NDArray[np.bool_]

    def of(self, index: NDArray[np.intp]) -> _Shaded:
        return _Shaded(self.light[index], self.surface[index], self.albedo[index], self.lit[index])


_Known = _Shaded | None


@dataclass(frozen=True, eq=False)
class _View:
    scene: Scene
    place: Surroundings
    lens: Lens
    world_from_cam: Rigid3

    @property
    def centre(self) -> Array:
        return self.world_from_cam.translation

    def turn(self, rays_in_cam: NDArray[np.float32]) -> NDArray[np.float32]:
        return rays_in_cam @ self.world_from_cam.rotation.T.astype(np.float32)

    def coarse_sky(self, hits: SurfaceHits, directions: NDArray[np.float32]) -> _Sky:
        """The sky share of every eighth pixel of every eighth row, by rays towards the sky."""
        rows, columns = self.lens.height, self.lens.width
        index = np.arange(rows * columns).reshape(rows, columns)
        half = min(_SKY_STEP_PX // 2, rows - 1, columns - 1)
        chosen = index[half::_SKY_STEP_PX, half::_SKY_STEP_PX]
        flat = chosen.ravel()
        distance, normal = hits.distance_m[flat], hits.normal[flat]
        met = np.isfinite(distance)
        points = self.centre + distance[met, None] * directions[flat[met]] + 5 * LIFT_M * normal[met]
        ways = sky_directions()
        ahead = normal[met] @ ways.T > 0.02
        blocked = np.zeros((len(points), SKY_SAMPLES), dtype=bool)
        which, way = np.nonzero(ahead)
        blocked[which, way] = self.place.blocked(points[which], ways[way])
        share = np.zeros(len(flat))
        share[met] = sky_share(normal[met], blocked)
        shape = chosen.shape
        return _Sky(distance.reshape(shape), normal.reshape(*shape, 3), share.reshape(shape))

    def shade(
        self, x: Pixels, y: Pixels, directions: NDArray[np.float32], hits: SurfaceHits, sky: _Sky, known: _Known
    ) -> _Shaded:
        """What is seen along rays through pixels x, y; the albedo of known surfaces is taken as it is."""
        light, met = self.scene.light, hits.surface >= 0
        behind = np.zeros((int((~met).sum()), 3), np.float32)
        sky_radiance(directions[~met], light.weather == "overcast", behind)
        out = np.zeros((len(x), 3), np.float32)
        out[~met] = behind
        anew = None if known is None else hits.surface != known.surface
        albedo = self.scene.albedo(self.place, hits, hits.distance_m * self.lens.pixel_angle_rad, directions, anew)
        if anew is not None and known is not None:
            albedo[~anew] = known.albedo[~anew]
        share = np.zeros(len(x))
        spread_sky(x, y, hits.distance_m, hits.normal, _SKY_STEP_PX, sky.distance_m, sky.normal, sky.share, share)
        lit = np.zeros(len(x), dtype=bool)
        if light.has_sun:
            points = self.centre + hits.distance_m[met, None] * directions[met]
            lit[met] = self.scene.in_sun(self.place, points, hits.normal[met])
        colours = (light.sun_colour, light.sky_colour, light.bounce_colour)
        illuminate(hits.surface, albedo, hits.smooth_normal, lit, share, light.sun_direction, *colours, out)
        return _Shaded(out, hits.surface, albedo, lit)


def _refine(
    view: _View,
    picture: NDArray[np.float32],
    grid: NDArray[np.float32],
    directions: NDArray[np.float32],
    hits: SurfaceHits,
    shaded: _Shaded,
    sky: _Sky,
) -> None:
    """Four samples for each pixel in which surfaces or shadows meet."""
    shape = picture.shape[:2]
    flagged = np.zeros(shape, dtype=bool)
    leafy = (hits.surface >= 0) & (view.place.mesh.material[hits.surface] == LEAF)
    find_edges(
        hits.surface.reshape(shape),
        hits.normal.reshape(*shape, 3),
        hits.distance_m.reshape(shape),
        directions.reshape(*shape, 3),
        shaded.lit.reshape(shape),
        leafy.reshape(shape),
        flagged,
    )
    row, column = np.nonzero(flagged)
    if not len(row):
        return
    known = shaded.of(row * shape[1] + column)
    across, down = _rates(grid, row, column)
    total = np.zeros((len(row), 3), np.float32)
    for dx, dy in _SUBPIXELS:
        rays = grid[row, column] + np.float32(dx) * across + np.float32(dy) * down
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        ways = view.turn(rays)
        found = view.place.hits(view.centre[None], ways)
        total += view.shade(column + 0.5 + dx, row + 0.5 + dy, ways, found, sky, known).light
    picture[row, column] = total / len(_SUBPIXELS)


def _rates(
    grid: NDArray[np.float32], row: NDArray[np.intp], column: NDArray[np.intp]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Change of the viewing direction (N, 3) for one pixel to the right and one down."""
    rows, columns = grid.shape[:2]
    left, right = np.maximum(column - 1, 0), np.minimum(column + 1, columns - 1)
    above, below = np.maximum(row - 1, 0), np.minimum(row + 1, rows - 1)
    across = (grid[row, right] - grid[row, left]) / (right - left)[:, None].astype(np.float32)
    down = (grid[below, column] - grid[above, column]) / (below - above)[:, None].astype(np.float32)
    return across, down
