"""A block in parts, held by one process or several: the solution of the whole, to rounding."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from georef.errors import GeorefError
from georef.estimation.adjustment.adjust_block import BlockOptions, adjust_block
from georef.estimation.adjustment.block import Block, PosePriors, PositionPriors
from georef.estimation.adjustment.campaign.partition import part_of, partition
from georef.estimation.adjustment.campaign.partitioned import Partitioned
from georef.estimation.adjustment.solver import BlockSolution, SolverOptions, solve_block
from georef.executor import Executor
from georef.simulate.drive import DriveDesign, simulate_drive
from tests.worlds.rig_blocks import rig_block


@pytest.fixture(scope="module")
def drive() -> Block:
    return simulate_drive(DriveDesign(stations=60, observations=12_000, seed=3)).block


def _apart(a: BlockSolution, b: BlockSolution) -> float:
    """The largest difference of stations (m, rad) and points (m)."""
    stations = np.abs(a.state.world_from_rig.local(b.state.world_from_rig)).max()
    mountings = np.abs(a.state.rig_from_cam.local(b.state.rig_from_cam)).max()
    return float(max(stations, mountings, np.abs(a.state.points - b.state.points).max()))


def test_parts_share_nothing_but_separators(drive: Block) -> None:
    cut = partition(drive, 3, drive.world_from_rig.translation)
    obs = drive.observations
    inside = ~cut.separator[drive.station[obs.view]]
    pairs = np.unique(np.stack([obs.point[inside], cut.part[drive.station[obs.view]][inside]], axis=1), axis=0)
    assert len(np.unique(pairs[:, 0])) == len(pairs)
    parts = [part_of(drive, cut, index) for index in range(3)]
    assert sum(len(part.block.observations) for part in parts) == len(obs)
    assert sum(len(part.block.position_priors) for part in parts) == len(drive.position_priors)
    assert sum(len(part.block.point_priors) for part in parts) == len(drive.point_priors)
    assert sum(part.inner for part in parts) + len(cut.separators) == len(drive.station_ids)
    assert max(len(part.block.observations) for part in parts) < 0.6 * len(obs)
    assert 0 < len(cut.separators) < 40


@pytest.mark.parametrize("parts", [1, 2, 3, 5])
def test_the_solution_is_that_of_the_whole(drive: Block, parts: int) -> None:
    whole = solve_block(drive)
    with Executor().held() as held:
        found = Partitioned(held, parts)(drive)
    assert _apart(found, whole) < 1e-9
    assert found.iterations == whole.iterations
    assert found.cost == pytest.approx(whole.cost, rel=1e-12)


@pytest.mark.parametrize("parts", [2, 3])
def test_every_kind_of_constraint_counts_once(parts: int) -> None:
    """Measured motions, a scale bar, drift, lever arm, boresight and calibration; robust as well."""
    block = rig_block(5).block
    for losses in ({}, {"image observations": 2.0, "gnss": 2.0, "control": 2.0}):
        options = SolverOptions(step_tolerance=1e-10)
        whole = solve_block(block, losses=losses, options=options)
        with Executor().held() as held:
            found = Partitioned(held, parts)(block, losses=losses, options=options)
        # Reweighting closes in by half an iteration: where it stops is a matter of the last digits.
        assert _apart(found, whole) < (1e-8 if losses else 1e-9)
        assert found.cost == pytest.approx(whole.cost, rel=1e-11)


def test_processes_that_keep_their_parts(drive: Block) -> None:
    whole = adjust_block(drive, BlockOptions.of(2.0))
    for workers in (2, 3):
        with Executor(workers=workers).held() as held:
            found = adjust_block(drive, BlockOptions.of(2.0), solve=Partitioned(held, workers))
        assert _apart(found.solution, whole.solution) < 1e-9
        assert found.dropped == whole.dropped
        assert [r.name for r in found.rejected] == [r.name for r in whole.rejected]


def test_what_is_not_determined_is_named(drive: Block) -> None:
    loose = replace(
        drive,
        pose_priors=PosePriors.none(),
        position_priors=PositionPriors.none(),
        point_priors=drive.point_priors.take(np.zeros(len(drive.point_priors), bool)),
    )
    with Executor().held() as held, pytest.raises(GeorefError, match="no unique solution"):
        Partitioned(held, 2)(loose)
