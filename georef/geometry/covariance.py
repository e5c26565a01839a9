"""Covariances of poses and points: conversion between conventions and propagation.

The convention of the house: pose covariance (6, 6) in (rotation rad, translation m), right perturbation
`T @ Exp(xi)` of the named transform, usually `world_from_cam`.
"""

from __future__ import annotations

import numpy as np

from georef.geometry.rigid import Array, Rigid3, skew

COV_COLUMNS = tuple(f"cov_{i}{j}" for i in range(6) for j in range(i, 6))
"""Names of the 21 upper-triangle columns of a pose covariance, row by row."""


def symmetric(matrix: Array) -> Array:
    return 0.5 * (matrix + np.swapaxes(matrix, -1, -2))


def information_of_rank(cov: Array, rank: int) -> Array:
    """The inverse of a covariance in the `rank` most certain directions, nothing in the others."""
    values, vectors = np.linalg.eigh(cov)
    return (vectors[:, :rank] / values[:rank]) @ vectors[:, :rank].T


def largest_position_sigma(cov: Array) -> float:
    """1-sigma of the position in the direction in which it is least certain, of a pose covariance (6, 6)."""
    return float(np.sqrt(np.linalg.eigvalsh(cov[3:, 3:])[-1]))


def upper_triangle(cov: Array) -> Array:
    """The 21 upper-triangle elements of a (6, 6) covariance, row by row."""
    return cov[np.triu_indices(6)]


def from_upper_triangle(values: Array) -> Array:
    """The (6, 6) covariance of its 21 upper-triangle elements."""
    out = np.zeros((6, 6))
    out[np.triu_indices(6)] = values
    return out + np.triu(out, 1).T


def world_from_cam_cov_from_colmap(cam_from_world: Rigid3, colmap_cov: Array) -> Array:
    """COLMAP's pose covariance (6, 6) in the convention of the house.

    COLMAP perturbs `cam_from_world` by a left rotation in half-angle units and an additive translation, for 1 px
    noise. With D = diag(2, 2, 2, 1, 1, 1) and J = [[I, 0], [[t]x, I]] the tangent of world_from_cam follows up to
    its sign, which a covariance does not see.
    """
    jacobian = np.eye(6)
    jacobian[3:, :3] = skew(cam_from_world.translation)
    jacobian = jacobian @ np.diag([2.0, 2.0, 2.0, 1.0, 1.0, 1.0])
    return symmetric(jacobian @ colmap_cov @ jacobian.T)


def position_cov_in_world(world_from_cam: Rigid3, pose_cov: Array) -> Array:
    """Covariance (3, 3) of the camera centre in world axes, m^2."""
    return symmetric(world_from_cam.rotation @ pose_cov[3:, 3:] @ world_from_cam.rotation.T)


def pose_cov_from_parts(world_from_cam: Rigid3, position_cov: Array, rotation_cov_in_cam: Array) -> Array:
    """Pose covariance (6, 6) of uncorrelated position (3, 3; m^2, world axes) and rotation (3, 3; rad^2, camera)."""
    out = np.zeros((6, 6))
    out[:3, :3] = rotation_cov_in_cam
    out[3:, 3:] = world_from_cam.rotation.T @ position_cov @ world_from_cam.rotation
    return symmetric(out)
