"""Projection of points into many posed views at once, with derivatives."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from georef.geometry.camera import Camera
from georef.geometry.rigid import Array, Rigid3, skew


@dataclass(frozen=True, eq=False)
class Views:
    """V posed views as arrays: cam_from_world and ideal pinhole intrinsics (fx, fy, cx, cy) px."""

    rotation: Array  # (V, 3, 3) cam_from_world
    translation: Array  # (V, 3) cam_from_world
    intrinsics: Array  # (V, 4)

    @staticmethod
    def of(world_from_cams: Sequence[Rigid3], cameras: Sequence[Camera]) -> Views:
        inverse = [pose.inverse() for pose in world_from_cams]
        return Views(
            np.array([pose.rotation for pose in inverse]).reshape(-1, 3, 3),
            np.array([pose.translation for pose in inverse]).reshape(-1, 3),
            np.array([[c.fx, c.fy, c.cx, c.cy] for c in cameras], dtype=np.float64).reshape(-1, 4),
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
        """Unit directions (n, 3) in world of ideal pixels (n, 2) of the views (n,)."""
        k = self.intrinsics[view]
        in_cam = np.column_stack([(pixels - k[:, 2:]) / k[:, :2], np.ones(len(pixels))])
        in_cam /= np.linalg.norm(in_cam, axis=1, keepdims=True)
        return np.einsum("nji,nj->ni", self.rotation[view], in_cam)

    def project(self, view: NDArray[np.integer], points: Array) -> Array:
        """Ideal pixels (n, 2) of points (n, 3) in the views (n,); NaN for points that are not in front."""
        return _pixels(self.to_cam(view, points), self.intrinsics[view])


def _pixels(in_cam: Array, intrinsics: Array) -> Array:
    depth = np.where(in_cam[:, 2] > 0, in_cam[:, 2], np.nan)
    return in_cam[:, :2] / depth[:, None] * intrinsics[:, :2] + intrinsics[:, 2:]


@dataclass(frozen=True, eq=False)
class Linearized:
    """Projection of n point-view pairs and its derivatives."""

    pixel: Array  # (n, 2)
    by_pose: Array  # (n, 2, 6): right perturbation of world_from_cam, (rad, m)
    by_point: Array  # (n, 2, 3): point in world


def linearize(views: Views, view: NDArray[np.integer], points: Array) -> Linearized:
    """Projects points (n, 3) into views (n,). With p = cam point: dp = [p]x w - v for `T @ Exp(w, v)`."""
    in_cam = views.to_cam(view, points)
    k = views.intrinsics[view]
    depth = np.where(in_cam[:, 2] > 0, in_cam[:, 2], np.nan)
    by_cam = np.zeros((len(points), 2, 3))
    by_cam[:, 0, 0], by_cam[:, 1, 1] = k[:, 0] / depth, k[:, 1] / depth
    by_cam[:, :, 2] = -in_cam[:, :2] * k[:, :2] / (depth * depth)[:, None]
    by_pose = np.concatenate([by_cam @ skew(in_cam), -by_cam], axis=2)
    return Linearized(_pixels(in_cam, k), by_pose, by_cam @ views.rotation[view])
