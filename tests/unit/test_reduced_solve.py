"""Steps from kept factors: they solve the equations at hand, and a singular network is not taken for a regular one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from georef.estimation.adjustment.equations.block_cholesky import Pattern, SingularMatrix
from georef.estimation.adjustment.equations.block_equations import BlockEquations, moved_state
from georef.estimation.adjustment.equations.reduced import Reduced
from georef.estimation.adjustment.equations.reduced_solve import ReducedFactor, StepSolver, conjugate_gradients, product
from georef.estimation.adjustment.solver import SolverOptions, promised_decrease, solve_block
from georef.geometry.rigid import Array
from tests.worlds.rig_blocks import rig_block


def _reduced() -> Reduced:
    block = rig_block(1).block
    return BlockEquations(block).linearized(block.start(), 0.0).reduced


def _like(reduced: Reduced, change: float) -> Reduced:
    """Equations whose diagonals are larger by parts of up to `change`."""
    rng, blocks, corner = np.random.default_rng(0), reduced.block.copy(), reduced.corner.copy()
    six, own, edge = np.arange(6), reduced.first[:-1, None], np.arange(len(corner))
    blocks[own, six, six] *= 1.0 + change * rng.random((len(reduced.first) - 1, 6))
    corner[edge, edge] *= 1.0 + change * rng.random(len(corner))
    return replace(reduced, block=blocks, corner=corner)


def _off(reduced: Reduced, added: Array, step: Array) -> float:
    """Largest error of a step in units of the unknowns' sigmas at it."""
    matrix = reduced.dense() + np.diag(added)
    sigma = 1.0 / np.sqrt(np.diag(matrix))
    exact = -np.linalg.solve(matrix * sigma[:, None] * sigma, reduced.gradient * sigma) * sigma
    return float(np.abs((step - exact) / sigma).max() / np.abs(exact / sigma).max())


def test_product_is_that_of_the_dense_matrix() -> None:
    reduced = _reduced()
    vector = np.random.default_rng(0).normal(size=reduced.layout.size)
    expected = reduced.dense() @ vector
    assert np.allclose(product(reduced, vector), expected, rtol=0, atol=1e-12 * np.abs(expected).max())


def test_a_factor_solves_its_own_equations() -> None:
    reduced = _reduced()
    added = 1e-3 * np.concatenate([np.full(6 * reduced.layout.stations, 2.0), np.diag(reduced.corner)])
    assert reduced.layout.border
    step = -ReducedFactor.of(reduced, Pattern.of(reduced.first, reduced.column), added).solve(reduced.gradient)
    assert _off(reduced, added, step) < 1e-9


def test_like_equations_are_solved_with_a_kept_factor() -> None:
    reduced = _reduced()
    none = np.zeros(reduced.layout.size)
    factor = ReducedFactor.of(reduced, Pattern.of(reduced.first, reduced.column), none)
    other = _like(reduced, 1e-3)
    found = conjugate_gradients(other, none, -other.gradient, factor, 30)
    assert found is not None
    assert _off(other, none, found) < 1e-5
    assert _off(other, none, -factor.solve(other.gradient)) > 1e-4
    assert conjugate_gradients(other, none, -other.gradient, factor, 1) is None


def test_factors_are_made_only_where_they_must(monkeypatch: pytest.MonkeyPatch) -> None:
    reduced = _reduced()
    none, damped = np.zeros(reduced.layout.size), np.full(reduced.layout.size, 1e-6)
    made: list[float] = []
    real = ReducedFactor.of
    monkeypatch.setattr(ReducedFactor, "of", lambda r, p, a: (made.append(float(a.max())), real(r, p, a))[1])
    solver = StepSolver(Pattern.of(reduced.first, reduced.column))
    solver.most_steps = 30
    steps = [solver.step(reduced, added) for added in (damped, damped, none, none)]
    assert made == [1e-6, 0.0]
    near = _like(reduced, 1e-3)
    assert _off(near, none, solver.step(near, none)) < 1e-5
    assert made == [1e-6, 0.0]
    far = replace(near, block=_like(reduced, 1e6).block)
    assert _off(far, none, solver.step(far, none)) < 1e-9
    assert made == [1e-6, 0.0, 0.0]
    assert max(_off(reduced, none, step) for step in steps[2:]) < 1e-5


def test_a_damped_factor_does_not_hide_that_nothing_fixes_an_unknown() -> None:
    reduced = _reduced()
    blocks, border, gradient = reduced.block.copy(), reduced.border.copy(), reduced.gradient.copy()
    row = np.repeat(np.arange(reduced.layout.stations), np.diff(reduced.first))
    blocks[row == 2, 4, :] = 0.0
    blocks[reduced.column == 2, :, 4] = 0.0
    border[16], gradient[16] = 0.0, 0.0
    open_one = replace(reduced, block=blocks, border=border, gradient=gradient)
    solver = StepSolver(Pattern.of(reduced.first, reduced.column))
    solver.most_steps = 30
    solver.step(open_one, np.full(reduced.layout.size, 1e-3))
    with pytest.raises(SingularMatrix) as caught:
        solver.step(open_one, np.zeros(reduced.layout.size))
    assert caught.value.unknown == 16


@pytest.mark.parametrize("losses", [{}, {"image observations": 2.0, "pose priors": 3.0}], ids=["squares", "cauchy"])
def test_what_a_small_step_promises_it_keeps(losses: dict[str, float]) -> None:
    """Strong damping makes steps so short that the cost falls as its linear model says."""
    block = rig_block(1, disturbed=0.3).block
    equations, state, damping = BlockEquations(block, losses), block.start(), 1e4
    lin = equations.linearized(state, damping)
    added = damping * lin.diagonal
    step = -ReducedFactor.of(lin.reduced, equations.pattern, added).solve(lin.reduced.gradient)
    moved = equations.moved(state, step, damping)
    promised = promised_decrease(lin.gain, lin.reduced.gradient, lin.diagonal, step, damping, moved)
    assert promised > 1e-5 * lin.cost
    assert (lin.cost - moved.cost) / promised == pytest.approx(1.0, abs=2e-3)


def test_near_the_solution_one_step_is_enough_for_points_as_well() -> None:
    """Mountings and calibrations move too: points that are found again without these stay beside their best places."""
    block = rig_block(1).block
    assert any(m.information is not None for m in block.mountings)
    assert any(c.camera.estimate for c in block.calibrations)
    best = solve_block(block, options=SolverOptions(step_tolerance=1e-10)).state
    rng = np.random.default_rng(2)
    equations = BlockEquations(block)
    away = moved_state(equations.layout, best, 1e-5 * rng.normal(size=equations.layout.size))
    lin = equations.linearized(away, 0.0)
    step = -ReducedFactor.of(lin.reduced, equations.pattern, np.zeros(len(lin.diagonal))).solve(lin.reduced.gradient)
    moved = equations.moved(away, step, 0.0)
    promised = promised_decrease(lin.gain, lin.reduced.gradient, lin.diagonal, step, 0.0, moved)
    assert (lin.cost - moved.cost) / promised == pytest.approx(1.0, abs=1e-3)
    assert np.abs(moved.state.points - best.points).max() < 1e-6
