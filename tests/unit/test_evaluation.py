"""Evaluation: pose errors and recall, and check points whose predicted covariances hold in Monte Carlo."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from georef.evaluation.check_points import (
    CheckPointErrors,
    PosedImages,
    check_point_errors,
    evaluate_check_points,
    mark_sigma_component,
)
from georef.evaluation.pose_errors import THRESHOLDS, PoseErrors, TruthSigmas, compare_poses
from georef.evaluation.statistics import median_interval, nees, rmse_interval, summarize_nees
from georef.geometry.camera import Camera, project
from georef.geometry.rigid import Array, Rigid3, exp_so3
from georef.types.constraints import CheckKind, CheckPoint, Mark

_LENS = Camera("c", 4000, 3000, 2500.0, 2500.0, 2000.0, 1500.0, (-0.12, 0.03, 4e-4, -2e-4))
_LEVEL = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
_IDS = ("a", "b", "c", "d")

Estimates = Mapping[str, tuple[Rigid3, Array]]


def random_cov(rng: np.random.Generator, sigma_rad: float, sigma_m: float) -> Array:
    scale = np.repeat([sigma_rad, sigma_m], 3)
    mix = rng.normal(size=(6, 8)) / np.sqrt(8.0)
    return (mix @ mix.T) * np.outer(scale, scale)


def noisy_poses(sigmas: TruthSigmas | None = None) -> tuple[Estimates, dict[str, Rigid3]]:
    """400 estimates whose errors have the covariances that stand beside them, and a truth with its own errors."""
    rng = np.random.default_rng(11)
    estimated, truth = {}, {}
    for i in range(400):
        exact = Rigid3.exp(np.concatenate([rng.normal(size=3), 40.0 * rng.normal(size=3)]))
        cov = random_cov(rng, 2e-3, 2e-2)
        estimated[f"i{i}"] = exact.retract(rng.multivariate_normal(np.zeros(6), cov)), cov
        scatter = np.sqrt(np.diag((sigmas or TruthSigmas()).cov)) * rng.normal(size=6)
        truth[f"i{i}"] = exact.retract(scatter)
    return estimated, truth


def with_covs(estimated: Estimates, change: Callable[[Rigid3, Array], Array]) -> Estimates:
    return {name: (pose, change(pose, cov)) for name, (pose, cov) in estimated.items()}


def ratios(result: PoseErrors) -> tuple[float, float, float]:
    parts = result.nees.mean_ratio, result.nees_position.mean_ratio, result.nees_rotation.mean_ratio
    assert all(part is not None for part in parts)
    return parts  # pyright: ignore[reportReturnType]


def test_nees_of_true_covariances_lies_in_its_interval() -> None:
    result = compare_poses(*noisy_poses())
    assert result.nees.consistent
    assert result.nees_position.consistent
    assert result.nees_rotation.consistent
    assert result.nees.count == 400
    low, high = result.nees.interval or (0.0, 0.0)
    assert 0.93 < low < 1.0 < high < 1.07


def test_nees_knows_the_sigmas_of_the_truth() -> None:
    sigmas = TruthSigmas(position_m=0.03, rotation_rad=3e-3)
    estimated, truth = noisy_poses(sigmas)
    assert compare_poses(estimated, truth, truth_sigmas=sigmas).nees.consistent
    assert compare_poses(estimated, truth).nees.consistent is False


def test_nees_reveals_swapped_rotation_and_translation_and_a_left_perturbation() -> None:
    estimated, truth = noisy_poses()
    order = np.r_[3:6, 0:3]
    swapped = compare_poses(with_covs(estimated, lambda _, cov: cov[np.ix_(order, order)]), truth)
    left = compare_poses(with_covs(estimated, lambda pose, cov: pose.adjoint() @ cov @ pose.adjoint().T), truth)
    inverse = compare_poses(with_covs(estimated, lambda _, cov: 4.0 * cov), truth)
    assert min(abs(np.log(ratios(swapped)))) > np.log(10.0)
    assert ratios(left)[0] > 2.0
    assert left.nees_position.consistent is False
    assert inverse.nees.mean_ratio == pytest.approx(0.25, rel=0.1)
    assert inverse.nees.consistent is False


def test_errors_are_estimated_minus_truth_along_world_axes() -> None:
    truth = Rigid3(exp_so3([0.3, -1.0, 2.0]), np.array([10.0, 20.0, 30.0]))
    turned = Rigid3(truth.rotation @ exp_so3([0.0, 0.02, 0.0]), truth.translation + np.array([0.03, 0.0, -0.04]))
    result = compare_poses({"a": (turned, None)}, {"a": truth})
    np.testing.assert_allclose(np.array(result.errors[0].offset_m), [0.03, 0.0, -0.04], atol=1e-12)
    assert result.errors[0].position_m == pytest.approx(0.05)
    assert result.errors[0].rotation_rad == pytest.approx(0.02)
    assert result.errors[0].nees is None
    assert result.nees.mean_ratio is None


def test_images_without_an_estimate_count_as_infinite() -> None:
    truth = {name: Rigid3.identity() for name in "abcd"}
    near, turned = Rigid3(np.eye(3), np.array([0.004, 0.0, 0.0])), Rigid3(exp_so3([0.02, 0, 0]), np.zeros(3))
    result = compare_poses({"a": (near, None), "b": (turned, None), "z": (near, None)}, truth)
    percents = {(r.position_m, r.rotation_deg): r.percent for r in result.recall}
    assert tuple(percents) == THRESHOLDS
    # b is exact in position but turned by 1.15 deg: both conditions hold from (0.2 m, 2 deg) on.
    assert [percents[limits] for limits in THRESHOLDS] == [25.0, 25.0, 25.0, 25.0, 50.0, 50.0, 50.0]
    assert result.failed == ("c", "d")
    assert result.without_truth == ("z",)
    assert result.position_m.median == np.inf
    assert result.position_m.median_estimated == pytest.approx(0.002)
    assert result.position_m.maximum_estimated == pytest.approx(0.004)
    json.dumps(result.to_dict(), allow_nan=False)
    part = compare_poses({"a": (near, None)}, truth, expected=["a", "b", "a"])
    assert part.recall[-1].percent == 50.0


def test_nothing_expected_and_nothing_estimated() -> None:
    for result in (compare_poses({}, {}), compare_poses({}, {"a": Rigid3.identity()})):
        json.dumps(result.to_dict(), allow_nan=False)
        assert result.nees.mean_ratio is None
    with pytest.raises(ValueError, match="without a true pose"):
        compare_poses({}, {}, expected=["a"])
    with pytest.raises(ValueError, match="not finite"):
        compare_poses({"a": (Rigid3(np.eye(3), np.full(3, np.nan)), None)}, {"a": Rigid3.identity()})


def test_median_interval_covers_the_median_of_any_distribution() -> None:
    rng = np.random.default_rng(3)
    samples = rng.exponential(size=(2000, 25))
    hits = [low <= np.log(2.0) <= high for low, high in (median_interval(s) or (0, 0) for s in samples)]
    assert 0.945 < np.mean(hits) < 0.98
    assert median_interval(np.arange(5.0)) is None
    assert median_interval(np.arange(6.0)) == (0.0, 5.0)


@pytest.mark.parametrize("sigmas", [(1.0,), (1.0, 1.0, 1.0), (1.0, 1.5, 3.0)])
def test_rmse_interval_covers_the_true_rmse(sigmas: tuple[float, ...]) -> None:
    rng = np.random.default_rng(4)
    true = np.sqrt(np.sum(np.square(sigmas)))
    intervals = [rmse_interval(rng.normal(size=(15, len(sigmas))) * sigmas) or (0, 0) for _ in range(2000)]
    assert 0.93 < np.mean([low <= true <= high for low, high in intervals]) < 0.98


def test_nees_is_the_squared_length_in_sigmas() -> None:
    assert nees(np.array([2.0, 3e-4]), np.diag([4.0, 1e-8])) == pytest.approx(10.0)
    with pytest.raises(ValueError, match="positive definite"):
        nees(np.ones(2), np.array([[1.0, 2.0], [2.0, 1.0]]))
    assert summarize_nees([None, 6.0], 6).count == 1


def true_poses() -> list[Rigid3]:
    turns = [exp_so3([0.02 * i, 0.12 * (i - 1.5), 0.03]) for i in range(4)]
    return [Rigid3(_LEVEL @ turn, np.array([1.6 * i, 0.2 * i, 2.0])) for i, turn in enumerate(turns)]


def joint_cov() -> Array:
    """Covariance (24, 24) of four poses whose errors are mostly common: 0.2 mrad and 8 mm, all correlated."""
    rng = np.random.default_rng(8)
    scale = np.tile(np.repeat([2e-4, 8e-3], 3), 4)
    common = np.tile(rng.normal(size=(6, 6)) / np.sqrt(6.0), (4, 1))
    own = 0.4 * rng.normal(size=(24, 24)) / np.sqrt(24.0)
    return (common @ common.T + own @ own.T + 0.01 * np.eye(24)) * np.outer(scale, scale)


def block(cov: Array, indices: list[int]) -> Array:
    rows = np.concatenate([np.arange(6 * i, 6 * i + 6) for i in indices])
    return cov[np.ix_(rows, rows)]


def images(poses: list[Rigid3], cov: Array | None) -> PosedImages:
    joint = None if cov is None else lambda indices: block(cov, indices)
    return PosedImages(_IDS, (_LENS,) * 4, tuple(poses), joint)


def check_point(rng: np.random.Generator, name: str, true_sigma_px: float = 0.5, stated_px: float = 0.5) -> CheckPoint:
    """A point in front of the four true poses; marks and reference coordinates have the noise that is stated."""
    exact = rng.uniform([0.0, 9.0, 0.5], [5.0, 16.0, 4.0])
    cov = np.diag(np.square([0.003, 0.003, 0.005]))
    pixels = [project(_LENS, pose.inverse().apply(exact)[None])[0] for pose in true_poses()]
    assert np.min(pixels) > 0
    marks = tuple(
        Mark(_IDS[i], pixel + true_sigma_px * rng.normal(size=2), stated_px) for i, pixel in enumerate(pixels)
    )
    return CheckPoint(name, CheckKind.ABSOLUTE, exact + rng.multivariate_normal(np.zeros(3), cov), cov, marks)


def simulate(runs: int, given_cov: Array, *, sigma_px: float = 0.5) -> CheckPointErrors:
    """Independent runs of one point each; poses have errors of joint_cov(), and given_cov is what is said of them."""
    rng, found = np.random.default_rng(9), []
    half = np.linalg.cholesky(joint_cov())
    for run in range(runs):
        xi = (half @ rng.normal(size=24)).reshape(4, 6)
        poses = [pose.retract(change) for pose, change in zip(true_poses(), xi, strict=True)]
        found += check_point_errors([check_point(rng, str(run), sigma_px)], images(poses, given_cov)).determined
    return CheckPointErrors(tuple(found))


def test_predicted_covariances_of_check_points_are_true_with_correlated_poses() -> None:
    errors = simulate(500, joint_cov())
    summary = errors.summarize()[CheckKind.ABSOLUTE]
    assert summary.count == 500
    assert summary.nees.consistent
    predicted = np.mean([np.array(error.predicted_cov) for error in errors.determined], axis=0)
    differences = np.array([error.difference_m for error in errors.determined])
    np.testing.assert_allclose(np.sqrt(np.diag(predicted)), differences.std(axis=0), rtol=0.12)
    assert np.all(np.abs(summary.mean_m) < 4.0 * summary.std_m / np.sqrt(500))
    assert np.mean([e.nees <= chi2.ppf(0.95, 3) for e in errors.determined if e.nees]) == pytest.approx(0.95, abs=0.03)


def test_without_the_correlations_between_the_images_the_prediction_is_wrong() -> None:
    independent = np.kron(np.eye(4), np.ones((6, 6))) * joint_cov()
    order = np.r_[3:6, 0:3]
    swapped = block(joint_cov(), [0, 1, 2, 3])[np.ix_(*[np.concatenate([6 * i + order for i in range(4)])] * 2)]
    for wrong in (independent, swapped, np.zeros((24, 24))):
        assert simulate(150, wrong).summarize()[CheckKind.ABSOLUTE].nees.consistent is False


def test_the_interval_of_the_mean_nees_knows_that_points_share_the_errors_of_their_poses() -> None:
    rng, half = np.random.default_rng(15), np.linalg.cholesky(joint_cov())
    inside = naive = 0
    for _ in range(40):
        xi = (half @ rng.normal(size=24)).reshape(4, 6)
        poses = [pose.retract(change) for pose, change in zip(true_poses(), xi, strict=True)]
        points = [check_point(rng, str(i)) for i in range(12)]
        summary = check_point_errors(points, images(poses, joint_cov())).summarize()[CheckKind.ABSOLUTE].nees
        assert summary.effective_dof is not None
        assert summary.effective_dof < 30.0
        inside += bool(summary.consistent)
        naive += bool(summarize_nees([(summary.mean_ratio or 0.0) * 36], 36).consistent)
    assert inside >= 35
    assert naive < 30


def test_absolute_and_relative_points_are_never_pooled() -> None:
    rng = np.random.default_rng(10)
    points = [check_point(rng, f"p{i}") for i in range(6)]
    shifted = [replace(p, kind=CheckKind.RELATIVE, point_in_world=p.point_in_world - [1.0, 0, 0]) for p in points[:2]]
    report = evaluate_check_points([*shifted, *points[2:]], images(true_poses(), np.zeros((24, 24))))
    assert set(report.summaries) == {CheckKind.ABSOLUTE, CheckKind.RELATIVE}
    absolute, relative = report.summaries[CheckKind.ABSOLUTE], report.summaries[CheckKind.RELATIVE]
    assert (absolute.count, relative.count) == (4, 2)
    assert relative.rmse_e_m == pytest.approx(1.0, abs=0.02)
    assert relative.mean_m[0] == pytest.approx(1.0, abs=0.02)
    assert absolute.rmse_3d_m < 0.03
    assert absolute.rmse_3d_m**2 == pytest.approx(absolute.rmse_horizontal_m**2 + absolute.rmse_h_m**2)
    low, high = absolute.rmse_3d_interval_m or (0.0, 0.0)
    assert low < absolute.rmse_3d_m < high
    assert set(report.to_dict()) >= {"summaries", "points"}
    json.dumps(report.to_dict(), allow_nan=False)


def test_points_that_are_not_determined_are_reported() -> None:
    whole = check_point(np.random.default_rng(12), "whole")
    one = replace(whole, point_id="one", marks=(whole.marks[0], replace(whole.marks[1], image_id="not posed")))
    twice = replace(whole, point_id="twice", marks=(whole.marks[0], whole.marks[0]))
    flipped = tuple(replace(mark, pixel=np.array([4000.0, 3000.0]) - mark.pixel) for mark in whole.marks[::3])
    diverging = replace(whole, point_id="diverging", marks=flipped)
    result = check_point_errors([one, whole, twice, diverging], images(true_poses(), None))
    assert [error.point_id for error in result.determined] == ["whole"]
    assert [entry.point_id for entry in result.not_determined] == ["one", "twice", "diverging"]
    assert result.not_determined[0].mark_count == 1
    summary = result.summarize()[CheckKind.ABSOLUTE]
    assert (summary.count, summary.not_determined) == (1, 3)
    assert result.determined[0].predicted_cov is None
    assert summary.nees.mean_ratio is None
    only = check_point_errors([one], images(true_poses(), None)).summarize()[CheckKind.ABSOLUTE]
    json.dumps(only.to_dict(), allow_nan=False)


@pytest.mark.parametrize("pose_errors", [False, True])
def test_mark_sigma_component_finds_the_true_sigma(pose_errors: bool) -> None:
    rng, factors, plain = np.random.default_rng(13), [], []
    own = 9.0 * np.diag(np.tile(np.repeat([2e-4, 2e-3], 3), 4) ** 2) * float(pose_errors)
    for _ in range(12):
        xi = (np.sqrt(np.diag(own)) * rng.normal(size=24)).reshape(4, 6)
        poses = [pose.retract(change) for pose, change in zip(true_poses(), xi, strict=True)]
        points = [check_point(rng, str(i), true_sigma_px=0.8, stated_px=0.4) for i in range(12)]
        found = mark_sigma_component(points, images(poses, own))
        assert (found.point_count, found.mark_count, found.redundancy) == (12, 48, 60)
        factors.append((found.factor, found.sigma))
        plain.append(found.plain_factor)
    values, sigmas = np.array(factors, dtype=float).T
    assert values.mean() == pytest.approx(2.0, abs=0.25 if pose_errors else 0.12)
    if pose_errors:
        assert np.mean(plain) > 2.5
    else:
        np.testing.assert_allclose(values, plain, rtol=1e-6)
        np.testing.assert_allclose(sigmas, values / np.sqrt(2 * 60), rtol=1e-6)
        assert np.std((values - 2.0) / sigmas) == pytest.approx(1.0, abs=0.5)


def test_the_estimated_mark_sigma_mends_the_nees() -> None:
    rng = np.random.default_rng(14)
    points = [check_point(rng, str(i), true_sigma_px=3.0, stated_px=0.5) for i in range(60)]
    report = evaluate_check_points(points, images(true_poses(), np.zeros((24, 24))))
    assert report.component.factor == pytest.approx(6.0, rel=0.15)
    assert report.summaries_estimated is not None
    assert report.summaries[CheckKind.ABSOLUTE].nees.consistent is False
    assert report.summaries_estimated[CheckKind.ABSOLUTE].nees.consistent
    assert mark_sigma_component([], images(true_poses(), None)).factor is None
