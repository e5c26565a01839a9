"""Stretches of wrong poses are named in a street of stations that move without turning: a linear world."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from scipy.stats import chi2

from georef.estimation.adjustment.block import Block, Calibration, PosePriors, RigCamera
from georef.estimation.adjustment.blunders.coherent import CoherentSearch, coherent_blocks
from georef.estimation.adjustment.blunders.shift_system import Members, ShiftSystem
from georef.geometry.camera import Camera
from georef.geometry.poses import Poses
from georef.geometry.rigid import Array, Rigid3
from georef.types.scene import Observations

_TIE_M, _GNSS_M, _POSE_M = 0.004, 0.03, 0.02


@dataclass(frozen=True, eq=False)
class _World:
    block: Block
    system: ShiftSystem


def _world(
    wrong: dict[tuple[int, int], list[float]], *, stations: int = 150, gnss: bool = True, seed: int = 0
) -> _World:
    """Neighbours tied together, a given pose at each station, GNSS at every second one; noise of the stated sigmas.

    wrong: shifts (m) of stretches of stations.
    """
    rng, eye = np.random.default_rng(seed), np.eye(stations)
    ties = [(eye[i + k] - eye[i], 0.0, _TIE_M * k) for k in (1, 2) for i in range(stations - k)]
    positions = [(eye[i], 0.0, _GNSS_M) for i in range(0, stations, 2) if gnss]
    others = ties + positions
    sigma = np.array([s for _, _, s in others] + [_POSE_M] * stations)
    design = np.concatenate([np.array([row for row, _, _ in others]), eye]) / sigma[:, None]
    observed = rng.normal(size=(len(sigma), 3))
    for (begin, end), shift in wrong.items():
        observed[len(others) + begin : len(others) + end] += np.array(shift) / _POSE_M
    qvv = np.eye(len(sigma)) - design @ np.linalg.inv(design.T @ design) @ design.T
    mine = qvv[len(others) :]
    information: Any = np.kron(mine[:, len(others) :] / _POSE_M**2, np.eye(3))
    right = (mine @ observed) / _POSE_M
    rows = np.arange(stations)
    poses = Members(rows, rows, rows)
    return _World(_block(stations), ShiftSystem(information, right.ravel(), poses, Members.none(), ((0, stations),)))


def _block(stations: int) -> Block:
    none = np.zeros(0, np.int64)
    camera = Camera("c", 100, 100, 100.0, 100.0, 50.0, 50.0)
    index, poses = np.arange(stations), Poses.identity(stations)
    return Block(
        station_ids=tuple(f"s{i}" for i in index),
        image_ids=tuple(f"i{i}" for i in index),
        station=index,
        mounting=np.zeros(stations, np.int64),
        calibration=np.zeros(stations, np.int64),
        mountings=(RigCamera("c", Rigid3.identity()),),
        calibrations=(Calibration.held(camera),),
        world_from_rig=poses,
        points=np.zeros((0, 3)),
        observations=Observations(none, none, np.zeros((0, 2)), np.zeros(0), none),
        pose_priors=PosePriors(index, poses, np.tile(np.eye(6), (stations, 1, 1)), np.zeros(stations, np.int64)),
    )


def _search(world: _World) -> CoherentSearch:
    return coherent_blocks(world.block, world.system, reference_m=0.005)


def _check(found: CoherentSearch, wrong: dict[tuple[int, int], list[float]], stations: int = 150) -> None:
    """Every block named with its shift within its sigma, no more than 1 % of the good poses in them."""
    named = {int(row) for block in found.blocks for row in block.poses}
    bad = {i for begin, end in wrong for i in range(begin, end)}
    assert len(named - bad) <= 0.01 * (stations - len(bad)) + 0.5
    assert len(bad - named) <= 0.03 * len(bad)
    for (begin, end), shift in wrong.items():
        mine = max(found.blocks, key=lambda b: np.isin(b.poses, np.arange(begin, end)).sum())
        off: Array = mine.shift_m - np.array(shift)
        assert off @ np.linalg.solve(mine.cov, off) < chi2.ppf(0.9999, 3)


THIRTY = {(10, 35): [0.3, 0.0, 0.0], (80, 100): [0.0, -0.4, 0.1]}
FIFTY = {(0, 30): [0.5, 0.2, 0.0], (60, 85): [-0.3, 0.3, 0.1], (85, 105): [0.2, -0.6, 0.0]}


@pytest.mark.parametrize("wrong", [THIRTY, FIFTY], ids=["30 %", "50 %"])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_all_blocks_are_named(wrong: dict[tuple[int, int], list[float]], seed: int) -> None:
    found = _search(_world(wrong, seed=seed))
    assert len(found.blocks) == len(wrong)
    assert not found.undecidable
    _check(found, wrong)


def test_names_stations_of_a_block() -> None:
    (block,) = _search(_world({(20, 60): [0.0, 0.0, 0.8]})).blocks
    assert block.station_ids == tuple(f"s{i}" for i in range(20, 60))
    assert block.shift_m[2] == pytest.approx(0.8, abs=5 * float(np.sqrt(block.cov[2, 2])))
    assert block.statistic > 1000.0


def test_no_false_alarm() -> None:
    alarms = sum(len(_search(_world({}, stations=60, seed=seed)).blocks) for seed in range(60))
    assert alarms == 0


def test_half_the_poses_without_other_evidence() -> None:
    """One shift of half of them, no GNSS: either half could be right."""
    found = _search(_world({(0, 75): [0.5, 0.0, 0.0]}, gnss=False))
    assert len(found.blocks) == 1
    assert found.undecidable


def test_half_the_poses_with_gnss_is_decided() -> None:
    wrong = {(0, 75): [0.5, 0.0, 0.0]}
    found = _search(_world(wrong))
    assert not found.undecidable
    _check(found, wrong)


def test_few_against_many_without_other_evidence() -> None:
    wrong = {(30, 50): [0.5, 0.0, 0.0]}
    found = _search(_world(wrong, gnss=False))
    assert not found.undecidable
    _check(found, wrong)


def test_what_references_share_is_no_block() -> None:
    """A shift of the size of the references' own errors is left alone, and found where these are said to be small."""
    world = _world({(20, 70): [0.02, 0.0, 0.0]})
    assert not coherent_blocks(world.block, world.system, reference_m=0.02).blocks
    assert coherent_blocks(world.block, world.system, reference_m=1e-4).blocks
