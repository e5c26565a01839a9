"""What an epoch declares beside its images acts: each quantity is found again as well as its sigma says, no better."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from georef.estimation.adjustment.block import Antenna, Block, Distances, PositionPriors, RelativePoses, State
from georef.estimation.adjustment.epoch_constraints import (
    GnssOffset,
    with_antenna,
    with_calibrations,
    with_distances,
    with_gnss_offset,
    with_held_mountings,
    with_marked_points,
    with_motions,
)
from georef.estimation.adjustment.equations.cofactors import Cofactors, cofactors
from georef.estimation.adjustment.equations.eliminate import normal_equations
from georef.estimation.adjustment.solver import solve_block
from georef.geometry.camera import Camera
from georef.geometry.rigid import Array
from georef.types.scene import Observations
from tests.worlds.rig_blocks import LEFT, RIGHT, RigBlock, rig_block

SEEDS = range(12)
ARM, WRONG = np.array([0.3, -1.2, -0.4]), np.array([0.25, -0.2, 0.3])
SIGMA_FIX = 0.02


def solved(block: Block) -> tuple[State, Cofactors]:
    state = solve_block(block).state
    return state, cofactors(normal_equations(block, state).reduced)


def without_gnss(block: Block) -> Block:
    none = np.zeros((0, 3, 3))
    return replace(
        block,
        position_priors=PositionPriors.none(),
        antennas=(),
        drift_information=none,
        relative_poses=RelativePoses.none(),
        distances=Distances.none(),
    )


def with_fixes(world: RigBlock, seed: int, offset: Array | float = 0.0) -> Block:
    """Positions of an antenna, one fix a station that both of its images carry with twice its covariance."""
    rng = np.random.default_rng([seed, 7])
    block, stations = without_gnss(world.block), world.truth.world_from_rig
    fixes = stations.apply(np.tile(ARM, (len(stations), 1))) + offset + SIGMA_FIX * rng.normal(size=(len(stations), 3))
    count = len(block.image_ids)
    priors = PositionPriors(
        *(block.station, fixes[block.station], np.tile(2 * SIGMA_FIX**2 * np.eye(3), (count, 1, 1))),
        *(block.mounting, np.full((count, 2), -1), np.zeros((count, 2))),
    )
    own = tuple(Antenna(m.name, m.rig_from_cam.translation) for m in block.mountings)
    return replace(block, position_priors=priors, antennas=own)


def chi_square(off: Array, cov: Array) -> float:
    return float(off @ np.linalg.solve(cov, off))


def in_range(values: list[float], dof: int) -> bool:
    """Whether the mean of chi-squares lies in a 99.9 % interval of good ones, on both sides."""
    from scipy.stats import chi2

    low, high = chi2.ppf([0.0005, 0.9995], dof * len(values)) / len(values)
    return bool(low < np.mean(values) < high)


def test_a_wrong_lever_arm_is_estimated_back() -> None:
    values = []
    for seed in SEEDS:
        block = with_fixes(rig_block(seed), seed)
        antenna = Antenna("antenna", ARM + WRONG, np.eye(3) / 0.5**2)
        state, found = solved(with_antenna(block, antenna))
        at = found.layout.antenna[-1]
        cov = found.border[at : at + 3, at : at + 3]
        assert 0.002 < np.sqrt(np.trace(cov)) < 0.2
        values.append(chi_square(state.lever_arms_m[-1] - ARM, cov))
    assert in_range(values, 3)


def test_a_wrong_lever_arm_that_is_held_stays_and_shows_in_the_residuals() -> None:
    block = with_fixes(rig_block(0), 0)
    for arm, low, high in ((ARM, 0.3, 2.0), (ARM + WRONG, 4.0, 50.0)):
        fixed = with_antenna(block, Antenna("antenna", arm))
        state, _ = solved(fixed)
        priors = fixed.position_priors
        at = state.world_from_rig.take(priors.station).apply(state.lever_arms_m[priors.antenna])
        rms = float(np.sqrt(np.mean(np.square(at - priors.position)))) / SIGMA_FIX
        assert low < rms < high
        assert state.lever_arms_m[-1] == pytest.approx(arm)


def test_the_fixes_of_a_station_become_one_of_the_same_weight() -> None:
    block = with_antenna(with_fixes(rig_block(0), 0), Antenna("antenna", ARM))
    assert len(block.position_priors) == len(block.station_ids)
    assert block.position_priors.cov == pytest.approx(np.tile(SIGMA_FIX**2 * np.eye(3), (6, 1, 1)))


def test_a_constant_offset_of_gnss_is_found() -> None:
    offset, values = np.array([0.4, -0.3, 0.6]), []
    for seed in SEEDS:
        block = with_antenna(with_fixes(rig_block(seed), seed, offset), Antenna("antenna", ARM))
        given = GnssOffset(np.eye(3), np.zeros(1), np.arange(6.0))
        state, found = solved(with_gnss_offset(block, given))
        at = found.layout.drift[0]
        values.append(chi_square(state.drift_m[0] - offset, found.border[at : at + 3, at : at + 3]))
    assert in_range(values, 3)


def test_a_drift_of_gnss_is_found_between_nodes() -> None:
    times = np.array([10.0, 12.0, 15.0, 18.0, 25.0, 30.0])
    slope, values = np.array([0.02, 0.0, -0.03]), []
    for seed in SEEDS:
        block = with_fixes(rig_block(seed), seed, (times - 10.0)[:, None] * slope)
        block = with_antenna(block, Antenna("antenna", ARM))
        given = GnssOffset(np.zeros((3, 3)), np.array([10.0, 20.0, 30.0]), times)
        state, found = solved(with_gnss_offset(block, given))
        expected = np.array([0.0, 10.0, 20.0])[:, None] * slope
        at = found.layout.drift[0]
        values.append(chi_square((state.drift_m - expected).ravel(), found.border[at : at + 9, at : at + 9]))
    assert in_range(values, 9)


def test_nodes_that_no_position_depends_on_are_left_out() -> None:
    block = with_antenna(with_fixes(rig_block(0), 0), Antenna("antenna", ARM))
    at = np.array([0.0, 1.0, 2.0, 95.0, 96.0, 100.0])
    found = with_gnss_offset(block, GnssOffset(np.eye(3), np.arange(0.0, 101.0, 10.0), at))
    assert len(found.drift_information) == 4
    weight, node = found.position_priors.drift_weight, found.position_priors.drift_node
    assert weight.sum(axis=1) == pytest.approx(1.0)
    assert node.max() == 3
    assert (node[weight > 0] >= 0).all()


def test_measured_motions_tie_stations() -> None:
    """Two stations that no point ties: the motion alone says where the second one is, as well as it was measured."""
    values = []
    sigma = np.array([0.001] * 3 + [0.01] * 3)
    for seed in SEEDS:
        world = rig_block(seed)
        block = without_gnss(world.block)
        rng = np.random.default_rng([seed, 3])
        unseen = block.observations.take(block.station[block.observations.view] != 5)
        priors = block.pose_priors.take(block.station[block.pose_priors.image] != 5)
        motion = (world.truth.world_from_rig[4].inverse() @ world.truth.world_from_rig[5]).retract(
            sigma * rng.normal(size=6)
        )
        block = replace(block, observations=unseen, pose_priors=priors)
        tied = with_motions(block, np.array([4]), np.array([5]), [motion], np.diag(np.square(sigma))[None])
        state, found = solved(tied)
        off = world.truth.world_from_rig[5].local(state.world_from_rig[5])
        values.append(chi_square(off, found.stations[5]))
    assert in_range(values, 6)


def test_a_scale_bar_gives_the_scale() -> None:
    """One pose held, nothing else with a length: the bar, marked in the images, says how long a metre is."""
    values = []
    for seed in SEEDS:
        world = rig_block(seed)
        block, truth = without_gnss(world.block), world.truth
        rng = np.random.default_rng([seed, 5])
        first = np.arange(len(block.pose_priors)) == 0
        block = replace(
            block,
            pose_priors=block.pose_priors.take(first),
            point_priors=block.point_priors.take(np.zeros(len(block.point_priors), bool)),
            world_from_rig=truth.world_from_rig,
            points=truth.points,
        )
        block = with_held_mountings(with_calibrations(replace_calibrations(block, truth.cameras), {}))
        block = replace(
            block,
            mountings=tuple(
                replace(m, rig_from_cam=replace(truth.rig_from_cam[i], translation=np.zeros(3)))
                for i, m in enumerate(block.mountings)
            ),
            observations=block.observations.take(block.mounting[block.observations.view] == 0),
        )
        seen = np.bincount(block.observations.point, minlength=len(block.points))
        a, b = np.argsort(-seen, kind="stable")[:2]
        block, marks = moved_to_marks(block, [int(a), int(b)])
        block, place = with_marked_points(block, marks, 2)
        sigma = 0.001
        length = float(np.linalg.norm(truth.points[a] - truth.points[b])) + sigma * rng.normal()
        one = np.array([1])
        block = with_distances(block, place[:1], place[1:], np.array([length]), sigma * np.ones(1) * one)
        state, _ = solved(grown(block, 1.2))
        values.append(float(np.linalg.norm(state.points[place[0]] - state.points[place[1]]) - length) / sigma)
        scale = baseline(state) / baseline(truth)
        assert abs(scale - 1.0) < 0.02
    assert np.abs(values).max() < 0.1  # nothing else knows a length


def replace_calibrations(block: Block, cameras: tuple[Camera, ...]) -> Block:
    from georef.estimation.adjustment.block import Calibration

    return replace(block, calibrations=tuple(Calibration.held(c) for c in cameras))


def moved_to_marks(block: Block, points: list[int]) -> tuple[Block, Observations]:
    """The block without the observations of some points, which become marks of points of their own."""
    obs = block.observations
    mine = np.isin(obs.point, points)
    marks = obs.take(mine)
    return replace(block, observations=obs.take(~mine)), marks.with_points(
        np.array([points.index(int(p)) for p in marks.point], dtype=np.int64)
    )


def grown(block: Block, factor: float) -> Block:
    """Approximate values of another scale about the first station."""
    centre = block.world_from_rig.translation[0]
    stations = replace(block.world_from_rig, translation=centre + factor * (block.world_from_rig.translation - centre))
    return replace(block, world_from_rig=stations, points=centre + factor * (block.points - centre))


def baseline(state: State) -> float:
    return float(np.linalg.norm(state.world_from_rig.translation[5] - state.world_from_rig.translation[0]))


RATIONAL = Camera(
    *("left", 3000, 2000, 1500.0, 1504.0, 1490.0, 1010.0),
    *((-0.05, 0.01, 2e-4, -1e-4, 1e-3, 0.02, -0.004, 1e-3), "rational", ("focal", "k1")),
)


@pytest.mark.parametrize("left", [LEFT, RATIONAL], ids=["brown", "rational"])
def test_calibrations_are_estimated_back(left: Camera) -> None:
    """Weighted focal length and free k1 of a Brown or rational camera, and of a fisheye."""
    values = []
    for seed in SEEDS:
        world = rig_block(seed, (left, RIGHT))
        held = replace_calibrations(world.block, (left, RIGHT))
        sigmas = {"left": {"focal": 15.0, "k1": np.inf}, "right": {"focal": 7.0, "k1": 0.01}}
        block = with_calibrations(held, sigmas)
        state, found = solved(block)
        for i, camera in enumerate(state.cameras):
            at = found.layout.calibration[i]
            off = camera.steps_since(world.truth.cameras[i], camera.estimate)
            values.append(chi_square(off, found.border[at : at + 2, at : at + 2]))
    assert in_range(values, 2)


def test_held_mountings_and_cameras_stay() -> None:
    block = with_held_mountings(replace_calibrations(rig_block(0).block, (LEFT, RIGHT)))
    state, _ = solved(block)
    for mounting, pose in zip(block.mountings, state.rig_from_cam.to_list(), strict=True):
        assert pose.matrix() == pytest.approx(mounting.rig_from_cam.matrix())
    assert [c.fx for c in state.cameras] == [LEFT.fx, RIGHT.fx]
