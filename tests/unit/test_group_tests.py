"""Tests of groups against the plain way: all observation equations in one dense matrix."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from georef.estimation.adjustment.block import Block, State
from georef.estimation.adjustment.equations.cofactors import cofactors
from georef.estimation.adjustment.equations.constraint_terms import POSE_PRIORS, POSITION_PRIORS, constraint_terms
from georef.estimation.adjustment.equations.eliminate import IMAGE_OBSERVATIONS, normal_equations
from georef.estimation.adjustment.quality.group_tests import components, constraint_tests, image_tests, joint_test
from georef.estimation.adjustment.solver import solve_block
from tests.worlds.dense_normals import Equations, equations
from tests.worlds.rig_blocks import rig_block


@pytest.fixture(scope="module")
def world() -> tuple[Block, State, Equations]:
    made = rig_block(seed=3)
    return made.block, made.truth, equations(made.block, made.truth)


def _cofactor(found: Equations, rows: list[int]) -> np.ndarray:
    design = found.design[rows]
    return np.eye(len(rows)) - design @ found.inverse @ design.T


def test_image_observations(world: tuple[Block, State, Equations]) -> None:
    block, state, found = world
    tests = image_tests(block, state, cofactors(normal_equations(block, state).reduced))
    for k in range(0, len(block.observations), 7):
        rows = found.rows("image", k)
        cofactor = _cofactor(found, rows)
        assert tests.redundancy[k] == pytest.approx(np.trace(cofactor), abs=1e-8)
        values, vectors = np.linalg.eigh(cofactor)
        use = values > 0.05
        along = vectors.T @ found.residual[rows]
        assert tests.dof[k] == use.sum()
        assert tests.statistic[k] == pytest.approx(float(np.sum(along[use] ** 2 / values[use])), rel=1e-6)


def test_points(world: tuple[Block, State, Equations]) -> None:
    block, state, found = world
    tests = image_tests(block, state, cofactors(normal_equations(block, state).reduced))
    inverse = found.inverse
    for point, at in enumerate(found.point):
        expected = inverse[at : at + 3, at : at + 3]
        assert np.allclose(tests.points[point], expected, rtol=1e-7, atol=1e-7 * np.abs(expected).max())


def test_constraints_one_by_one(world: tuple[Block, State, Equations]) -> None:
    block, state, found = world
    inverse = cofactors(normal_equations(block, state).reduced)
    names = {"localized": POSE_PRIORS, "orientation": POSE_PRIORS, "control": "points", "automatic": "points"}
    tests = constraint_tests(block, state, inverse, image_tests(block, state, inverse).points)
    assert len(tests) >= 8
    for test in tests:
        for k, row in enumerate(test.row):
            rows = found.rows(names.get(test.name, test.name), int(row))
            rows = [i for i in rows if found.design[i].any()]
            cofactor = _cofactor(found, rows)
            assert test.redundancy[k] == pytest.approx(np.trace(cofactor), abs=1e-7)
            values, vectors = np.linalg.eigh(cofactor)
            use, along = values > 0.05, vectors.T @ found.residual[rows]
            assert test.dof[k] == use.sum()
            assert test.statistic[k] == pytest.approx(float(np.sum(along[use] ** 2 / values[use])), rel=1e-6, abs=1e-9)


def test_redundancies_add_up(world: tuple[Block, State, Equations]) -> None:
    block, state, found = world
    inverse = cofactors(normal_equations(block, state).reduced)
    images = image_tests(block, state, inverse)
    groups = components(block, state, images, constraint_tests(block, state, inverse, images.points))
    weighted = int(np.any(found.design != 0, axis=1).sum())
    assert sum(group.observations for group in groups.values()) == weighted
    total = sum(group.redundancy for group in groups.values())
    assert total == pytest.approx(weighted - found.design.shape[1], abs=1e-6)
    squares = sum(group.squares for group in groups.values())
    assert squares == pytest.approx(float(found.residual @ found.residual), rel=1e-9)


def test_joint_group(world: tuple[Block, State, Equations]) -> None:
    block, state, found = world
    inverse = cofactors(normal_equations(block, state).reduced)
    terms = {term.name: term for term in constraint_terms(block, state)}
    chosen = [(terms[POSE_PRIORS], np.array([0, 2])), (terms[POSITION_PRIORS], np.array([1]))]
    statistic, dof = joint_test(chosen, inverse)
    rows = [row for term, picked in chosen for k in picked for row in found.rows(term.name, int(term.row[k]))]
    values, vectors = np.linalg.eigh(_cofactor(found, rows))
    use, along = values > 0.05, vectors.T @ found.residual[rows]
    assert dof == use.sum()
    assert statistic == pytest.approx(float(np.sum(along[use] ** 2 / values[use])), rel=1e-6)


def test_stations_matter_where_observations_are_few(world: tuple[Block, State, Equations]) -> None:
    """With stations held the redundancies are too large: what the stations take up is missing."""
    block, state, _ = world
    inverse = cofactors(normal_equations(block, state).reduced)
    held = replace(
        inverse,
        pair=np.zeros_like(inverse.pair),
        station_border=np.zeros_like(inverse.station_border),
        border=np.zeros_like(inverse.border),
    )
    both = [image_tests(block, state, part).redundancy for part in (inverse, held)]
    assert (both[1] - both[0] > -1e-9).all()
    assert both[1].sum() - both[0].sum() > 20.0


def test_planted_image_blunder_fails(world: tuple[Block, State, Equations]) -> None:
    block = world[0]
    pixel = block.observations.pixel.copy()
    pixel[11] += 5.0
    wrong = replace(block, observations=replace(block.observations, pixel=pixel))
    solved = solve_block(wrong, losses={IMAGE_OBSERVATIONS: 2.0}).state
    tests = image_tests(wrong, solved, cofactors(normal_equations(wrong, solved).reduced))
    assert tests.rejected(0.999)[11]
    assert tests.rejected(0.999).sum() < 12
    assert 0.8 < tests.scale < 1.2
