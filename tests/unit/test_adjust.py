"""The adjustment end to end on worlds of points: honest joint covariances, blunders found, healthy data kept."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import pytest
from scipy.stats import chi2

from georef.errors import GeorefError
from georef.estimation.adjustment.equations.constraint_terms import POSITION_PRIORS
from georef.estimation.adjustment.equations.eliminate import IMAGE_OBSERVATIONS
from georef.estimation.adjustment.problem import Problem
from georef.evaluation.statistics import nees
from georef.geometry.projection import Views
from georef.geometry.rigid import Array
from georef.types.constraints import CheckKind, CheckPoint
from tests.worlds import adjusted as worlds
from tests.worlds.adjusted import adjusted
from tests.worlds.blocks import Block, block, control, gnss, pose_priors, without_gcps
from tests.worlds.points import NOISE, scaled_noise


@dataclass(frozen=True)
class Outcome:
    nees_ratio: float  # of the joint error of all poses, over its degrees of freedom
    naive_ratio: float  # the same without the errors of the reference
    dof: int
    square_m2: float  # mean squared position error
    predicted_m2: float
    sigma_scale: float
    rejected_share: float


def outcome(made: Block, found: worlds.Outcome) -> Outcome:
    errors, count = made.errors(found.poses), len(made.world.queries)
    return Outcome(
        nees(errors, found.cov) / len(errors),
        nees(errors, found.cofactors) / len(errors),
        len(errors),
        float(np.mean([np.sum(errors[6 * i + 3 : 6 * i + 6] ** 2) for i in range(count)])),
        float(np.mean([np.trace(found.joint([i])[3:, 3:]) for i in range(count)])),
        found.adjusted.sigma_scale,
        found.adjusted.dropped / len(made.problem.observations),
    )


@lru_cache
def outcomes(pose_errors: float, seeds: int = 50) -> list[Outcome]:
    noise = scaled_noise(NOISE, poses=pose_errors)
    blocks = [block(seed, noise=noise, points=150) for seed in range(seeds)]
    return [outcome(made, adjusted(made.problem)) for made in blocks]


def mean_interval(found: list[Outcome]) -> tuple[float, float]:
    """Two-sided 95 % interval of the mean NEES ratio."""
    dof = sum(o.dof for o in found)
    low, high = chi2.ppf([0.025, 0.975], dof) / dof
    return float(low), float(high)


def test_joint_covariances_of_all_poses_are_honest() -> None:
    """With reference errors about as large as the keypoint noise. Image sigmas absorb a part of them a second time."""
    found = outcomes(0.5)
    low, high = mean_interval(found)
    mean = np.mean([o.nees_ratio for o in found])
    assert low < mean < high, (low, mean, high)
    assert np.mean([o.naive_ratio for o in found]) > 1.5 * high  # reference errors matter here


def test_reference_errors_that_dominate_leave_covariances_on_the_safe_side() -> None:
    found = outcomes(1.0, 16)
    _, high = mean_interval(found)
    mean = np.mean([o.nees_ratio for o in found])
    assert 0.7 < mean < high, mean
    assert np.mean([o.naive_ratio for o in found]) > 3.0


def test_errors_are_as_large_as_predicted() -> None:
    found = outcomes(0.5)
    ratio = np.sqrt(np.mean([o.square_m2 for o in found]) / np.mean([o.predicted_m2 for o in found]))
    assert 0.8 < ratio < 1.2, ratio


def test_healthy_observations_are_kept_and_sigmas_confirmed() -> None:
    found = outcomes(0.5)
    assert np.mean([o.rejected_share for o in found]) < 0.01
    assert 0.97 < np.mean([o.sigma_scale for o in found]) < 1.08


Constrain = Callable[[Block, np.random.Generator, float], Problem]

_KINDS: dict[str, tuple[str, Constrain]] = {
    "gnss": (
        POSITION_PRIORS,
        lambda b, rng, off: replace(b.problem, position_priors=gnss(b.world, rng, 0.03, {1, 4}, off)),
    ),
    "gnss alone": (
        POSITION_PRIORS,
        lambda b, rng, off: replace(without_gcps(b.problem), position_priors=gnss(b.world, rng, 0.03, {1, 4}, off)),
    ),
    "pose priors": (
        "localized",
        lambda b, rng, off: replace(without_gcps(b.problem), pose_priors=pose_priors(b.world, rng, {1, 4}, off)),
    ),
    "control": (
        "control",
        lambda b, rng, off: replace(b.problem, control=control(b.world, rng, bad={1, 4}, off_m=off)),
    ),
    "control alone": (
        "control",
        lambda b, rng, off: replace(without_gcps(b.problem), control=control(b.world, rng, bad={1, 4}, off_m=off)),
    ),
}


_CASES = [(kind, off_m) for kind in _KINDS for off_m in (0.4, 200.0)]


@pytest.mark.parametrize(("kind", "off_m"), _CASES)
def test_planted_blunders_are_rejected_and_healthy_constraints_kept(kind: str, off_m: float) -> None:
    group, constrain = _KINDS[kind]
    ratios, lost = [], 0
    for seed in range(2):
        made = block(seed, queries=8, points=150)
        found = adjusted(constrain(made, np.random.default_rng([seed, 11]), off_m))
        rejected = named(found, group)
        planted = {"P1", "P4"} if group == "control" else {"q1", "q4"}
        assert planted <= rejected, found.adjusted.rejected
        lost += len(rejected - planted)
        ratios.append(outcome(made, found).nees_ratio)
    assert lost == 0
    assert 0.5 < np.mean(ratios) < 1.5, np.mean(ratios)


def named(found: worlds.Outcome, kind: str) -> set[str]:
    """What is rejected of a kind, one by one or as part of a coherent block; stations by the name of their image."""
    coherent = [s for wrong in found.adjusted.wrong for s in wrong.station_ids] if kind == "localized" else []
    return {name.removeprefix("image ") for name in (*found.rejected(kind), *coherent)}


def test_three_of_eight_pose_priors_wrong_by_the_same_shift_are_found() -> None:
    made, rng = block(21, queries=8, points=150), np.random.default_rng(21)
    found = adjusted(replace(without_gcps(made.problem), pose_priors=pose_priors(made.world, rng, {0, 1, 2}, 1.5)))
    assert named(found, "localized") == {"q0", "q1", "q2"}


def test_wrong_matches_are_rejected_and_healthy_ones_kept() -> None:
    shares = []
    for seed in range(4):
        made = block(seed, blunders=0.1, points=150)
        found = adjusted(made.problem)
        shares.append(outcome(made, found))
        left = found.block.observations
        # The true pixel of every observation that is left, through its adjusted point: none is tens of pixels off.
        views = Views.of(made.world.queries, made.problem.cameras)
        off = views.project(left.view, found.state.points[left.point]) - left.pixel
        assert np.quantile(np.linalg.norm(off, axis=1), 0.99) < 15.0
    assert 0.5 < np.mean([o.nees_ratio for o in shares]) < 1.5


def test_loose_gnss_stays_and_has_its_say() -> None:
    lost = tested = 0
    for seed in range(6):
        made, rng = block(seed, points=150), np.random.default_rng([seed, 12])
        found = adjusted(replace(made.problem, position_priors=gnss(made.world, rng, 2.0)))
        lost, tested = lost + len(found.rejected(POSITION_PRIORS)), tested + 4
        assert len(found.block.position_priors) + len(found.rejected(POSITION_PRIORS)) == 4
    assert tested == 24
    assert lost == 0


def test_check_points_cannot_enter() -> None:
    made, rng = block(1, points=60), np.random.default_rng(1)
    point = control(made.world, rng, count=1)[0]
    check = CheckPoint("C1", CheckKind.ABSOLUTE, point.point_in_world, point.cov, point.marks)
    with pytest.raises(TypeError, match="control points"):
        replace(made.problem, control=(point, check))  # pyright: ignore[reportArgumentType]


def test_no_datum_is_an_error() -> None:
    with pytest.raises(GeorefError, match="no datum"):
        adjusted(without_gcps(block(1, points=60).problem))


def test_nothing_is_rejected_of_what_is_not_there() -> None:
    found = adjusted(block(1, points=60).problem).adjusted
    assert {r.kind for r in found.rejected} <= {"automatic"}
    assert set(found.quality.components) == {IMAGE_OBSERVATIONS, "automatic"}
    assert found.wrong == ()


def test_far_origin_and_order_of_images_do_not_matter() -> None:
    """World coordinates are local by rule; a kilometre away nothing may change beyond rounding."""
    made = block(2, points=100)
    reference = adjusted(made.problem)
    shift = np.array([1000.0, -700.0, 50.0])
    moved = adjusted(_shifted(made.problem, shift))
    for before, after in zip(reference.poses, moved.poses, strict=True):
        np.testing.assert_allclose(after.translation - shift, before.translation, atol=1e-6)
    np.testing.assert_allclose(moved.cov, reference.cov, rtol=1e-5, atol=1e-12)


def _shifted(problem: Problem, shift: Array) -> Problem:
    poses = tuple(replace(pose, translation=pose.translation + shift) for pose in problem.world_from_cams)
    gcps = replace(problem.gcps, position=problem.gcps.position + shift)
    return replace(problem, world_from_cams=poses, points=problem.points + shift, gcps=gcps)
