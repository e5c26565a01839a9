"""Ray casting against the pieces of a street around one place."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from embreex.mesh_construction import TriangleMesh  # pyright: ignore[reportMissingImports]
from embreex.rtcore_scene import EmbreeScene  # pyright: ignore[reportMissingImports]
from numpy.typing import NDArray

from georef.geometry.rigid import Array
from georef.simulate.mesh import Mesh
from georef.simulate.shading import empty_hits, locate

LIFT_M = 0.002  # off the surface, for rays that start on it


@dataclass(frozen=True, eq=False)
class Surroundings:
    """A mesh with its search tree; single precision inside, about a local origin, and exact points outside."""

    mesh: Mesh
    origin_in_world: Array
    tree: Any

    @staticmethod
    def of(mesh: Mesh, origin_in_world: Array) -> Surroundings:
        tree = EmbreeScene()
        TriangleMesh(tree, np.ascontiguousarray(mesh.corners - origin_in_world, dtype=np.float32))
        return Surroundings(mesh, origin_in_world, tree)

    def triangles(self, origins: Array, directions: NDArray[np.floating]) -> NDArray[np.int32]:
        """Number (N,) of the first triangle on each ray, -1 where there is none."""
        starts, ways = self._local(origins, directions)
        return self.tree.run(starts, ways)

    def blocked(self, origins: Array, directions: NDArray[np.floating]) -> NDArray[np.bool_]:
        """Whether anything (N,) stands on each ray."""
        starts, ways = self._local(origins, directions)
        return self.tree.run(starts, ways, query="OCCLUDED") >= 0

    def _local(
        self, origins: Array, directions: NDArray[np.floating]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        ways = np.ascontiguousarray(directions, dtype=np.float32)
        starts = (np.atleast_2d(origins) - self.origin_in_world).astype(np.float32)
        return np.ascontiguousarray(np.broadcast_to(starts, ways.shape)), ways

    def hits(self, origins: Array, directions: NDArray[np.floating]) -> SurfaceHits:
        """First hits with exact distances; origins (1, 3) or (N, 3)."""
        origins = np.atleast_2d(np.asarray(origins, np.float64))
        triangle = self.triangles(origins, directions)
        found = SurfaceHits(triangle, self._surface(triangle), *empty_hits(len(triangle)))
        mesh = self.mesh
        locate(triangle, origins, directions, mesh.corners, mesh.uv_m, mesh.normals, *found.parts())
        return found

    def _surface(self, triangle: NDArray[np.int32]) -> NDArray[np.int32]:
        return np.where(triangle >= 0, self.mesh.surface[triangle], -1).astype(np.int32)


@dataclass(frozen=True, eq=False)
class SurfaceHits:
    """Of N rays: triangle and surface (-1: none), distance, normal, smooth normal, texture coordinates, stretch."""

    triangle: NDArray[np.int32]
    surface: NDArray[np.int32]
    distance_m: Array
    normal: Array
    smooth_normal: Array
    uv_m: Array
    stretch: Array

    def parts(self) -> tuple[Array, Array, Array, Array, Array]:
        return self.distance_m, self.normal, self.smooth_normal, self.uv_m, self.stretch
