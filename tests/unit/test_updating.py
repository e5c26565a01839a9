"""Images and control that are added to an adjusted drive: the full adjustment's answer, from what stands."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np
import pytest

from georef.estimation.adjustment.adjust_block import AdjustedBlock, BlockOptions, adjust_block
from georef.estimation.adjustment.block import KINDS_OF_POINT, Block
from georef.estimation.adjustment.campaign.standing import Standing, constraint_keys
from georef.estimation.adjustment.campaign.updating import updated
from georef.estimation.adjustment.solver import solve_block
from georef.simulate.drive import DriveDesign, simulate_drive
from georef.simulate.drive_blunders import DriveBlunders

_OPTIONS = BlockOptions.of(2.0)
_LATE = 150  # stations from here on to _LATE_END come later
_LATE_END = 156


@pytest.fixture(scope="module")
def campaign() -> Block:
    blunders = DriveBlunders(observations=0.01)
    return simulate_drive(DriveDesign(stations=200, observations=60_000, seed=5), blunders).block


@pytest.fixture(scope="module")
def full(campaign: Block) -> AdjustedBlock:
    return adjust_block(campaign, _OPTIONS)


def _without_stations(block: Block, late: range) -> Block:
    """The block before some stations were exposed: other numbers of stations, images and points."""
    stays = ~np.isin(np.arange(len(block.station_ids)), list(late))
    images = stays[block.station]
    obs = block.observations.take(images[block.observations.view])
    count = np.bincount(obs.point, minlength=len(block.points))
    given = block.point_priors.take(count[block.point_priors.point] > 0)
    points = count >= 2
    points[given.point] = True
    obs = obs.take(points[obs.point])
    station, image, point = (np.cumsum(mask) - 1 for mask in (stays, images, points))
    poses = block.pose_priors.take(images[block.pose_priors.image])
    fixes = block.position_priors.take(stays[block.position_priors.station])
    return replace(
        block,
        station_ids=tuple(np.array(block.station_ids)[stays].tolist()),
        image_ids=tuple(np.array(block.image_ids)[images].tolist()),
        station=station[block.station[images]],
        mounting=block.mounting[images],
        calibration=block.calibration[images],
        world_from_rig=block.world_from_rig.take(stays),
        points=block.points[points],
        observations=replace(obs, point=point[obs.point], view=image[obs.view]),
        pose_priors=replace(poses, image=image[poses.image]),
        position_priors=replace(fixes, station=station[fixes.station]),
        point_priors=replace(given, point=point[given.point]),
        reference_rays=None,
    )


def _apart_m(a: AdjustedBlock, b: AdjustedBlock) -> float:
    assert a.block.station_ids == b.block.station_ids
    local = a.solution.state.world_from_rig.local(b.solution.state.world_from_rig)
    return float(np.linalg.norm(local[:, 3:], axis=1).max())


def _anew(found: AdjustedBlock, campaign: Block) -> AdjustedBlock:
    """All that an update kept, solved from the first approximate values."""
    return replace(found, solution=solve_block(found.block, start=campaign.start()))


def test_an_update_of_what_has_no_blunders_is_the_full_adjustment() -> None:
    """To a tenth of a millimetre, decisions included."""
    clean = simulate_drive(DriveDesign(stations=120, observations=30_000, seed=6)).block
    options = BlockOptions.of(2.0, gate_probability=1 - 1e-9)
    before = _without_stations(clean, range(50, 54))
    found = updated(Standing.of(before, adjust_block(before, options)), clean, options)
    assert _apart_m(found, adjust_block(clean, options)) < 1e-4


def test_added_images_lead_to_the_full_adjustment(
    campaign: Block, full: AdjustedBlock, caplog: pytest.LogCaptureFixture
) -> None:
    before = _without_stations(campaign, range(_LATE, _LATE_END))
    standing = Standing.of(before, adjust_block(before, _OPTIONS))
    assert len(standing.out_image) > 100
    late = campaign.world_from_rig
    with caplog.at_level(logging.INFO):
        found = updated(standing, campaign, _OPTIONS)
    assert "new images: " in caplog.text
    assert _apart_m(found, _anew(found, campaign)) < 1e-6
    assert _apart_m(found, full) < 5e-4  # which decides on a dozen of 60,000 observations another way
    # What comes late is 0.1 m off at first, and moves by more than what it is compared to.
    moved = late.local(found.solution.state.world_from_rig)[_LATE:_LATE_END, 3:]
    assert np.abs(moved).max() > 0.01
    assert found.solution.iterations <= 3
    assert abs(found.dropped - full.dropped) <= 0.03 * full.dropped


def test_added_control_leads_to_the_full_adjustment(campaign: Block, full: AdjustedBlock) -> None:
    control = np.flatnonzero(campaign.point_priors.kind == KINDS_OF_POINT.index("control"))
    later = control[[3, 17]]
    keep = ~np.isin(np.arange(len(campaign.point_priors)), later)
    before = replace(campaign, point_priors=campaign.point_priors.take(keep))
    first = adjust_block(before, _OPTIONS)
    standing = Standing.of(before, first)
    found = updated(standing, campaign, _OPTIONS)
    assert _apart_m(found, _anew(found, campaign)) < 1e-6
    assert _apart_m(found, full) < 5e-4
    assert _apart_m(first, full) > 3 * _apart_m(found, full)


def test_wrong_control_that_is_added_is_rejected_and_what_was_rejected_stays_out(campaign: Block) -> None:
    control = np.flatnonzero(campaign.point_priors.kind == KINDS_OF_POINT.index("control"))
    position = campaign.point_priors.position.copy()
    position[control[2]] += 0.4  # before
    position[control[17]] += 0.4  # later
    wrong = replace(campaign, point_priors=replace(campaign.point_priors, position=position))
    keep = np.arange(len(position)) != control[17]
    before = replace(wrong, point_priors=wrong.point_priors.take(keep))
    first = adjust_block(before, _OPTIONS)
    names = [campaign.point_priors.point_ids[control[i]] for i in (2, 17)]
    assert names[0] in {r.name for r in first.rejected}
    found = updated(Standing.of(before, first), wrong, _OPTIONS)
    assert set(names) <= {r.name for r in found.rejected}
    assert not {("control", name) for name in names} & set(constraint_keys(found.block))
    assert len(found.rejected) <= len(first.rejected) + 2
