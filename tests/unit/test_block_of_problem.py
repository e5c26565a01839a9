"""A problem of images as a block of stations: the same solution and covariances where every image is a station."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from georef.estimation.adjustment.equations.cofactors import cofactors
from georef.estimation.adjustment.equations.eliminate import normal_equations
from georef.estimation.adjustment.from_problem import Exposure, block_of
from georef.estimation.adjustment.gtsam_reference.graph import solve_with_gtsam
from georef.estimation.adjustment.problem import Problem
from georef.estimation.adjustment.quality.reference_part import ReferencePart
from georef.estimation.adjustment.solver import solve_block
from georef.geometry.rigid import Rigid3
from georef.types.campaign import Mounting
from tests.worlds.blocks import block, control, gnss, pose_priors


def _problem(seed: int) -> Problem:
    made = block(seed)
    rng = np.random.default_rng(seed)
    fixes = gnss(made.world, rng, 0.05)
    priors = {1: pose_priors(made.world, rng)[1]}
    return replace(made.problem, position_priors=fixes, pose_priors=priors, control=control(made.world, rng))


def test_images_by_themselves_are_solved_as_by_gtsam() -> None:
    """Against the factor graph of the same block; and the places of the block's parts against the problem."""
    problem = _problem(3)
    whole = block_of(problem, [None] * len(problem.image_ids))
    after = solve_block(whole)
    before = solve_with_gtsam(whole, whole.start())
    assert after.converged
    assert before.converged
    assert after.cost == pytest.approx(before.cost, rel=1e-9)
    assert np.abs(before.state.world_from_rig.local(after.state.world_from_rig)).max() < 1e-6
    assert np.abs(before.state.points - after.state.points).max() < 1e-5
    assert whole.image_ids == problem.image_ids
    assert whole.world_from_cam(whole.start()).to_list()[2].translation == pytest.approx(
        problem.world_from_cams[2].translation
    )
    assert len(whole.points) == len(problem.points) + len(problem.control)
    assert set(whole.point_priors.point_ids[len(problem.gcps) :]) == {point.point_id for point in problem.control}
    assert whole.position_priors.station.tolist() == list(problem.position_priors)
    assert whole.pose_priors.image.tolist() == [1]


def test_images_of_a_rig_share_a_station() -> None:
    problem = _problem(4)
    poses = problem.world_from_cams
    mountings = [
        Mounting("left", Rigid3.identity()),
        Mounting("right", poses[0].inverse() @ poses[1], np.eye(6) * 1e-6),
    ]
    whole = block_of(problem, [Exposure("0", mountings[0]), Exposure("0", mountings[1]), None, None])
    assert whole.station.tolist() == [0, 0, 1, 2]
    assert [m.name for m in whole.mountings] == ["left", "right", "alone"]
    start = whole.world_from_cam(whole.start())
    for index in range(4):
        assert np.allclose(start[index].matrix(), poses[index].matrix(), atol=1e-9)
    solution = solve_block(whole)
    assert solution.converged
    lin = normal_equations(whole, solution.state)
    found = cofactors(lin.reduced)
    part = ReferencePart.of(whole, solution.state, found)
    assert part is not None
    added = part.cov(np.eye(found.layout.size))
    assert np.linalg.eigvalsh(added).min() > -1e-12
    assert added[:6, :6].max() > 0.0
