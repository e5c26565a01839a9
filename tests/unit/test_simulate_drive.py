"""Simulated drives: what is stated of their errors is true, and what is wrong is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from georef.estimation.adjustment.block import KINDS_OF_POINT, Block
from georef.simulate.drive import Drive, DriveDesign, simulate_drive
from georef.simulate.drive_blunders import DriveBlunders
from georef.simulate.drive_city import FACADE_M, STREETS_EAST_M, City
from georef.simulate.drive_priors import DrivePriors

_SMALL = DriveDesign(stations=240, observations=60_000, seed=3)
_INDEPENDENT = replace(_SMALL, priors=DrivePriors(reference_m=0.0, motions=True))


@pytest.fixture(scope="module")
def drive() -> Drive:
    return simulate_drive(_INDEPENDENT)


def _image_residuals(drive: Drive) -> np.ndarray:
    seen = drive.block.observations
    pixel = drive.block.views(drive.truth).project(seen.view, drive.truth.points[seen.point])
    return (seen.pixel - pixel) / seen.sigma_px[:, None]


def _squares(residual: np.ndarray, cov: np.ndarray) -> np.ndarray:
    return np.einsum("ni,ni->n", residual, np.linalg.solve(cov, residual[:, :, None])[:, :, 0])


def _assert_chi_squared(squares: np.ndarray, freedom: int) -> None:
    """The sum of squares stands between the limits of probability 1e-6, on either side."""
    total = freedom * len(squares)
    assert len(squares) > 5
    assert chi2.ppf(1e-6, total) < squares.sum() < chi2.isf(1e-6, total)


@pytest.mark.parametrize("cameras", [5, 11])
def test_images_show_the_points_with_the_stated_noise(cameras) -> None:
    drive = simulate_drive(replace(_SMALL, cameras=cameras))
    seen = drive.block.observations
    residual = _image_residuals(drive)
    assert np.isfinite(residual).all()
    assert residual.std() == pytest.approx(1.0, abs=0.01)
    assert np.abs(residual.mean(axis=0)).max() < 0.02
    assert set(seen.sigma_px) == {0.5, 0.7, 1.0}
    assert set(np.unique(drive.block.station[seen.view])) == set(range(240))
    assert {c.model for c in drive.truth.cameras} == ({"brown"} if cameras == 5 else {"brown", "fisheye"})


def test_sizes_and_tracks(drive: Drive) -> None:
    block, seen = drive.block, drive.block.observations
    assert 60_000 <= len(seen) < 60_008
    assert len(block.image_ids) == 1200
    rays = np.bincount(seen.point, minlength=len(block.points))
    assert rays.min() >= 3
    assert rays.max() <= 8
    assert 4.0 < rays.mean() < 6.0
    pairs = np.unique(seen.point * len(block.station_ids) + block.station[seen.view]) // len(block.station_ids)
    assert np.bincount(pairs).min() >= 2
    assert len(np.unique(seen.point * len(block.image_ids) + seen.view)) == len(seen)
    assert len(np.unique(seen.view * 10**6 + seen.keypoint)) == len(seen)
    steps = np.linalg.norm(np.diff(drive.truth.world_from_rig.translation, axis=0), axis=1)
    assert steps.min() > 1.5
    assert steps.max() < 6.0


def test_streets_are_tied_to_each_other(drive: Drive) -> None:
    """A tenth of the points at least is seen in two passages of streets that do not follow each other."""
    seen = drive.block.observations
    street = drive.street[drive.block.station[seen.view]]
    lowest, highest = np.full(len(drive.block.points), 10**6), np.full(len(drive.block.points), -1)
    np.minimum.at(lowest, seen.point, street)
    np.maximum.at(highest, seen.point, street)
    assert 0.1 < (highest - lowest > 1).mean() < 0.5


def test_given_positions_have_the_stated_errors(drive: Drive) -> None:
    block, truth, given = drive.block, drive.truth, drive.block.position_priors
    antenna = truth.world_from_rig.take(given.station).apply(np.tile(truth.lever_arms_m[0], (len(given), 1)))
    drift = np.einsum("nk,nkj->nj", given.drift_weight, truth.drift_m[given.drift_node])
    _assert_chi_squared(_squares(given.position - antenna - drift, given.cov), 3)
    _assert_chi_squared(np.einsum("ni,nij,nj->n", truth.drift_m, block.drift_information, truth.drift_m), 3)
    assert 0.02 < 1.0 - len(given) / 240 < 0.5
    assert np.allclose(given.drift_weight.sum(axis=1), 1.0)


def test_given_poses_and_motions_have_the_stated_errors(drive: Drive) -> None:
    block, truth = drive.block, drive.truth
    given = block.pose_priors
    true = block.world_from_cam(truth).take(given.image)
    _assert_chi_squared(_squares(true.local(given.world_from_cam), given.cov), 6)
    motions = block.relative_poses
    true = truth.world_from_rig.take(motions.a).inverse() @ truth.world_from_rig.take(motions.b)
    _assert_chi_squared(_squares(true.local(motions.a_from_b), motions.cov), 6)


def test_given_points_have_the_stated_errors(drive: Drive) -> None:
    given = drive.block.point_priors
    error = given.position - drive.truth.points[given.point]
    squares = np.einsum("ni,nij,nj->n", error, given.information, error)
    automatic = given.kind == KINDS_OF_POINT.index("automatic")
    _assert_chi_squared(squares[automatic], 3)
    known = np.linalg.matrix_rank(given.information)
    assert sorted(set(known[~automatic])) == [1, 2, 3]
    assert (known[automatic] == 3).all()
    assert chi2.ppf(1e-6, known[~automatic].sum()) < squares[~automatic].sum() < chi2.isf(1e-6, known[~automatic].sum())
    assert len(np.unique(given.point)) == len(given) == len(given.point_ids)


def test_what_is_calibrated_has_the_stated_errors() -> None:
    squares: dict[str, list[float]] = {"mounting": [], "calibration": [], "lever arm": []}
    for seed in range(6):
        drive = simulate_drive(replace(_SMALL, observations=2000, seed=seed))
        block, truth = drive.block, drive.truth
        for given, true in zip(block.mountings[1:], truth.rig_from_cam.to_list()[1:], strict=True):
            xi = given.rig_from_cam.local(true)
            assert given.information is not None
            squares["mounting"].append(float(xi @ given.information @ xi))
        for given, true in zip(block.calibrations, truth.cameras, strict=True):
            names = given.camera.estimate
            changes = [(true.value(n) - given.camera.value(n)) / given.camera.unit(n) for n in names]
            squares["calibration"].append(float(np.array(changes) @ given.information @ np.array(changes)))
        (antenna,), lever_arm = block.antennas, truth.lever_arms_m[0]
        error = lever_arm - antenna.lever_arm_m
        squares["lever arm"].append(error @ antenna.information @ error)
        assert block.mountings[0].information is None
    for name, freedom in (("mounting", 6), ("calibration", 5), ("lever arm", 3)):
        _assert_chi_squared(np.array(squares[name]), freedom)


def test_references_share_errors() -> None:
    """Within a group of reference images the errors have the shared one as their mean, and covariances count it."""
    drive = simulate_drive(replace(_SMALL, priors=DrivePriors(reference_m=0.05, point_m=(0.001, 0.001))))
    given = drive.block.point_priors
    error, group = given.position - drive.truth.points[given.point], drive.point_reference
    means = np.array([error[group == g].mean(axis=0) for g in np.unique(group[group >= 0])])
    spread = np.array([error[group == g].std() for g in np.unique(group[group >= 0])])
    assert 0.03 < means.std() < 0.08
    assert np.median(spread) < 0.06
    within = np.concatenate([error[group == g] - error[group == g].mean(axis=0) for g in np.unique(group[group >= 0])])
    assert within.std() < 0.002
    sigma = np.sqrt(np.diag(np.linalg.inv(given.information[0])))
    assert np.allclose(sigma, 0.05, atol=0.001)


def test_the_start_is_away_from_the_truth_as_stated(drive: Drive) -> None:
    xi = drive.truth.world_from_rig.local(drive.block.world_from_rig)
    assert 0.1 < xi[:, 3:].std() < 0.6
    assert np.radians(0.05) < xi[:, :3].std() < np.radians(0.4)
    assert 0.05 < np.linalg.norm(drive.block.points - drive.truth.points, axis=1).mean() < 2.0


def test_a_seed_is_a_drive(drive: Drive) -> None:
    again, other = simulate_drive(_INDEPENDENT), simulate_drive(replace(_INDEPENDENT, seed=4))
    assert np.array_equal(again.block.observations.pixel, drive.block.observations.pixel)
    assert np.array_equal(again.block.pose_priors.cov, drive.block.pose_priors.cov)
    assert np.array_equal(again.block.world_from_rig.rotation, drive.block.world_from_rig.rotation)
    assert not np.array_equal(other.truth.world_from_rig.translation, drive.truth.world_from_rig.translation)


_BLUNDERS = DriveBlunders(poses=0.3, points=0.2, observations=0.05)


@pytest.mark.parametrize("share", [0.3, 0.5])
def test_wrong_stretches_are_whole_and_shifted_each_its_own_way(drive: Drive, share: float) -> None:
    wrong = simulate_drive(_INDEPENDENT, replace(_BLUNDERS, poses=share))
    assert wrong.wrong.poses.mean() == pytest.approx(share, abs=0.01)
    before, after = drive.block.pose_priors, wrong.block.pose_priors
    moved = after.world_from_cam.translation - before.world_from_cam.translation
    stretch = wrong.wrong.pose_stretch
    assert np.allclose(moved[stretch >= 0], wrong.wrong.shifts_m[stretch[stretch >= 0]], atol=1e-9)
    assert np.array_equal(moved[stretch < 0], np.zeros((int((stretch < 0).sum()), 3)))
    assert len(wrong.wrong.shifts_m) > 1
    lengths = np.linalg.norm(wrong.wrong.shifts_m, axis=1)
    assert lengths.min() >= 0.3
    assert lengths.max() <= 1.5
    streets = [
        set(drive.street[wrong.block.station[after.image[stretch == k]]]) for k in np.unique(stretch[stretch >= 0])
    ]
    assert all(len(street) == 1 for street in streets)


def test_one_shift_for_all(drive: Drive) -> None:
    design = DriveBlunders(poses=0.4, points_in_stretches=0.4, one_shift=True)
    wrong = simulate_drive(_INDEPENDENT, design)
    assert np.allclose(wrong.wrong.shifts_m, wrong.wrong.shifts_m[0])
    moved = wrong.block.point_priors.position - drive.block.point_priors.position
    assert np.allclose(moved[wrong.wrong.points], wrong.wrong.shifts_m[0])
    automatic = wrong.block.point_priors.kind == KINDS_OF_POINT.index("automatic")
    assert wrong.wrong.points[automatic].mean() == pytest.approx(0.4, abs=0.01)
    assert not wrong.wrong.points[~automatic].any()
    assert set(wrong.wrong.pose_stretch) & set(wrong.wrong.point_stretch) == {-1}


def test_single_outliers_are_far_and_the_rest_stays(drive: Drive) -> None:
    wrong = simulate_drive(_INDEPENDENT, _BLUNDERS)
    moved = np.linalg.norm(wrong.block.observations.pixel - drive.block.observations.pixel, axis=1)
    assert wrong.wrong.observations.mean() == pytest.approx(0.05, abs=0.001)
    assert moved[wrong.wrong.observations].min() >= 10.0 - 1e-9
    assert not moved[~wrong.wrong.observations].any()
    shifted = np.linalg.norm(wrong.block.point_priors.position - drive.block.point_priors.position, axis=1)
    automatic = wrong.block.point_priors.kind == KINDS_OF_POINT.index("automatic")
    assert wrong.wrong.points[automatic].mean() == pytest.approx(0.2, abs=0.01)
    assert shifted[wrong.wrong.points].min() >= 0.2 - 1e-9
    assert not shifted[~wrong.wrong.points].any()


def test_the_oracle_lacks_what_is_wrong_and_nothing_else(drive: Drive) -> None:
    wrong = simulate_drive(_INDEPENDENT, _BLUNDERS)
    oracle = wrong.oracle()
    good = ~wrong.wrong.observations
    assert np.array_equal(oracle.observations.pixel, drive.block.observations.pixel[good])
    assert np.array_equal(
        oracle.pose_priors.world_from_cam.translation,
        drive.block.pose_priors.world_from_cam.translation[~wrong.wrong.poses],
    )
    assert len(oracle.point_priors) == int((~wrong.wrong.points).sum()) == len(oracle.point_priors.point_ids)


def test_parts_can_be_left_out_and_held() -> None:
    bare = DrivePriors(gnss=False, poses=1.0, points=0.0, control=0)
    design = replace(_SMALL, observations=3000, priors=bare, calibrations="held", mountings="held", lever_arm="held")
    drive = simulate_drive(design)
    block: Block = drive.block
    assert len(block.position_priors) == len(block.point_priors) == len(block.antennas) == 0
    assert len(block.pose_priors) == 2 * 240
    assert all(m.information is None for m in block.mountings)
    assert not any(c.camera.estimate for c in block.calibrations)
    assert _image_residuals(drive).std() == pytest.approx(1.0, abs=0.03)


def test_houses_hide_and_open_blocks_do_not() -> None:
    city = City(3, 3, np.full((4, 4), 10.0))
    origin, east = np.array([[0.0, 40.0]]), np.array([[1.0, 0.0]])
    distance, height = city.first_facade(origin, east)
    assert (distance[0], height[0]) == (FACADE_M, 10.0)
    beyond = np.array([[STREETS_EAST_M, 40.0, 2.0]])
    assert not city.sees(origin, beyond)[0]
    city.height_m[1, 1] = 0.0
    assert city.sees(origin, beyond)[0]
    assert city.first_facade(origin, east)[0][0] == STREETS_EAST_M + FACADE_M
    along = np.array([[0.0, 1.0]])
    assert np.isinf(city.first_facade(np.array([[1.0, 3.0]]), along)[0][0])
    slanted = np.array([[-0.6, 0.8]])  # from a crossing into the street, and into the first house beside it
    assert city.first_facade(np.array([[0.0, 0.0]]), slanted)[0][0] == pytest.approx(FACADE_M / 0.6)
