"""Drives whose localized poses and automatic GCPs are wrong in stretches, each shifted differently, and singly besides.

Half of what is given may be wrong: GNSS and the other half decide. Against the same drive without its blunders.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import chi2

from georef.estimation.adjustment.adjust_block import AdjustedBlock, BlockOptions, adjust_block
from georef.estimation.adjustment.block import KINDS_OF_POINT, State
from georef.estimation.adjustment.blunders.coherent import CoherentBlock
from georef.simulate.drive import Drive, DriveDesign, simulate_drive
from georef.simulate.drive_blunders import DriveBlunders
from georef.simulate.drive_priors import DrivePriors

_STATIONS, _OBSERVATIONS = 100, 30_000
_POINTS = DrivePriors(poses=0.0, points=0.8, control=8)
_BOTH = DrivePriors(poses=0.4, points=0.5, control=8)
_POSES = DrivePriors(poses=0.7, points=0.3, control=8)
_FEW = 10  # rows of a stretch, fewer of which are spread over passages


@dataclass(frozen=True, eq=False)
class _Case:
    drive: Drive
    adjusted: AdjustedBlock
    oracle: AdjustedBlock


_CASES = {
    "GCPs 30 %": (_POINTS, DriveBlunders(points_in_stretches=0.3, points=0.2, observations=0.05), 4),
    "GCPs 50 %": (_POINTS, DriveBlunders(points_in_stretches=0.5, points=0.2, observations=0.05), 5),
    "poses 50 %": (_POSES, DriveBlunders(poses=0.5, points=0.2, observations=0.05), 6),
    "both 50 %": (_BOTH, DriveBlunders(poses=0.5, points_in_stretches=0.5, points=0.2, observations=0.05), 7),
}


@pytest.fixture(scope="module", params=_CASES, ids=str)
def case(request: pytest.FixtureRequest) -> _Case:
    priors, blunders, seed = _CASES[request.param]
    drive = simulate_drive(DriveDesign(_STATIONS, observations=_OBSERVATIONS, priors=priors, seed=seed), blunders)
    options = BlockOptions.of(2.0)
    return _Case(drive, adjust_block(drive.block, options), adjust_block(drive.oracle(), options))


def _rmse(state: State, truth: State) -> float:
    return float(np.sqrt(np.mean(np.square(state.world_from_rig.translation - truth.world_from_rig.translation))))


def _stretch_of(drive: Drive, block: CoherentBlock) -> tuple[int, float]:
    """The true stretch of most rows of a named block (-1: right ones), and their share."""
    stretches = [drive.wrong.pose_stretch[block.poses], drive.wrong.point_stretch[block.points]]
    count = np.bincount(np.concatenate(stretches) + 1)
    return int(np.argmax(count)) - 1, float(count.max() / count.sum())


def test_as_good_as_without_the_blunders(case: _Case) -> None:
    ours, oracle = (_rmse(found.solution.state, case.drive.truth) for found in (case.adjusted, case.oracle))
    assert 0.8 < ours / oracle < 1.15
    assert not case.oracle.wrong


def test_every_stretch_is_named_once_with_its_shift(case: _Case) -> None:
    wrong, named = case.drive.wrong, case.adjusted.wrong
    assert not case.adjusted.undecidable
    stretch = np.concatenate([wrong.pose_stretch, wrong.point_stretch])
    rows = np.bincount(stretch[stretch >= 0], minlength=len(wrong.shifts_m))
    found = [_stretch_of(case.drive, block) for block in named]
    assert all(share > 0.95 for _, share in found)
    assert {stretch for stretch, _ in found} >= set(np.flatnonzero(rows >= _FEW).tolist())
    assert -1 not in {stretch for stretch, _ in found}
    assert len(found) <= len(wrong.shifts_m) + 1
    for block, (stretch, _) in zip(named, found, strict=True):
        off = block.shift_m - wrong.shifts_m[stretch]
        cov = block.cov + 0.007**2 * np.eye(3)  # what a reference's own error adds
        assert off @ np.linalg.solve(cov, off) < chi2.ppf(0.9999, 3)
        assert block.detectable_m < np.linalg.norm(block.shift_m)


def test_good_ones_stay(case: _Case) -> None:
    given, left, wrong = case.drive.block, case.adjusted.block, case.drive.wrong
    points = ~np.isin(given.point_priors.point_ids, left.point_priors.point_ids)
    automatic = given.point_priors.kind == KINDS_OF_POINT.index("automatic")
    _check(points, automatic & ~wrong.points, automatic & wrong.points)
    assert points[~automatic].sum() <= 1
    _check(~np.isin(given.pose_priors.image, left.pose_priors.image), ~wrong.poses, wrong.poses)
    before, after = (obs.point * len(given.image_ids) + obs.view for obs in (given.observations, left.observations))
    dropped = ~np.isin(before, after)
    assert dropped[~wrong.observations].mean() <= 0.01
    assert dropped[wrong.observations].mean() >= 0.9  # one of two rays is as good as the other
    assert len(given.position_priors) - len(left.position_priors) <= 1


def _check(rejected: NDArray[np.bool_], good: NDArray[np.bool_], bad: NDArray[np.bool_]) -> None:
    """1 % of the good ones at most, or one; 2 % of the wrong ones, or one, may stay."""
    assert rejected[good].sum() <= max(0.01 * good.sum(), 1)
    assert (~rejected[bad]).sum() <= max(0.02 * bad.sum(), 1)


def _half_shifted(control: int) -> AdjustedBlock:
    """Automatic GCPs are all that ties a drive to the world, and half of them are off by one shift."""
    priors = DrivePriors(gnss=False, drift_m=0.0, poses=0.0, points=1.0, control=control, reference_m=0.003)
    blunders = DriveBlunders(points_in_stretches=0.5, one_shift=True)
    return adjust_block(
        simulate_drive(DriveDesign(60, observations=15_000, priors=priors, seed=3), blunders).block,
        BlockOptions.of(2.0),
    )


def test_one_shift_of_half_of_the_points_cannot_be_decided() -> None:
    adjusted = _half_shifted(0)
    assert adjusted.wrong
    assert adjusted.undecidable


def test_surveyed_control_decides() -> None:
    adjusted = _half_shifted(20)
    assert adjusted.wrong
    assert not adjusted.undecidable
    assert sum(one.kind == "control" for one in adjusted.rejected) <= 1


def test_clean_drives_raise_no_alarm() -> None:
    """Nor are more constraints rejected than the gate says: 0.1 %, and 3.7 sigmas."""
    tested, rejected = 0, 0
    for seed in range(8):
        priors = DrivePriors(poses=0.3, points=0.6, control=8)
        block = simulate_drive(DriveDesign(40, observations=8_000, priors=priors, seed=seed)).block
        adjusted = adjust_block(block, BlockOptions.of(2.0))
        assert not adjusted.wrong
        tested += len(block.pose_priors) + len(block.point_priors) + len(block.position_priors)
        rejected += len(adjusted.rejected)
    assert tested > 1000
    assert rejected <= 0.001 * tested + 3.7 * np.sqrt(0.001 * tested)
