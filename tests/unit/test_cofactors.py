"""The selected inverse against the dense one, gtsam.Marginals and Monte Carlo."""

from __future__ import annotations

from typing import Any, cast

import gtsam
import numpy as np
import pytest
from scipy.stats import chi2

from georef.estimation.adjustment.equations.block_cholesky import BlockCholesky, Pattern, SingularMatrix
from georef.estimation.adjustment.equations.cofactors import Cofactors, cofactors
from georef.estimation.adjustment.equations.reduced import Layout, Reduced
from georef.geometry.rigid import Array
from tests.worlds.dense_normals import Equations, equations, reduced_of, sparse
from tests.worlds.rig_blocks import rig_block

_NONE = np.zeros(0, np.int64)


def _chain(stations: int, border: int, seed: int = 0) -> tuple[Reduced, Array]:
    """Random normal equations of a loop of stations with some neighbours each, units as unlike as rad and m."""
    rng = np.random.default_rng(seed)
    unit = np.concatenate([np.tile([3e3, 3e3, 3e3, 1.0, 1.0, 1.0], stations), 10.0 ** rng.integers(-2, 4, border)])
    rows = []
    for i in range(stations):
        for step in (1, 2, 5):
            row = np.zeros((6, len(unit)))
            for station in (i, (i + step) % stations):
                row[:, 6 * station : 6 * station + 6] += rng.normal(size=(6, 6))
            row[:, 6 * stations :] = rng.normal(size=(6, border)) * (rng.random(border) < 0.4)
            rows.append(row)
    design = np.concatenate(rows) * unit
    layout = Layout(stations, _NONE, _NONE, _NONE, _NONE, _NONE, border)
    normal = design.T @ design
    return sparse(layout, normal, rng.normal(size=len(unit))), normal


def _relative(found: Array, expected: Array, sigma_a: Array, sigma_b: Array) -> float:
    return float(np.abs((found - expected) / (sigma_a[..., :, None] * sigma_b[..., None, :])).max(initial=0.0))


def _dense_inverse(normal: Array) -> Array:
    scale = 1.0 / np.sqrt(np.diag(normal))
    return np.linalg.inv(normal * scale[:, None] * scale) * scale[:, None] * scale


@pytest.mark.parametrize(("stations", "border"), [(1, 0), (2, 3), (12, 0), (60, 7), (150, 20)])
def test_equal_to_the_dense_inverse(stations: int, border: int) -> None:
    reduced, normal = _chain(stations, border)
    found, inverse = cofactors(reduced), _dense_inverse(normal)
    sigma = np.sqrt(np.diag(inverse))
    by_station, edge = sigma[: 6 * stations].reshape(-1, 6), 6 * stations
    row = np.repeat(np.arange(stations), np.diff(reduced.first))
    blocks = inverse[:edge, :edge].reshape(stations, 6, stations, 6)
    expected = blocks[row, :, reduced.column, :]
    assert _relative(found.pair, expected, by_station[row], by_station[reduced.column]) < 1e-10
    assert _relative(found.station_border, inverse[:edge, edge:], sigma[:edge], sigma[edge:]) < 1e-10
    assert _relative(found.border, inverse[edge:, edge:], sigma[edge:], sigma[edge:]) < 1e-10
    some = np.array([0, edge - 1, *range(edge, edge + border)])
    assert _relative(found.joint(some), inverse[np.ix_(some, some)], sigma[some], sigma[some]) < 1e-10
    vector = np.random.default_rng(1).normal(size=len(sigma)) / sigma
    assert np.allclose(found.apply(vector) / sigma, inverse @ vector / sigma, rtol=0, atol=1e-9)


def test_blocks_between_any_unknowns() -> None:
    reduced, normal = _chain(20, 9)
    found, inverse = cofactors(reduced), _dense_inverse(normal)
    a = np.array([0, 12, 6, 30, -1, 120, 123, 36])
    b = np.array([6, 0, 120, 36, 0, 6, 120, 36])
    for k, block in enumerate(found.between(a, 6, b, 6)):
        there = a[k] >= 0 and b[k] >= 0
        expected = inverse[a[k] : a[k] + 6, b[k] : b[k] + 6] if there else np.zeros((6, 6))
        assert np.allclose(block, expected, rtol=1e-9, atol=1e-18)
    with pytest.raises(KeyError, match="joint"):
        found.between(np.array([0]), 6, np.array([6 * 10]), 6)


def test_pattern_serves_other_values() -> None:
    reduced, _ = _chain(40, 0, seed=1)
    other, normal = _chain(40, 0, seed=2)
    pattern = Pattern.of(reduced.first, reduced.column)
    inverse = _dense_inverse(normal)
    assert np.allclose(cofactors(other, pattern).stations[7], inverse[42:48, 42:48], rtol=1e-8)


def test_separate_parts_are_inverted_together() -> None:
    """Two chains that nothing connects: a forest of fronts."""
    _, one = _chain(8, 0, seed=1)
    _, two = _chain(9, 0, seed=2)
    normal = np.zeros((102, 102))
    normal[:48, :48], normal[48:, 48:] = one, two
    found = cofactors(sparse(Layout(17, *[_NONE] * 5, border=0), normal, np.zeros(102)))
    assert np.allclose(found.stations[12], _dense_inverse(normal)[72:78, 72:78], rtol=1e-8)


@pytest.mark.parametrize("unknown", [0, 21, 6 * 10 + 2])
def test_names_the_unknown_that_nothing_fixes(unknown: int) -> None:
    reduced, normal = _chain(10, 4)
    normal[unknown], normal[:, unknown] = 0.0, 0.0
    with pytest.raises(SingularMatrix) as caught:
        cofactors(sparse(reduced.layout, normal, reduced.gradient))
    assert caught.value.unknown == unknown


def test_no_datum_is_singular() -> None:
    """Relative observations alone: the last pivots vanish but for rounding."""
    rng = np.random.default_rng(0)
    design = np.zeros((6 * 30, 6 * 30))
    for i in range(30):
        turn = rng.normal(size=(6, 6))
        design[6 * i : 6 * i + 6, 6 * i : 6 * i + 6] = turn
        j = (i + 1) % 30
        design[6 * i : 6 * i + 6, 6 * j : 6 * j + 6] = -turn
    layout = Layout(30, *[_NONE] * 5, border=0)
    with pytest.raises(SingularMatrix):
        cofactors(sparse(layout, design.T @ design, np.zeros(180)))


def _small_world() -> tuple[Equations, Cofactors, Array]:
    world = rig_block()
    found = equations(world.block, world.truth)
    return found, cofactors(reduced_of(found)), found.inverse


def test_small_world_agrees_with_all_unknowns_inverted_together() -> None:
    found, reduced, inverse = _small_world()
    edge = 6 * found.layout.stations
    sigma = np.sqrt(np.diag(inverse))
    for station in range(found.layout.stations):
        own = slice(6 * station, 6 * station + 6)
        assert _relative(reduced.stations[station], inverse[own, own], sigma[own], sigma[own]) < 1e-10
    border = slice(edge, found.layout.size)
    assert _relative(reduced.border, inverse[border, border], sigma[border], sigma[border]) < 1e-10


def test_pose_of_an_image_includes_its_mounting() -> None:
    world = rig_block()
    found, reduced, inverse = _small_world()
    covs = reduced.images(world.block, world.truth)
    for image in (0, 1, 7):
        station, mounting = 6 * world.block.station[image], world.block.mounting[image]
        by = np.zeros((6, len(inverse)))
        by[:, station : station + 6] = world.truth.rig_from_cam[mounting].inverse().adjoint()
        if (first := found.layout.mounting[mounting]) >= 0:
            by[:, 6 * found.layout.stations + first :][:, :6] = np.eye(6)
        assert np.allclose(covs[image], by @ inverse @ by.T, rtol=1e-8, atol=1e-16)
    assert np.allclose(reduced.images(world.block, world.truth, np.array([7]))[0], covs[7])


def test_equal_to_gtsam_marginals() -> None:
    found, reduced, _ = _small_world()
    graph, values, size = gtsam.GaussianFactorGraph(), gtsam.VectorValues(), found.layout.size
    starts = [*range(0, 6 * found.layout.stations + 1, 6), *range(size, found.design.shape[1], 3)]
    ends = [*starts[1:], found.design.shape[1]]
    unit, factor = gtsam.noiseModel.Unit.Create(1), cast(Any, gtsam.JacobianFactor)
    for residual, row in zip(found.residual, found.design, strict=True):
        terms = [(key, row[None, a:b]) for key, (a, b) in enumerate(zip(starts, ends, strict=True)) if row[a:b].any()]
        if terms:  # a station, the border and a point, or two stations
            graph.add(factor(*(part for term in terms for part in term), -residual[None], unit))
    for key, (a, b) in enumerate(zip(starts, ends, strict=True)):
        values.insert(key, np.zeros(b - a))
    marginals = gtsam.Marginals(graph, values)
    for station in range(found.layout.stations):
        expected = marginals.marginalCovariance(station)
        sigma = np.sqrt(np.diag(expected))
        assert _relative(reduced.stations[station], expected, sigma, sigma) < 1e-7


def test_monte_carlo() -> None:
    """The spread of 200 linear estimates is what the covariances of stations say, to both sides."""
    found, reduced, inverse = _small_world()
    rng = np.random.default_rng(5)
    steps = -inverse @ found.design.T @ rng.normal(size=(len(found.residual), 200))
    for station in range(found.layout.stations):
        own = steps[6 * station : 6 * station + 6]
        squares = float(np.einsum("ik,ij,jk->", own, np.linalg.inv(reduced.stations[station]), own))
        low, high = chi2.ppf([1e-4, 1 - 1e-4], 6 * 200)
        assert low < squares < high


def test_factor_solves_one_and_many() -> None:
    reduced, normal = _chain(30, 0)
    factor = BlockCholesky.of(Pattern.of(reduced.first, reduced.column), reduced.block)
    right = np.random.default_rng(2).normal(size=(180, 3))
    assert np.allclose(normal @ factor.solve(right), right, atol=1e-8)
    assert np.allclose(factor.solve(right[:, 1]), factor.solve(right)[:, 1])
