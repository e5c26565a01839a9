"""Many transforms at once agree with one at a time."""

from __future__ import annotations

import numpy as np
import pytest

from georef.geometry.poses import Poses
from georef.geometry.rigid import Rigid3

_ANGLES = (0.0, 1e-9, 1e-5, 9e-3, 1.1e-2, 1.0, 3.0, np.pi - 1e-7)


@pytest.fixture
def tangents() -> np.ndarray:
    rng = np.random.default_rng(0)
    axes = rng.normal(size=(len(_ANGLES), 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    return np.concatenate([axes * np.array(_ANGLES)[:, None], rng.normal(size=(len(_ANGLES), 3)) * 5], axis=1)


def test_agrees_with_single_transforms(tangents: np.ndarray) -> None:
    many, single = Poses.exp(tangents), [Rigid3.exp(xi) for xi in tangents]
    other = Poses.exp(tangents[::-1])
    for index, pose in enumerate(single):
        assert np.allclose(many[index].matrix(), pose.matrix(), atol=1e-12)
        assert np.allclose(many.inverse()[index].matrix(), pose.inverse().matrix(), atol=1e-12)
        assert np.allclose((many @ other)[index].matrix(), (pose @ other[index]).matrix(), atol=1e-12)
        assert np.allclose(many.adjoint()[index], pose.adjoint(), atol=1e-12)
        assert np.allclose(many.local(other)[index], pose.local(other[index]), atol=1e-9)
        assert np.allclose(many.apply(tangents[:, 3:])[index], pose.apply(tangents[index, 3:]), atol=1e-12)


def test_log_inverts_exp(tangents: np.ndarray) -> None:
    assert np.allclose(Poses.exp(tangents).log(), tangents, atol=1e-7)


def test_rotations_stay_orthonormal_over_many_steps(tangents: np.ndarray) -> None:
    poses = Poses.identity(len(tangents))
    for _ in range(2000):
        poses = poses.retract(tangents)
    assert np.abs(poses.rotation @ np.swapaxes(poses.rotation, 1, 2) - np.eye(3)).max() < 1e-14


def test_lists_and_selections(tangents: np.ndarray) -> None:
    poses = Poses.exp(tangents)
    again = Poses.of(poses.to_list())
    assert np.array_equal(again.rotation, poses.rotation)
    assert len(poses.take(np.array([1, 3]))) == 2
    assert len(Poses.of([])) == 0
