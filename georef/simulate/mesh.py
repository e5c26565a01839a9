"""Triangles with metric texture coordinates, and the builder that objects are made with.

Objects are built in a local frame (metres, z up); `Builder.frame` places it in the world. Texture coordinates
are metres too: along the horizontal tangent of a face and up its slope, unless an object has its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from georef.geometry.rigid import Array, Rigid3

Triple = tuple[float, float, float]
_CUBE_FACES = {
    "left": (0, 4, 7, 3),
    "right": (5, 1, 2, 6),
    "front": (0, 1, 5, 4),
    "back": (2, 3, 7, 6),
    "bottom": (3, 2, 1, 0),
    "top": (4, 5, 6, 7),
}  # corners 0-3: lower ring from the front left, 4-7: upper ring; front is -y


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles in world with their surfaces.

    corners (T, 3, 3), uv_m (T, 3, 2), normals (T, 3, 3) at the corners, surface (T,); of each surface:
    material (S,), seed (S,), colour (S, 3) linear albedo, values (S, 4) of the material, item (S,).
    Distinctive points (Q, 3) with their normals and ids (Q,).
    """

    corners: Array
    uv_m: Array
    normals: NDArray[np.float32]
    surface: NDArray[np.int32]
    material: NDArray[np.int32]
    seed: NDArray[np.int64]
    colour: Array
    values: Array
    item: NDArray[np.int32]
    points_in_world: Array
    point_normals: Array
    point_ids: NDArray[np.int64]


class Builder:
    """Collects the faces of objects; `finish` gives the mesh."""

    def __init__(self) -> None:
        self.frame = Rigid3.identity()
        self.item_number = 0
        self._placed: list[tuple[Array, Array, Array, NDArray[np.int32]]] = []
        self._quads: list[Sequence[Triple]] = []
        self._quad_surfaces: list[int] = []
        self._quad_uv: list[Sequence[tuple[float, float]] | None] = []
        self._surfaces: list[tuple[int, int, Sequence[float], Sequence[float], int]] = []
        self._points: list[tuple[Array, Array, int]] = []
        self._point_count = 0

    def start(self, frame: Rigid3, item_number: int) -> None:
        """Begin an object: its world_from_object, and the number that its surfaces and points carry."""
        self._flush()
        self.frame, self.item_number, self._point_count = frame, item_number, 0

    def surface(
        self, material: int, colour: Sequence[float], seed: int = 0, values: Sequence[float] = (0.0, 0.0, 0.0, 0.0)
    ) -> int:
        self._surfaces.append((int(material), int(seed), tuple(colour), tuple(values), self.item_number))
        return len(self._surfaces) - 1

    def quad(
        self, a: Triple, b: Triple, c: Triple, d: Triple, surface: int, uv: Sequence[tuple[float, float]] | None = None
    ) -> None:
        """A quadrilateral, corners counter-clockwise as seen from outside; d = c makes a triangle."""
        self._quads.append((a, b, c, d))
        self._quad_surfaces.append(surface)
        self._quad_uv.append(uv)

    def box(self, low: Triple, high: Triple, surface: int, without: Sequence[str] = ()) -> None:
        """An axis-parallel box of the local frame, less the faces named."""
        (x0, y0, z0), (x1, y1, z1) = low, high
        ring = [(x0, y0), (x1, y0), (x1, y1), (x0, y1)]
        corners = [(x, y, z) for z in (z0, z1) for x, y in ring]
        for name, (i, j, k, m) in _CUBE_FACES.items():
            if name not in without:
                self.quad(corners[i], corners[j], corners[k], corners[m], surface)

    def panel(self, x0: float, x1: float, z0: float, z1: float, y: float, surface: int) -> None:
        """An upright rectangle that faces -y, with texture coordinates from its lower left corner."""
        width, height = x1 - x0, z1 - z0
        uv = [(0.0, 0.0), (width, 0.0), (width, height), (0.0, height)]
        self.quad((x0, y, z0), (x1, y, z0), (x1, y, z1), (x0, y, z1), surface, uv)

    def tube(self, a: Triple, b: Triple, radii: tuple[float, float], surface: int, sides: int = 10) -> None:
        """A smooth cone frustum from a to b, without its ends."""
        start, end = np.array(a), np.array(b)
        axis = (end - start) / np.linalg.norm(end - start)
        side = np.cross(axis, [1.0, 0.0, 0.0] if abs(axis[0]) < 0.7 else [0.0, 1.0, 0.0])
        side /= np.linalg.norm(side)
        angle = np.linspace(0, 2 * np.pi, sides + 1)
        ring = np.outer(np.cos(angle), side) + np.outer(np.sin(angle), np.cross(axis, side))
        low, high = start + ring * radii[0], end + ring * radii[1]
        corners = np.stack([low[:-1], low[1:], high[1:], high[:-1]], axis=1)
        normals = np.stack([ring[:-1], ring[1:], ring[1:], ring[:-1]], axis=1)
        around, length = angle * max(radii), float(np.linalg.norm(end - start))
        uv = np.zeros((sides, 4, 2))
        uv[:, [0, 3], 0], uv[:, [1, 2], 0], uv[:, 2:, 1] = around[:-1, None], around[1:, None], length
        self.smooth(corners, normals, uv, surface)

    def disc(self, centre: Triple, radius: float, surface: int, axis: str = "z", sides: int = 16) -> None:
        """A flat disc; texture coordinates from its centre."""
        angle = np.linspace(0, 2 * np.pi, sides + 1)
        c, s = radius * np.cos(angle), radius * np.sin(angle)
        zero = np.zeros_like(c)
        ring = np.stack([c, s, zero] if axis == "z" else [c, zero, s] if axis == "y" else [zero, c, s], axis=1)
        middle = np.broadcast_to(np.array(centre), (sides, 3))
        corners = np.stack([middle, middle + ring[:-1], middle + ring[1:], middle + ring[1:]], axis=1)
        flat = np.zeros((sides, 4, 3))
        flat[..., "xyz".index(axis)] = -1.0 if axis == "y" else 1.0
        plane = np.stack([c, s], axis=1)
        uv = np.stack([np.zeros((sides, 2)), plane[:-1], plane[1:], plane[1:]], axis=1)
        self.smooth(corners, flat, uv, surface)

    def smooth(self, corners: Array, normals: Array, uv_m: Array, surface: int | NDArray[np.int32]) -> None:
        """Quadrilaterals (n, 4, 3) with the normals (n, 4, 3) and texture coordinates (n, 4, 2) of their corners."""
        rotated = normals @ self.frame.rotation.T
        surfaces = np.broadcast_to(np.asarray(surface, np.int32), (len(corners),))
        self._placed.append((self.frame.apply(corners), uv_m, rotated, surfaces))

    def mark(self, point: Triple, normal: Triple) -> None:
        """A distinctive point of the object, found again wherever the object is."""
        number = self.item_number * 4096 + self._point_count
        self._point_count += 1
        self._points.append((self.frame.apply(point), self.frame.rotation @ np.array(normal), number))

    def _flush(self) -> None:
        if not self._quads:
            return
        corners = np.array(self._quads, dtype=np.float64)
        normal, uv = _planar(corners)
        for index, given in enumerate(self._quad_uv):
            if given is not None:
                uv[index] = given
        surfaces, self._quad_uv, self._quads = np.array(self._quad_surfaces, np.int32), [], []
        self._quad_surfaces = []
        rotated = np.repeat((normal @ self.frame.rotation.T)[:, None], 4, axis=1)
        self._placed.append((self.frame.apply(corners), uv, rotated, surfaces))

    def finish(self) -> Mesh:
        self._flush()
        corners, uv, normals, surface = (np.concatenate(part) for part in zip(*self._placed, strict=True))
        halves = np.array([[0, 1, 2], [0, 2, 3]])
        triangles = corners[:, halves].reshape(-1, 3, 3)
        area = np.linalg.norm(np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]), axis=1)
        keep = area > 1e-9
        material, seed, colour, values, item = zip(*self._surfaces, strict=True)
        points = list(zip(*self._points, strict=True)) if self._points else [np.zeros((0, 3)), np.zeros((0, 3)), []]
        return Mesh(
            corners=triangles[keep],
            uv_m=uv[:, halves].reshape(-1, 3, 2)[keep],
            normals=normals[:, halves].reshape(-1, 3, 3)[keep].astype(np.float32),
            surface=np.repeat(surface, 2)[keep].astype(np.int32),
            material=np.array(material, np.int32),
            seed=np.array(seed, np.int64),
            colour=np.array(colour, np.float64).reshape(-1, 3),
            values=np.array(values, np.float64).reshape(-1, 4),
            item=np.array(item, np.int32),
            points_in_world=np.array(points[0]).reshape(-1, 3),
            point_normals=np.array(points[1]).reshape(-1, 3),
            point_ids=np.array(points[2], np.int64),
        )


def _planar(quads: Array) -> tuple[Array, Array]:
    """Normals (n, 3) of quadrilaterals (n, 4, 3) and their metric coordinates (n, 4, 2) in the plane."""
    normal = np.cross(quads[:, 2] - quads[:, 0], quads[:, 3] - quads[:, 1])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    across = np.cross([0.0, 0.0, 1.0], normal)
    length = np.linalg.norm(across, axis=1, keepdims=True)
    across = np.where(length > 1e-3, across / np.maximum(length, 1e-12), [1.0, 0.0, 0.0])
    along = np.cross(normal, across)
    uv = np.stack([np.einsum("nij,nj->ni", quads, across), np.einsum("nij,nj->ni", quads, along)], axis=-1)
    return normal, uv


def join(meshes: Sequence[Mesh]) -> Mesh:
    """One mesh of several, surfaces renumbered."""
    offsets = np.cumsum([0] + [len(m.material) for m in meshes[:-1]])
    names = [name for name in Mesh.__dataclass_fields__ if name != "surface"]
    parts = {name: np.concatenate([getattr(m, name) for m in meshes]) for name in names}
    surface = np.concatenate([m.surface + np.int32(o) for m, o in zip(meshes, offsets, strict=True)])
    return Mesh(surface=surface.astype(np.int32), **parts)
