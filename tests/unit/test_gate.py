"""Gates: their rates of false alarm, what they find, and what they leave alone because nothing checks it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from georef.estimation.adjustment.gate import GateCount, gate_observations, gate_priors, worst_orientation
from georef.estimation.adjustment.posterior import posteriors
from georef.estimation.adjustment.solve import Solution, solve
from scipy.stats import binom

from georef.estimation.adjustment.problem import Problem
from georef.geometry.rigid import Rigid3
from georef.types.campaign import PositionPrior
from georef.types.scene import Observations
from tests.worlds.blocks import Block, block, control, gnss, orientations, pose_priors, without_gcps
from tests.worlds.points import NOISE, scaled_noise

_EXACT = scaled_noise(NOISE, poses=1e-6)
_PROBABILITY = 0.9  # low, so that few runs show the rate


def solved(problem: Problem) -> Solution:
    return solve(problem, cauchy_scale=None, max_iterations=20)


def exact_block(seed: int, **options: int) -> tuple[Block, np.random.Generator]:
    return block(seed, noise=_EXACT, points=90, **options), np.random.default_rng([seed, 5])  # pyright: ignore[reportArgumentType]


def assert_rate(rejected: int, tested: int, rate: float) -> None:
    """Two-sided: the number of rejections is one that a rate of this size gives in 99.8 % of all cases."""
    low, high = binom.ppf([0.001, 0.999], tested, rate)
    assert low <= rejected <= high, f"{rejected} of {tested}, expected {low} to {high}"


def test_priors_are_falsely_rejected_at_the_stated_rate() -> None:
    rejected = {"gnss": 0, "pose_priors": 0, "control_points": 0}
    tested = dict(rejected)
    for seed in range(30):
        made, rng = exact_block(seed)
        problem = replace(
            without_gcps(made.problem),
            position_priors=gnss(made.world, rng, 0.03),
            pose_priors=pose_priors(made.world, rng),
            control=control(made.world, rng, count=4),
        )
        solution = solved(problem)
        kept, gates = gate_priors(problem, solution, *posteriors(problem, solution), _PROBABILITY)
        for name, count in gates.items():
            tested[name] += count.tested
            rejected[name] += count.rejected
        assert len(kept.position_priors) == 4 - gates["gnss"].rejected
        assert len(kept.pose_priors) == 4 - gates["pose_priors"].rejected
        assert len(kept.control) == 4 - gates["control_points"].rejected
    for name in rejected:
        assert_rate(rejected[name], tested[name], 1.0 - _PROBABILITY)


def test_errors_that_references_share_are_not_held_against_control_points() -> None:
    rejected = naively = 0
    for seed in range(15):
        made, rng = block(seed, points=90), np.random.default_rng([seed, 6])
        problem = replace(made.problem, control=control(made.world, rng, count=5, sigma_m=0.003, mark_px=0.3))
        solution = solved(problem)
        cofactors, posterior = posteriors(problem, solution)
        _, gates = gate_priors(problem, solution, cofactors, posterior, 0.99)
        _, naive = gate_priors(problem, solution, cofactors, cofactors, 0.99)
        rejected += gates["control_points"].rejected
        naively += naive["control_points"].rejected
    assert rejected <= 3  # of 75
    assert naively >= 5


@pytest.mark.parametrize("stated", [0.5, 1.0, 2.0])
def test_observations_are_falsely_rejected_at_the_stated_rate_whatever_their_sigma(stated: float) -> None:
    """The scale comes from the residuals: also where all points are seen by two images alone (stated sigma wrong)."""
    rejected = tested = 0
    for seed in range(10):
        made, rng = exact_block(seed, queries=3)
        problem = replace(without_gcps(made.problem), pose_priors=pose_priors(made.world, rng))
        problem = problem.restricted(_first_two(problem.observations), np.zeros(0, bool)).scaled(stated)
        gated, dropped = gate_observations(problem, solved(problem), 0.99)
        assert dropped == len(problem.observations) - len(gated.observations)
        rejected, tested = rejected + dropped // 2, tested + len(problem.observations) // 2  # both of a point together
    assert_rate(rejected, tested, 0.01)


def _first_two(obs: Observations) -> np.ndarray:
    """The first two observations of each point."""
    order = np.argsort(obs.point, kind="stable")
    start = np.searchsorted(obs.point[order], np.arange(obs.point.max() + 1))
    keep = np.zeros(len(obs), bool)
    keep[order[np.arange(len(obs)) - start[obs.point[order]] < 2]] = True
    return keep


def test_blunders_behind_cameras_and_wrong_pixels_leave() -> None:
    made, _ = exact_block(3)
    problem, solution = made.problem, solved(made.problem)
    rng = np.random.default_rng(3)
    wrong = rng.permutation(len(problem.observations))[:12]
    pixel = problem.observations.pixel.copy()
    pixel[wrong] += 40.0
    spoilt = replace(problem, observations=replace(problem.observations, pixel=pixel))
    robust = solve(spoilt, cauchy_scale=2.0, max_iterations=30)
    gated, dropped = gate_observations(spoilt, robust, 0.999)
    left = {tuple(p) for p in gated.observations.pixel.tolist()}
    assert not left & {tuple(p) for p in pixel[wrong].tolist()}
    assert dropped < 12 + 0.03 * len(pixel)
    turned = Rigid3(
        solution.world_from_cams[0].rotation @ np.diag([1.0, -1.0, -1.0]), problem.world_from_cams[0].translation
    )
    behind = replace(solution, world_from_cams=(turned, *solution.world_from_cams[1:]))
    gated, _ = gate_observations(problem, behind, 0.999)
    assert not (gated.observations.view == 0).any()


def test_automatic_gcps_that_contradict_leave_and_their_points_may_stay() -> None:
    made, _ = exact_block(4)
    problem = made.problem
    position = problem.gcps.position.copy()
    position[::10] += [0.0, 0.0, 1.0]
    spoilt = replace(problem, gcps=replace(problem.gcps, position=position))
    gated, _ = gate_observations(spoilt, solve(spoilt, cauchy_scale=2.0, max_iterations=30), 0.999)
    known = {tuple(p) for p in gated.gcps.position.tolist()}
    assert not known & {tuple(p) for p in position[::10].tolist()}
    assert len(known) > 0.95 * (len(position) - len(position[::10]))
    assert len(gated.points) > len(gated.gcps)
    np.testing.assert_array_equal(np.unique(gated.observations.point), np.arange(len(gated.points)))


def test_what_nothing_checks_is_never_rejected() -> None:
    """One orientation fixes all but the scale; a distance 1 m wrong passes for that, until a second one is there."""
    made, rng = exact_block(5)
    start = replace(without_gcps(made.problem), orientations={0: orientations(made.world, rng, 0.01, 3e-4)[0]})

    def distance_to(image: int, off_m: float) -> PositionPrior:
        """The distance of an image from image 0 to 2 cm, nothing else."""
        baseline = made.world.queries[image].translation - made.world.queries[0].translation
        along = baseline / np.linalg.norm(baseline)
        return PositionPrior(
            made.world.queries[image].translation + off_m * along,
            100.0 * np.eye(3) - 99.9996 * np.outer(along, along),
        )

    for priors, rejected in (({3: distance_to(3, 1.0)}, 0), ({3: distance_to(3, 1.0), 2: distance_to(2, 0.0)}, 2)):
        problem = replace(start, position_priors=priors)
        solution = solve(problem, cauchy_scale=None, max_iterations=40)
        _, gates = gate_priors(problem, solution, *posteriors(problem, solution), 0.999)
        assert gates["gnss"].rejected == rejected
        assert worst_orientation(problem, solution, posteriors(problem, solution)[0], 0.999) is None


def test_the_worst_orientation_is_the_wrong_one() -> None:
    found = []
    for seed in range(6):
        made, rng = exact_block(seed, queries=6)
        given = orientations(made.world, rng, 0.01, 3e-4)
        for shift in (0.0, 0.15):
            pose = given[2].world_from_cam
            wrong = replace(
                given[2], world_from_cam=Rigid3(pose.rotation, pose.translation + np.array([0.0, shift, 0.0]))
            )
            problem = replace(without_gcps(made.problem), orientations={**given, 2: wrong})
            solution = solved(problem)
            found.append(worst_orientation(problem, solution, posteriors(problem, solution)[0], 0.9999))
    assert found == [None, 2] * 6


def test_two_rounds_of_a_gate_count_together() -> None:
    assert GateCount(10, 1, ("a",)).then(GateCount(9, 2, ("b", "c"))) == GateCount(10, 3, ("a", "b", "c"))
