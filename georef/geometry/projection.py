"""Projection of points into many posed views at once, with derivatives."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from georef.geometry.camera import Camera
from georef.geometry.lenses import COEFFICIENTS, MODELS, LensModel
from georef.geometry.rigid import Array, Rigid3, skew

MODEL_NAMES = tuple(MODELS)


@dataclass(frozen=True, eq=False)
class Views:
    """V posed views as arrays: cam_from_world, and the cameras' models and parameters. Pixels are observed ones."""

    rotation: Array  # (V, 3, 3) cam_from_world
    translation: Array  # (V, 3) cam_from_world
    model: NDArray[np.int64]  # (V,) index in MODEL_NAMES
    parameters: Array  # (V, 13): fx, fy, cx, cy, eight coefficients, limit

    @staticmethod
    def of(world_from_cams: Sequence[Rigid3], cameras: Sequence[Camera]) -> Views:
        inverse = [pose.inverse() for pose in world_from_cams]
        return Views(
            np.array([pose.rotation for pose in inverse]).reshape(-1, 3, 3),
            np.array([pose.translation for pose in inverse]).reshape(-1, 3),
            np.array([MODEL_NAMES.index(c.model) for c in cameras], dtype=np.int64),
            np.array([c.parameters for c in cameras], dtype=np.float64).reshape(-1, 5 + COEFFICIENTS),
        )

    def __len__(self) -> int:
        return len(self.rotation)

    @property
    def centres(self) -> Array:
        """Projection centres in world (V, 3)."""
        return -np.einsum("vji,vj->vi", self.rotation, self.translation)

    def to_cam(self, view: NDArray[np.integer], points: Array) -> Array:
        """Points (n, 3) in world to the camera frames (n, 3) of the views (n,)."""
        return np.einsum("nij,nj->ni", self.rotation[view], points) + self.translation[view]

    def rays(self, view: NDArray[np.integer], pixels: Array) -> Array:
        """Unit directions (n, 3) in world of pixels (n, 2) of the views (n,); NaN where a pixel has no ray."""
        k = self.parameters[view]
        image = (pixels - k[:, 2:4]) / k[:, :2]
        in_cam = np.empty((len(image), 3))
        for lens, here in self._by_lens(view):
            in_cam[here] = lens.rays(image[here], k[here, 4:-1], k[here, -1])
        in_cam /= np.linalg.norm(in_cam, axis=1, keepdims=True)
        return np.einsum("nji,nj->ni", self.rotation[view], in_cam)

    def project(self, view: NDArray[np.integer], points: Array) -> Array:
        """Pixels (n, 2) of points (n, 3) in the views (n,); NaN for points that a lens does not show."""
        in_cam, k = self.to_cam(view, points), self.parameters[view]
        image = np.empty((len(in_cam), 2))
        for lens, here in self._by_lens(view):
            image[here] = lens.project(in_cam[here], k[here, 4:-1], k[here, -1])
        return image * k[:, :2] + k[:, 2:4]

    def project_with_derivatives(self, view: NDArray[np.integer], in_cam: Array) -> tuple[Array, Array]:
        """Pixels (n, 2) of points (n, 3) in the camera frames of the views (n,), and their derivatives (n, 2, 3)."""
        k = self.parameters[view]
        image, by_cam = np.empty((len(in_cam), 2)), np.empty((len(in_cam), 2, 3))
        for lens, here in self._by_lens(view):
            image[here], by_cam[here], _ = lens.derivatives(in_cam[here], k[here, 4:-1], k[here, -1])
        return image * k[:, :2] + k[:, 2:4], by_cam * k[:, :2, None]

    def _by_lens(self, view: NDArray[np.integer]) -> Iterator[tuple[LensModel, NDArray[np.bool_] | slice]]:
        """The lens models of the views (n,), each with where it applies."""
        model = self.model[view]
        for index, name in enumerate(MODEL_NAMES):
            here = model == index
            if here.any():
                yield MODELS[name], slice(None) if here.all() else here


@dataclass(frozen=True, eq=False)
class Linearized:
    """Projection of n point-view pairs and its derivatives."""

    pixel: Array  # (n, 2)
    by_pose: Array  # (n, 2, 6): right perturbation of world_from_cam, (rad, m)
    by_point: Array  # (n, 2, 3): point in world


def linearize(views: Views, view: NDArray[np.integer], points: Array) -> Linearized:
    """Projects points (n, 3) into views (n,). With p = cam point: dp = [p]x w - v for `T @ Exp(w, v)`."""
    in_cam = views.to_cam(view, points)
    pixel, by_cam = views.project_with_derivatives(view, in_cam)
    by_pose = np.concatenate([by_cam @ skew(in_cam), -by_cam], axis=2)
    return Linearized(pixel, by_pose, by_cam @ views.rotation[view])
