"""A small block with planted blunders of every kind is adjusted as if they were not there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from georef.errors import GeorefError
from georef.estimation.adjustment.adjust_block import AdjustedBlock, BlockOptions, adjust_block, quality
from georef.estimation.adjustment.block import Block, PointPriors, PosePriors, PositionPriors
from georef.estimation.adjustment.blunders.coherent import CoherentBlock, CoherentSearch
from georef.estimation.adjustment.blunders.coherent_members import settled
from georef.estimation.adjustment.blunders.shift_rows import ShiftRows, shift_system
from georef.estimation.adjustment.blunders.shift_system import ShiftSystem
from georef.estimation.adjustment.equations.constraint_terms import POSITION_PRIORS
from georef.estimation.adjustment.equations.eliminate import IMAGE_OBSERVATIONS, normal_equations
from georef.estimation.adjustment.solver import solve_block
from tests.worlds.rig_blocks import RigBlock, rig_block

_WRONG_IMAGES = np.arange(5, 400, 40)


@pytest.fixture(scope="module")
def clean() -> tuple[RigBlock, AdjustedBlock]:
    world = rig_block(seed=7)
    return world, adjust_block(world.block, BlockOptions.of(2.0))


@pytest.fixture(scope="module")
def planted(clean: tuple[RigBlock, AdjustedBlock]) -> AdjustedBlock:
    return adjust_block(_spoilt(clean[0].block), BlockOptions.of(2.0))


def _spoilt(block: Block) -> Block:
    """Ten image observations 8 px off, a control point 0.1 m, a GNSS position 0.6 m."""
    pixel, position = block.observations.pixel.copy(), block.position_priors.position.copy()
    pixel[_WRONG_IMAGES, 0] += 8.0
    position[2, 1] += 0.6
    control = block.point_priors.position.copy()
    control[0, 0] += 0.1
    return replace(
        block,
        observations=replace(block.observations, pixel=pixel),
        position_priors=replace(block.position_priors, position=position),
        point_priors=replace(block.point_priors, position=control),
    )


def test_good_observations_stay(clean: tuple[RigBlock, AdjustedBlock]) -> None:
    world, adjusted = clean
    assert adjusted.dropped <= 3
    assert len(adjusted.rejected) <= 1
    assert not adjusted.wrong
    assert adjusted.sigma_scale == pytest.approx(1.0, abs=0.1)
    assert adjusted.solution.converged
    error = adjusted.solution.state.world_from_rig.local(world.truth.world_from_rig)
    cov = adjusted.quality.cofactors.stations
    nees = np.einsum("ki,kij,kj->", error, np.linalg.inv(cov), error) / error.size
    assert 0.3 < nees < 2.5


def test_planted_blunders_are_named(planted: AdjustedBlock, clean: tuple[RigBlock, AdjustedBlock]) -> None:
    found = {(r.kind, r.name) for r in planted.rejected}
    assert ("control", "GCP0") in found
    assert (POSITION_PRIORS, clean[0].block.station_ids[clean[0].block.position_priors.station[2]]) in found
    assert len(found) <= 3
    assert all(r.statistic > 10.0 and r.dof > 0 for r in planted.rejected)
    given, kept = clean[0].block.observations, planted.block.observations
    left = set(zip(kept.view.tolist(), kept.point.tolist(), strict=True))
    wrong = zip(given.view[_WRONG_IMAGES].tolist(), given.point[_WRONG_IMAGES].tolist(), strict=True)
    assert len(left & set(wrong)) <= 1  # one lies along the only other ray of its point
    assert planted.dropped <= len(_WRONG_IMAGES) + 3


def test_as_good_as_without_the_blunders(planted: AdjustedBlock, clean: tuple[RigBlock, AdjustedBlock]) -> None:
    """Against the solution of what is right: 15 % of its error is the whole difference allowed."""
    world, _ = clean
    good = ~np.isin(np.arange(len(world.block.observations)), _WRONG_IMAGES)
    keep = np.arange(len(world.block.position_priors)) != 2
    oracle = replace(
        world.block,
        observations=world.block.observations.take(good),
        position_priors=world.block.position_priors.take(keep),
        point_priors=world.block.point_priors.take(np.arange(len(world.block.point_priors)) != 0),
    )
    truth = world.truth.world_from_rig.translation
    errors = [
        float(np.sqrt(np.mean(np.square(state.world_from_rig.translation - truth))))
        for state in (planted.solution.state, solve_block(oracle).state)
    ]
    assert errors[0] < 1.15 * errors[1] + 1e-4


def test_image_sigma_is_brought_to_the_residuals() -> None:
    block = rig_block(seed=8).block
    observations = replace(block.observations, sigma_px=block.observations.sigma_px * 3.0)
    adjusted = adjust_block(replace(block, observations=observations), BlockOptions.of(2.0))
    assert adjusted.sigma_scale == pytest.approx(1 / 3, rel=0.08)
    assert adjusted.quality.components[IMAGE_OBSERVATIONS].factor == pytest.approx(1.0, abs=0.08)


def test_no_datum_ends_with_words() -> None:
    block = rig_block(seed=7).block
    loose = replace(
        block,
        pose_priors=PosePriors.none(),
        position_priors=PositionPriors.none(),
        point_priors=PointPriors.none(),
        antennas=(),
        drift_information=np.zeros((0, 3, 3)),
    )
    with pytest.raises(GeorefError):
        quality(loose, loose.start())


def test_shifts_of_poses_against_adding_them_as_unknowns(clean: tuple[RigBlock, AdjustedBlock]) -> None:
    """A planted shift of one station's poses is estimated where it was planted, with the covariance of that."""
    block, state = clean[1].block, clean[1].solution.state
    planted = np.array([0.3, -0.2, 0.1])
    poses = block.pose_priors.world_from_cam

    def system_of(case: Block) -> ShiftSystem:
        lin, none = normal_equations(case, state), np.zeros(0, np.int64)
        rows = np.flatnonzero(case.pose_priors.kind == 0)
        tested = ShiftRows(rows, case.station[case.pose_priors.image[rows]], none, none)
        return shift_system(case, state, quality(case, state).cofactors, lin.reduced.gradient, tested)

    before = system_of(block)
    chosen = np.isin(np.arange(len(poses)), before.poses.row[before.poses.segment == 0])
    moved = replace(poses, translation=poses.translation + np.where(chosen[:, None], planted, 0.0))
    after = system_of(replace(block, pose_priors=replace(block.pose_priors, world_from_cam=moved)))
    design = np.eye(len(before))[:, :1]
    (shift,), cov, _ = before.estimate(design)
    (with_planted,), _, _ = after.estimate(design)
    assert np.allclose(with_planted - shift, planted, atol=2e-3)
    assert shift @ np.linalg.solve(cov, shift) < 16.3


def test_a_right_pose_in_a_named_block_is_taken_back(clean: tuple[RigBlock, AdjustedBlock]) -> None:
    """A block that names a wrong pose and a right one keeps the wrong one."""
    block, state = clean[1].block, clean[1].solution.state
    shift = np.array([0.5, 0.0, 0.2])
    poses = block.pose_priors.world_from_cam
    moved = poses.translation.copy()
    moved[0] += shift
    spoilt = replace(block, pose_priors=replace(block.pose_priors, world_from_cam=replace(poses, translation=moved)))
    lacking = replace(block, pose_priors=block.pose_priors.take(np.arange(len(poses)) > 1))
    none = np.zeros(0, np.int64)
    named = CoherentBlock(("s0", "s1"), np.array([0, 1]), none, (), shift, 1e-4 * np.eye(3), 100.0, 0.1)
    found = quality(lacking, state)
    search = settled(CoherentSearch((named,), False), spoilt, state, found.cofactors, found.images.points)
    assert [wrong.poses.tolist() for wrong in search.blocks] == [[0]]
    assert search.blocks[0].station_ids == (block.station_ids[block.station[block.pose_priors.image[0]]],)
