"""Group axioms, exponential and logarithm, and Jacobians of SO(3) and SE(3) over random transforms."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from georef.geometry.rigid import (
    Array,
    Rigid3,
    exp_so3,
    log_so3,
    nearest_rotation,
    right_jacobian_so3,
    rotation_angle,
    skew,
)

_NUMBER = st.floats(-1.0, 1.0, allow_subnormal=False)
_SPECIAL_ANGLES = st.sampled_from([0.0, 1e-12, 1e-8, 1e-7, 2e-7, 1e-3, 9.9e-3, 1.01e-2, np.pi / 2, 3.0])
_ANGLES = st.one_of(st.floats(0.0, 3.1), _SPECIAL_ANGLES)
_NEAR_PI = st.sampled_from([1e-2, 1e-4, 1.1e-5, 9e-6, 1e-6, 1e-8, 1e-12])


@st.composite
def axes(draw: st.DrawFn) -> Array:
    axis = np.array([draw(_NUMBER), draw(_NUMBER), draw(_NUMBER)])
    length = np.linalg.norm(axis)
    return axis / length if length > 1e-3 else np.array([0.0, 0.6, -0.8])


@st.composite
def rotation_vectors(draw: st.DrawFn) -> Array:
    return draw(axes()) * draw(_ANGLES)


@st.composite
def transforms(draw: st.DrawFn) -> Rigid3:
    translation = 100.0 * np.array([draw(_NUMBER), draw(_NUMBER), draw(_NUMBER)])
    return Rigid3(exp_so3(draw(rotation_vectors())), translation)


def assert_same(a: Rigid3, b: Rigid3, atol: float = 1e-11) -> None:
    np.testing.assert_allclose(a.matrix(), b.matrix(), atol=atol, rtol=0)


def test_skew_is_the_cross_product_for_any_leading_shape() -> None:
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(2, 4, 5, 3))
    np.testing.assert_allclose(np.einsum("...ij,...j->...i", skew(a), b), np.cross(a, b), atol=1e-15)


@given(transforms(), transforms(), transforms())
def test_composition_is_associative(a: Rigid3, b: Rigid3, c: Rigid3) -> None:
    assert_same((a @ b) @ c, a @ (b @ c))


@given(transforms())
def test_identity_and_inverse(a: Rigid3) -> None:
    assert_same(a @ Rigid3.identity(), a)
    assert_same(Rigid3.identity() @ a, a)
    assert_same(a @ a.inverse(), Rigid3.identity())
    assert_same(a.inverse() @ a, Rigid3.identity())


@given(transforms(), transforms())
def test_composition_acts_on_points_as_one_after_the_other(a: Rigid3, b: Rigid3) -> None:
    points = np.random.default_rng(1).normal(size=(2, 4, 3))
    np.testing.assert_allclose((a @ b).apply(points), a.apply(b.apply(points)), atol=1e-11)
    np.testing.assert_allclose((a @ b).matrix(), a.matrix() @ b.matrix(), atol=1e-11)
    assert_same(Rigid3.from_matrix(a.matrix()[:3]), a, 0.0)


@given(rotation_vectors())
def test_exp_is_a_rotation_and_log_inverts_it(vector: Array) -> None:
    rotation = exp_so3(vector)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-14)
    assert np.linalg.det(rotation) == pytest.approx(1.0)
    np.testing.assert_allclose(log_so3(rotation), vector, atol=1e-13)
    assert rotation_angle(rotation) == pytest.approx(float(np.linalg.norm(vector)), abs=1e-13)


@given(axes(), _NEAR_PI)
def test_log_near_pi(axis: Array, below_pi: float) -> None:
    vector = axis * (np.pi - below_pi)
    found = log_so3(exp_so3(vector))
    if below_pi > 1e-11:
        np.testing.assert_allclose(found, vector, atol=1e-9)
    np.testing.assert_allclose(exp_so3(found), exp_so3(vector), atol=1e-9)


@given(axes())
def test_log_at_pi_is_one_of_the_two_opposite_vectors(axis: Array) -> None:
    rotation = 2.0 * np.outer(axis, axis) - np.eye(3)
    found = log_so3(rotation)
    np.testing.assert_allclose(np.abs(found @ axis), np.pi, atol=1e-12)
    assert np.linalg.norm(found) == pytest.approx(np.pi)


@given(rotation_vectors(), axes(), st.floats(-50.0, 50.0))
def test_exp_and_log_of_transforms(vector: Array, direction: Array, length: float) -> None:
    xi = np.concatenate([vector, direction * length])
    np.testing.assert_allclose(Rigid3.exp(xi).log(), xi, atol=1e-10)


def test_exp_of_a_transform_is_the_matrix_exponential() -> None:
    xi = np.array([0.4, -0.9, 0.3, 2.0, -1.0, 0.5])
    generator = np.zeros((4, 4))
    generator[:3, :3], generator[:3, 3] = skew(xi[:3]), xi[3:]
    series, term = np.eye(4), np.eye(4)
    for k in range(1, 40):
        term = term @ generator / k
        series = series + term
    np.testing.assert_allclose(Rigid3.exp(xi).matrix(), series, atol=1e-14)


@given(transforms(), rotation_vectors(), axes())
def test_adjoint_moves_a_perturbation_to_the_other_side(a: Rigid3, vector: Array, translation: Array) -> None:
    xi = np.concatenate([vector, translation])
    assert_same(a @ Rigid3.exp(xi), Rigid3.exp(a.adjoint() @ xi) @ a, 1e-9)


@given(transforms(), transforms())
def test_adjoint_is_a_homomorphism(a: Rigid3, b: Rigid3) -> None:
    np.testing.assert_allclose((a @ b).adjoint(), a.adjoint() @ b.adjoint(), atol=1e-11)


@given(transforms(), transforms())
def test_local_and_retract_are_inverse(a: Rigid3, b: Rigid3) -> None:
    if rotation_angle(a.rotation.T @ b.rotation) < 3.1:
        assert_same(a.retract(a.local(b)), b, 1e-8)


@given(rotation_vectors())
def test_right_jacobian_by_finite_differences(vector: Array) -> None:
    step = 1e-6
    numeric = np.empty((3, 3))
    for k, unit in enumerate(np.eye(3)):
        plus, minus = exp_so3(vector + step * unit), exp_so3(vector - step * unit)
        numeric[:, k] = log_so3(minus.T @ plus) / (2.0 * step)
    np.testing.assert_allclose(right_jacobian_so3(vector), numeric, atol=1e-8)


def test_retract_keeps_the_rotation_orthonormal_over_many_steps() -> None:
    rng = np.random.default_rng(2)
    pose = Rigid3.identity()
    for _ in range(2000):
        pose = pose.retract(rng.normal(size=6))
    np.testing.assert_allclose(pose.rotation @ pose.rotation.T, np.eye(3), atol=1e-14)


def test_nearest_rotation_is_nearer_than_its_neighbours_and_never_a_reflection() -> None:
    rng = np.random.default_rng(3)
    for _ in range(20):
        matrix = rng.normal(size=(3, 3))
        nearest = nearest_rotation(matrix)
        assert np.linalg.det(nearest) == pytest.approx(1.0)
        distance = np.linalg.norm(matrix - nearest)
        for change in 1e-3 * rng.normal(size=(10, 3)):
            assert np.linalg.norm(matrix - nearest @ exp_so3(change)) >= distance
