"""SO(3) and SE(3): exponential maps and the rigid transform `a_from_b`.

Tangent vectors of SE(3) are ordered (rotation rad, translation m), and perturbations stand on the right:
`T @ Rigid3.exp(xi)`. This is the tangent of gtsam.Pose3, so that covariances pass between the two unchanged.
Formulas: Sola, Deray, Atchuthan, "A micro Lie theory for state estimation in robotics" (2018), appendix B and D.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

_SMALL_ANGLE = 1e-7


def skew(vectors: ArrayLike) -> Array:
    """Cross-product matrices of vectors, shape (..., 3) -> (..., 3, 3)."""
    v = np.asarray(vectors, dtype=np.float64)
    out = np.zeros((*v.shape[:-1], 3, 3))
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    out[..., 1, 0], out[..., 2, 0], out[..., 2, 1] = v[..., 2], -v[..., 1], v[..., 0]
    return out


def _series(angle: float) -> tuple[float, float, float]:
    """sin(a)/a, (1 - cos a)/a^2 and (a - sin a)/a^3, stable near zero."""
    if angle < _SMALL_ANGLE:
        return 1.0, 0.5, 1.0 / 6.0
    half = np.sin(0.5 * angle)
    square = angle * angle
    third = 1 / 6 - square / 120 if angle < 1e-2 else (angle - np.sin(angle)) / (square * angle)
    return float(np.sin(angle) / angle), float(2.0 * half * half / square), float(third)


def exp_so3(rotation_vector: ArrayLike) -> Array:
    """Rotation matrix (3, 3) of a rotation vector (3,) in radians (Rodrigues)."""
    w = np.asarray(rotation_vector, dtype=np.float64)
    a, b, _ = _series(float(np.linalg.norm(w)))
    k = skew(w)
    return np.eye(3) + a * k + b * (k @ k)


def log_so3(rotation: ArrayLike) -> Array:
    """Rotation vector (3,) in radians, angle in [0, pi], of a rotation matrix (3, 3)."""
    r = np.asarray(rotation, dtype=np.float64)
    axis_sin = 0.5 * np.array([r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]])
    sine = float(np.linalg.norm(axis_sin))
    cosine = 0.5 * (np.trace(r) - 1.0)
    angle = float(np.arctan2(sine, cosine))
    if angle < _SMALL_ANGLE:
        return axis_sin
    if angle < np.pi - 1e-5:
        return axis_sin * (angle / sine)
    # Near pi the antisymmetric part vanishes: the axis is the largest column of (R + R^T)/2 - cos I.
    symmetric = 0.5 * (r + r.T) - cosine * np.eye(3)
    axis = symmetric[:, int(np.argmax(np.diag(symmetric)))]
    axis = axis / np.linalg.norm(axis)
    return angle * (axis if axis @ axis_sin >= 0 else -axis)


def right_jacobian_so3(rotation_vector: ArrayLike) -> Array:
    """Right Jacobian (3, 3): Exp(w + dw) = Exp(w) Exp(Jr(w) dw)."""
    w = np.asarray(rotation_vector, dtype=np.float64)
    _, b, c = _series(float(np.linalg.norm(w)))
    k = skew(w)
    return np.eye(3) - b * k + c * (k @ k)


def _left_jacobian_so3(rotation_vector: Array) -> Array:
    return right_jacobian_so3(-rotation_vector)


def nearest_rotation(matrix: ArrayLike) -> Array:
    """The rotation (3, 3) nearest to a matrix in the Frobenius norm (orthogonal Procrustes)."""
    u, _, vt = np.linalg.svd(np.asarray(matrix, dtype=np.float64))
    return cast(Array, u @ np.diag([1.0, 1.0, float(np.sign(np.linalg.det(u @ vt)))]) @ vt)


def rotation_angle(rotation: ArrayLike) -> float:
    """Angle of a rotation matrix (3, 3), radians in [0, pi]."""
    return float(np.linalg.norm(log_so3(rotation)))


@dataclass(frozen=True, eq=False)
class Rigid3:
    """A rigid transform `a_from_b`: points_in_a = rotation @ points_in_b + translation.

    rotation: (3, 3), float64; translation: (3,), float64, metres.
    """

    rotation: Array
    translation: Array

    @staticmethod
    def identity() -> Rigid3:
        return Rigid3(np.eye(3), np.zeros(3))

    @staticmethod
    def exp(xi: ArrayLike) -> Rigid3:
        """The transform of a tangent vector (6,): rotation rad, translation m."""
        xi = np.asarray(xi, dtype=np.float64)
        return Rigid3(exp_so3(xi[:3]), _left_jacobian_so3(xi[:3]) @ xi[3:])

    @staticmethod
    def from_matrix(matrix: ArrayLike) -> Rigid3:
        """From a (3, 4) or (4, 4) homogeneous matrix."""
        m = np.asarray(matrix, dtype=np.float64)
        return Rigid3(m[:3, :3].copy(), m[:3, 3].copy())

    def log(self) -> Array:
        """Tangent vector (6,): rotation rad, translation m."""
        w = log_so3(self.rotation)
        return np.concatenate([w, np.asarray(np.linalg.solve(_left_jacobian_so3(w), self.translation), np.float64)])

    def __matmul__(self, other: Rigid3) -> Rigid3:
        """a_from_b @ b_from_c = a_from_c."""
        return Rigid3(self.rotation @ other.rotation, self.rotation @ other.translation + self.translation)

    def inverse(self) -> Rigid3:
        """b_from_a."""
        return Rigid3(self.rotation.T.copy(), -self.rotation.T @ self.translation)

    def apply(self, points: ArrayLike) -> Array:
        """Points (..., 3) in b -> points (..., 3) in a."""
        return cast(Array, np.asarray(points, dtype=np.float64) @ self.rotation.T + self.translation)

    def retract(self, xi: ArrayLike) -> Rigid3:
        """`self @ Exp(xi)`, the rotation kept orthonormal over many steps."""
        moved = self @ Rigid3.exp(xi)
        return Rigid3(nearest_rotation(moved.rotation), moved.translation)

    def local(self, other: Rigid3) -> Array:
        """The xi (6,) with `self @ Exp(xi) = other`."""
        return (self.inverse() @ other).log()

    def adjoint(self) -> Array:
        """Ad (6, 6): `T @ Exp(xi) = Exp(Ad xi) @ T`, tangent order (rotation, translation)."""
        out = np.zeros((6, 6))
        out[:3, :3] = out[3:, 3:] = self.rotation
        out[3:, :3] = skew(self.translation) @ self.rotation
        return out

    def matrix(self) -> Array:
        """Homogeneous matrix (4, 4)."""
        out = np.eye(4)
        out[:3, :3], out[:3, 3] = self.rotation, self.translation
        return out
