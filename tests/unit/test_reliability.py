"""Reliability: what is planted is found as often as Baarda's numbers say, and moves what they say."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import norm

from georef.estimation.adjustment.block import Block, State
from georef.estimation.adjustment.equations.cofactors import cofactors
from georef.estimation.adjustment.equations.constraint_terms import POSITION_PRIORS, RELATIVE_POSES
from georef.estimation.adjustment.equations.eliminate import normal_equations
from georef.estimation.adjustment.quality.group_tests import TermTests, constraint_tests, image_tests
from georef.estimation.adjustment.quality.reliability import DELTA0, Reliability, reliability
from georef.estimation.adjustment.solver import solve_block
from georef.geometry.rigid import Array
from tests.worlds.dense_normals import equations
from tests.worlds.rig_blocks import rig_block


def _tests(block: Block, state: State) -> dict[str, TermTests]:
    found = cofactors(normal_equations(block, state).reduced)
    return {t.name: t for t in constraint_tests(block, state, found, image_tests(block, state, found).points)}


@pytest.fixture(scope="module")
def solved() -> tuple[Block, State, dict[str, TermTests]]:
    block = rig_block(seed=4).block
    state = solve_block(block).state
    return block, state, _tests(block, state)


def test_delta0() -> None:
    assert pytest.approx(4.13, abs=0.005) == DELTA0


def test_against_the_dense_network(solved: tuple[Block, State, dict[str, TermTests]]) -> None:
    """Control points of three, two and one coordinates: everything from the one dense matrix."""
    block, state, tests = solved
    found, dense = reliability(block, state, tests["control"]), equations(block, state)
    qvv = np.eye(len(dense.residual)) - dense.design @ dense.inverse @ dense.design.T
    for k in range(len(found.ids)):
        for axis in range(3):
            information = block.point_priors.information[k, axis, axis]
            if information == 0.0:
                assert np.isnan(found.detectable[k, axis])
                continue
            row = [
                i
                for i in dense.rows("points", k)
                if dense.design[i, int(dense.point[block.point_priors.point[k]]) + axis]
            ]
            assert len(row) == 1
            number = qvv[row[0], row[0]]
            assert found.redundancy[k, axis] == pytest.approx(number, abs=1e-7)
            sigma = 1.0 / np.sqrt(information)
            assert found.detectable[k, axis] == pytest.approx(DELTA0 * sigma / np.sqrt(number), rel=1e-5)
            assert abs(found.w[k, axis]) == pytest.approx(abs(dense.residual[row[0]]) / np.sqrt(number), rel=1e-5)
            assert found.distortion[k, axis] == pytest.approx(DELTA0 * np.sqrt((1 - number) / number), rel=1e-5)


@pytest.mark.parametrize(("name", "component"), [("control", 1), (POSITION_PRIORS, 2), ("localized", 5)])
def test_a_bias_of_the_detectable_size(
    solved: tuple[Block, State, dict[str, TermTests]], name: str, component: int
) -> None:
    """It shifts w by delta0, so that a share of 1 - beta0 fails at alpha0, and the adjusted position by the effect."""
    block, state, tests = solved
    before = reliability(block, state, tests[name])
    k = 1
    bias: Array = np.zeros(3)
    bias[component % 3] = before.detectable[k, component]
    wrong = _shifted(block, name, tests[name].row[k], bias)
    after_state = solve_block(wrong, start=state).state
    after = reliability(wrong, after_state, _tests(wrong, after_state)[name])
    change = after.w[k, component] - before.w[k, component]
    assert abs(change) == pytest.approx(DELTA0, rel=0.05)
    assert norm.sf(norm.ppf(0.9995) - abs(change)) == pytest.approx(0.80, abs=0.1)
    moved = (after.residual - before.residual)[k, -3:] + bias
    if name == "localized":  # the residual of a pose bends with its rotation
        image = int(block.pose_priors.image[tests[name].row[k]])
        moved = (block.world_from_cam(after_state).translation - block.world_from_cam(state).translation)[image]
    assert np.linalg.norm(moved) == pytest.approx(before.effect[k, component], rel=0.05)


def _shifted(block: Block, name: str, row: int, bias: Array) -> Block:
    def moved(positions: Array) -> Array:
        out = positions.copy()
        out[row] += bias
        return out

    if name == POSITION_PRIORS:
        return replace(
            block, position_priors=replace(block.position_priors, position=moved(block.position_priors.position))
        )
    if name == "control":
        return replace(block, point_priors=replace(block.point_priors, position=moved(block.point_priors.position)))
    poses = block.pose_priors.world_from_cam
    return replace(
        block,
        pose_priors=replace(block.pose_priors, world_from_cam=replace(poses, translation=moved(poses.translation))),
    )


def test_what_nothing_checks_has_no_detectable_bias() -> None:
    """One station with one position and nothing else to fix it there."""
    block = rig_block(seed=4).block
    alone = replace(
        block,
        pose_priors=block.pose_priors.take(np.arange(len(block.pose_priors)) == 0),
        point_priors=block.point_priors.take(np.zeros(len(block.point_priors), bool)),
        position_priors=block.position_priors.take(np.zeros(len(block.position_priors), bool)),
        drift_information=np.tile(np.eye(3), (2, 1, 1)),
        antennas=(),
    )
    state = solve_block(alone).state
    found: Reliability = reliability(alone, state, _tests(alone, state)["localized"])
    assert np.isinf(found.detectable[0, 3:]).all()
    assert (found.redundancy[0, 3:] < 0.01).all()


def test_along_other_axes(solved: tuple[Block, State, dict[str, TermTests]]) -> None:
    """Axes that are exchanged exchange the numbers, those of rotations as well."""
    block, state, tests = solved
    cycled = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
    for name in ("control", POSITION_PRIORS, "localized"):
        plain = reliability(block, state, tests[name])
        turned = reliability(block, state, tests[name], lambda places: np.tile(cycled, (len(places), 1, 1)))
        order = [1, 2, 0] if plain.w.shape[1] == 3 else [1, 2, 0, 4, 5, 3]
        for part in ("residual", "redundancy", "w", "detectable", "sigma"):
            assert getattr(turned, part) == pytest.approx(getattr(plain, part)[:, order], rel=1e-6, nan_ok=True), part
        assert plain.place == pytest.approx(turned.place)


def test_other_kinds_are_refused(solved: tuple[Block, State, dict[str, TermTests]]) -> None:
    block, state, tests = solved
    with pytest.raises(KeyError, match="relative poses"):
        reliability(block, state, tests[RELATIVE_POSES])
