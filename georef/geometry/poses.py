"""Many rigid transforms at once, as arrays; the conventions are those of `Rigid3`.

Formulas: Sola, Deray, Atchuthan, "A micro Lie theory for state estimation in robotics" (2018), appendix B and D.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import cast

import numpy as np
from numpy.typing import NDArray

from georef.geometry.rigid import Array, Rigid3, log_so3, skew

_SMALL_ANGLE, _SERIES_BELOW = 1e-7, 1e-2
_NEAR_HALF_TURN = np.pi - 1e-5


@dataclass(frozen=True, eq=False)
class Poses:
    """N transforms `a_from_b`: rotation (N, 3, 3), translation (N, 3) in metres."""

    rotation: Array
    translation: Array

    @staticmethod
    def of(poses: Iterable[Rigid3]) -> Poses:
        listed = list(poses)
        return Poses(
            np.array([pose.rotation for pose in listed], dtype=np.float64).reshape(-1, 3, 3),
            np.array([pose.translation for pose in listed], dtype=np.float64).reshape(-1, 3),
        )

    @staticmethod
    def identity(count: int) -> Poses:
        return Poses(np.tile(np.eye(3), (count, 1, 1)), np.zeros((count, 3)))

    @staticmethod
    def exp(xi: Array) -> Poses:
        """The transforms of tangent vectors (N, 6): rotation rad, translation m."""
        rotation = exp_so3(xi[:, :3])
        return Poses(rotation, np.einsum("nij,nj->ni", left_jacobians(xi[:, :3]), xi[:, 3:]))

    def __len__(self) -> int:
        return len(self.rotation)

    def __getitem__(self, index: int) -> Rigid3:
        return Rigid3(self.rotation[index].copy(), self.translation[index].copy())

    def to_list(self) -> list[Rigid3]:
        return [self[i] for i in range(len(self))]

    def take(self, selection: NDArray[np.bool_] | NDArray[np.integer]) -> Poses:
        return Poses(self.rotation[selection], self.translation[selection])

    def __matmul__(self, other: Poses) -> Poses:
        """a_from_b @ b_from_c = a_from_c, one by one."""
        translation = np.einsum("nij,nj->ni", self.rotation, other.translation) + self.translation
        return Poses(self.rotation @ other.rotation, translation)

    def inverse(self) -> Poses:
        transposed = np.swapaxes(self.rotation, 1, 2)
        return Poses(transposed.copy(), -np.einsum("nij,nj->ni", transposed, self.translation))

    def apply(self, points: Array) -> Array:
        """Points (N, 3) in b, one for each transform, to a."""
        return np.einsum("nij,nj->ni", self.rotation, points) + self.translation

    def retract(self, xi: Array) -> Poses:
        """`self @ Exp(xi)` for steps (N, 6), rotations kept orthonormal over many steps."""
        moved = self @ Poses.exp(xi)
        # One Newton step towards the nearest rotation: errors of 1e-8 become errors of 1e-16.
        r = moved.rotation
        return Poses(1.5 * r - 0.5 * r @ np.swapaxes(r, 1, 2) @ r, moved.translation)

    def log(self) -> Array:
        """Tangent vectors (N, 6): rotation rad, translation m."""
        w = log_so3s(self.rotation)
        solved = cast(Array, np.linalg.solve(left_jacobians(w), self.translation[:, :, None]))
        return np.concatenate([w, solved[:, :, 0]], axis=1)

    def local(self, other: Poses) -> Array:
        """The xi (N, 6) with `self @ Exp(xi) = other`."""
        return (self.inverse() @ other).log()

    def adjoint(self) -> Array:
        """Ad (N, 6, 6): `T @ Exp(xi) = Exp(Ad xi) @ T`, tangent order (rotation, translation)."""
        out = np.zeros((len(self), 6, 6))
        out[:, :3, :3] = out[:, 3:, 3:] = self.rotation
        out[:, 3:, :3] = skew(self.translation) @ self.rotation
        return out


def _series(angle: Array) -> tuple[Array, Array, Array]:
    """sin(a)/a, (1 - cos a)/a^2 and (a - sin a)/a^3 of angles (N,), stable near zero."""
    safe, square = np.where(angle < _SMALL_ANGLE, 1.0, angle), angle * angle
    half = np.sin(0.5 * safe)
    first = np.where(angle < _SMALL_ANGLE, 1.0, np.sin(safe) / safe)
    second = np.where(angle < _SMALL_ANGLE, 0.5, 2.0 * half * half / (safe * safe))
    third = np.where(angle < _SERIES_BELOW, 1 / 6 - square / 120, (safe - np.sin(safe)) / safe**3)
    return first, second, third


def exp_so3(rotation_vectors: Array) -> Array:
    """Rotation matrices (N, 3, 3) of rotation vectors (N, 3) in radians (Rodrigues)."""
    first, second, _ = _series(np.linalg.norm(rotation_vectors, axis=1))
    k = skew(rotation_vectors)
    return np.eye(3) + first[:, None, None] * k + second[:, None, None] * (k @ k)


def left_jacobians(rotation_vectors: Array) -> Array:
    """Left Jacobians of SO(3) (N, 3, 3): Exp(w + dw) = Exp(Jl(w) dw) Exp(w); the right one is that of -w."""
    _, second, third = _series(np.linalg.norm(rotation_vectors, axis=1))
    k = skew(rotation_vectors)
    return np.eye(3) + second[:, None, None] * k + third[:, None, None] * (k @ k)


def log_so3s(rotations: Array) -> Array:
    """Rotation vectors (N, 3) in radians, angles in [0, pi], of rotation matrices (N, 3, 3)."""
    r = rotations
    axis_sin = 0.5 * np.stack([r[:, 2, 1] - r[:, 1, 2], r[:, 0, 2] - r[:, 2, 0], r[:, 1, 0] - r[:, 0, 1]], axis=1)
    sine = np.linalg.norm(axis_sin, axis=1)
    angle = np.arctan2(sine, 0.5 * (np.trace(r, axis1=1, axis2=2) - 1.0))
    factor = np.where(angle < _SMALL_ANGLE, 1.0, angle / np.where(sine > 0, sine, 1.0))
    out = axis_sin * factor[:, None]
    for index in np.flatnonzero(angle >= _NEAR_HALF_TURN):  # rare: the axis is found in another way there
        out[index] = log_so3(r[index])
    return out
