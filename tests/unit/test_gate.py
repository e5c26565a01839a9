"""Gates: their rates of false alarm, what they find, and what they leave alone because nothing checks it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import binom

from georef.estimation.adjustment import block as adjustment
from georef.estimation.adjustment.adjust_block import quality
from georef.estimation.adjustment.blunders.gates import GATED, name_of
from georef.estimation.adjustment.equations.constraint_terms import POSITION_PRIORS
from georef.estimation.adjustment.equations.eliminate import IMAGE_OBSERVATIONS
from georef.estimation.adjustment.network import worst_orientation
from georef.estimation.adjustment.quality.group_tests import TermTests, constraint_tests
from georef.estimation.adjustment.solver import solve_block
from georef.geometry.poses import Poses
from georef.geometry.rigid import Rigid3
from georef.types.campaign import PositionPrior
from georef.types.scene import Observations
from tests.worlds.adjusted import Solved, adjusted, images_alone
from tests.worlds.blocks import (
    Block,
    block,
    control,
    gnss,
    orientations,
    pose_priors,
    with_orientations,
    without_gcps,
)
from tests.worlds.points import NOISE, scaled_noise

_EXACT = scaled_noise(NOISE, poses=1e-6)
_PROBABILITY = 0.9  # low, so that few runs show the rate


def failed(found: Solved, tests: list[TermTests], probability: float) -> list[tuple[str, str]]:
    """Kind and name of all constraints that fail their test."""
    return [
        (test.name, name_of(found.block, test.name, int(test.row[k])))
        for test in tests
        if test.name in GATED
        for k in np.flatnonzero(test.rejected(probability))
    ]


def robust(whole: adjustment.Block) -> Solved:
    state = solve_block(whole, losses={IMAGE_OBSERVATIONS: 2.0, "automatic": 2.0}).state
    return Solved(whole, state, quality(whole, state))


def exact_block(seed: int, **options: int) -> tuple[Block, np.random.Generator]:
    return block(seed, noise=_EXACT, points=90, **options), np.random.default_rng([seed, 5])  # pyright: ignore[reportArgumentType]


def assert_rate(rejected: int, tested: int, rate: float) -> None:
    """Two-sided: the number of rejections is one that a rate of this size gives in 99.8 % of all cases."""
    low, high = binom.ppf([0.001, 0.999], tested, rate)
    assert low <= rejected <= high, f"{rejected} of {tested}, expected {low} to {high}"


def test_priors_are_falsely_rejected_at_the_stated_rate() -> None:
    rejected = {POSITION_PRIORS: 0, "localized": 0, "control": 0}
    tested = 0
    for seed in range(30):
        made, rng = exact_block(seed)
        problem = replace(
            without_gcps(made.problem),
            position_priors=gnss(made.world, rng, 0.03),
            pose_priors=pose_priors(made.world, rng),
            control=control(made.world, rng, count=4),
        )
        found = Solved.of(images_alone(problem))
        bad = failed(found, found.quality.constraints, _PROBABILITY)
        assert len(set(bad)) == len(bad)
        tested += 4
        rejected = {name: rejected[name] + sum(kind == name for kind, _ in bad) for name in rejected}
    for name in rejected:
        assert_rate(rejected[name], tested, 1.0 - _PROBABILITY)


def test_errors_that_references_share_are_not_held_against_control_points() -> None:
    rejected = naively = 0
    for seed in range(15):
        made, rng = block(seed, points=90), np.random.default_rng([seed, 6])
        problem = replace(made.problem, control=control(made.world, rng, count=5, sigma_m=0.003, mark_px=0.3))
        found = Solved.of(images_alone(problem))
        part = found.quality
        naive = constraint_tests(found.block, found.state, part.cofactors, part.images.points)
        for tests, honest in ((part.constraints, True), (naive, False)):
            count = sum(kind == "control" for kind, _ in failed(found, tests, 0.99))
            rejected, naively = rejected + honest * count, naively + (not honest) * count
    assert rejected <= 3  # of 75
    assert naively >= 5


@pytest.mark.parametrize("stated", [0.5, 1.0, 2.0])
def test_observations_are_falsely_rejected_at_the_stated_rate_whatever_their_sigma(stated: float) -> None:
    """The scale comes from the residuals: also where all points are seen by two images alone (stated sigma wrong)."""
    rejected = tested = 0
    for seed in range(10):
        made, rng = exact_block(seed, queries=3)
        problem = replace(without_gcps(made.problem), pose_priors=pose_priors(made.world, rng))
        problem = problem.restricted(_first_two(problem.observations), np.zeros(0, bool))
        problem = replace(problem, observations=problem.observations.scaled(stated))
        images = Solved.of(images_alone(problem)).quality.images
        # Both observations of a point have the same test, beside what the poses add.
        dropped = int(images.rejected(0.99, images.scale).sum())
        rejected, tested = rejected + dropped // 2, tested + len(problem.observations) // 2
    assert_rate(rejected, tested, 0.01)


def _first_two(obs: Observations) -> np.ndarray:
    """The first two observations of each point."""
    order = np.argsort(obs.point, kind="stable")
    start = np.searchsorted(obs.point[order], np.arange(obs.point.max() + 1))
    keep = np.zeros(len(obs), bool)
    keep[order[np.arange(len(obs)) - start[obs.point[order]] < 2]] = True
    return keep


def test_wrong_pixels_leave_and_healthy_ones_stay() -> None:
    made, _ = exact_block(3)
    problem, rng = made.problem, np.random.default_rng(3)
    wrong = rng.permutation(len(problem.observations))[:12]
    pixel = problem.observations.pixel.copy()
    pixel[wrong] += 40.0
    whole = images_alone(replace(problem, observations=replace(problem.observations, pixel=pixel)))
    images = robust(whole).quality.images
    bad = images.rejected(0.999, images.scale)
    assert bad[wrong].all()
    assert bad.sum() < 12 + 0.03 * len(pixel)


def test_what_is_behind_a_camera_fails() -> None:
    made, rng = exact_block(3)
    whole = images_alone(replace(made.problem, pose_priors=pose_priors(made.world, rng)))
    state, images = Solved.of(whole).state, whole.observations.view
    turned = state.world_from_rig.rotation.copy()
    turned[0] = turned[0] @ np.diag([1.0, -1.0, -1.0])
    behind = replace(state, world_from_rig=replace(state.world_from_rig, rotation=turned))
    bad = quality(whole, behind).images.rejected(0.999)
    assert bad[images == 0].all()


def test_automatic_gcps_that_contradict_leave_and_their_points_may_stay() -> None:
    made, _ = exact_block(4)
    position = made.problem.gcps.position.copy()
    position[::10] += [0.0, 0.0, 1.0]
    whole = images_alone(replace(made.problem, gcps=replace(made.problem.gcps, position=position)))
    found = adjusted(whole)
    known = {tuple(p) for p in found.block.point_priors.position.tolist()}
    assert not known & {tuple(p) for p in position[::10].tolist()}
    assert len(known) > 0.95 * (len(position) - len(position[::10]))
    seen = np.unique(found.block.observations.point)
    wrong = whole.point_priors.point[::10]
    assert len(np.intersect1d(seen, wrong)) > 0.5 * len(wrong)


def test_what_nothing_checks_is_never_rejected() -> None:
    """One orientation fixes all but the scale; a distance 1 m wrong passes for that, until a second one is there."""
    made, rng = exact_block(5)
    given = orientations(made.world, rng, 0.01, 3e-4)

    def distance_to(image: int, off_m: float) -> PositionPrior:
        """The distance of an image from image 0 to 2 cm, nothing else."""
        baseline = made.world.queries[image].translation - made.world.queries[0].translation
        along = baseline / np.linalg.norm(baseline)
        return PositionPrior(
            made.world.queries[image].translation + off_m * along,
            100.0 * np.eye(3) - 99.9996 * np.outer(along, along),
        )

    for priors, rejected in (({3: distance_to(3, 1.0)}, 0), ({3: distance_to(3, 1.0), 2: distance_to(2, 0.0)}, 2)):
        problem = replace(without_gcps(made.problem), position_priors=priors)
        found = Solved.of(with_orientations(images_alone(problem), given, [0]))
        bad = failed(found, found.quality.constraints, 0.999)
        assert sum(kind == POSITION_PRIORS for kind, _ in bad) == rejected
        assert worst_orientation(found.block, found.quality, 0.999) is None


def test_the_worst_orientation_is_the_wrong_one() -> None:
    worst = []
    for seed in range(6):
        made, rng = exact_block(seed, queries=6)
        given, whole = orientations(made.world, rng, 0.01, 3e-4), images_alone(without_gcps(made.problem))
        for shift in (0.0, 0.15):
            poses = given.world_from_cam.to_list()
            poses[2] = Rigid3(poses[2].rotation, poses[2].translation + np.array([0.0, shift, 0.0]))
            wrong = replace(given, world_from_cam=Poses.of(poses))
            found = Solved.of(with_orientations(whole, wrong, range(6)))
            worst.append(worst_orientation(found.block, found.quality, 0.9999))
    assert worst == [None, 2] * 6
