"""A problem of images as a block of stations: the same solution and covariances where every image is a station."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from georef.estimation.adjustment.posterior import posteriors
from georef.estimation.adjustment.solve import solve

from georef.estimation.adjustment.block import KINDS_OF_POINT
from georef.estimation.adjustment.cofactors import cofactors
from georef.estimation.adjustment.eliminate import normal_equations
from georef.estimation.adjustment.from_problem import Exposure, block_of
from georef.estimation.adjustment.problem import Problem
from georef.estimation.adjustment.reference_part import ReferencePart
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


def test_images_by_themselves_are_solved_as_before() -> None:
    problem = _problem(3)
    before = solve(problem, cauchy_scale=None, max_iterations=50)
    whole = block_of(problem, [None] * len(problem.image_ids))
    after = solve_block(whole)
    assert after.converged
    for index, pose in enumerate(whole.world_from_cam(after.state).to_list()):
        assert np.abs(before.world_from_cams[index].local(pose)).max() < 1e-6
    known, with_references = posteriors(problem, before)
    lin = normal_equations(whole, after.state)
    found = cofactors(lin.reduced)
    scale = np.sqrt(np.diag(known.poses))
    size = 6 * len(problem.image_ids)
    ours = found.joint(np.arange(size))
    assert np.abs((ours - known.poses) / scale[:, None] / scale).max() < 1e-3  # the priors are linearised otherwise
    part = ReferencePart.of(whole, after.state, found)
    assert part is not None
    ours = part.cov(np.eye(found.layout.size)[:, :size]) / scale[:, None] / scale
    theirs = (with_references.poses - known.poses) / scale[:, None] / scale
    assert np.abs(ours - theirs).max() < 2e-3 * np.abs(theirs).max()
    control_rows = np.flatnonzero(whole.point_priors.kind == KINDS_OF_POINT.index("control"))
    shared = with_references.control_points - known.control_points
    assert np.allclose(part.of_given_points(whole, after.state, control_rows), shared, atol=2e-3 * shared.max())


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
