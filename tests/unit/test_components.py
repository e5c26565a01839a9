"""Variance components: redundancies against the full design matrix, and misstated sigmas recovered."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from georef.estimation.adjustment.adjust import adjust
from georef.estimation.adjustment.posterior import posteriors
from georef.estimation.adjustment.solve import Solution, solution_views, solve

from georef.config import AdjustConfig
from georef.estimation.adjustment.components import Component, variance_components
from georef.estimation.adjustment.problem import Problem, control_observations
from georef.geometry.projection import linearize
from georef.geometry.rigid import Array
from georef.types.scene import Observations
from tests.worlds.blocks import block, control, gnss, orientations, pose_priors
from tests.worlds.points import NOISE, scaled_noise

_EXACT = scaled_noise(NOISE, poses=1e-6)
_CONFIG = AdjustConfig()


def everything(seed: int) -> Problem:
    """All kinds of constraints at once; orientations and pose priors on different images."""
    made, rng = block(seed, noise=_EXACT, points=70), np.random.default_rng([seed, 8])
    given, priors = orientations(made.world, rng, 0.01, 3e-4), pose_priors(made.world, rng)
    return replace(
        made.problem,
        orientations={0: given[0], 1: given[1]},
        pose_priors={2: priors[2]},
        position_priors=gnss(made.world, rng, 0.05),
        control=control(made.world, rng, count=3),
    )


def hat_traces(problem: Problem, solution: Solution) -> dict[str, float]:
    """tr(A Qxx A' P) of each group, from one dense whitened design matrix of all unknowns."""
    images, points = len(problem.image_ids), len(problem.points)
    size = 6 * images + 3 * points + 3 * len(problem.control)
    rows: list[tuple[str, np.ndarray]] = []

    def add(group: str, blocks: dict[int, Array], cov: Array) -> None:
        row = np.zeros((len(cov), size))
        for column, part in blocks.items():
            row[:, column : column + part.shape[1]] = part
        rows.append((group, np.linalg.solve(np.linalg.cholesky(cov), row)))

    def add_images(obs: Observations, positions: Array, first: int) -> None:
        lin = linearize(solution_views(problem, solution), obs.view, positions[obs.point])
        for i in range(len(obs)):
            columns = {6 * int(obs.view[i]): lin.by_pose[i], first + 3 * int(obs.point[i]): lin.by_point[i]}
            add("image_observations", columns, np.eye(2) * obs.sigma_px[i] ** 2)

    add_images(problem.observations, solution.points, 6 * images)
    add_images(control_observations(problem), solution.control_points, 6 * images + 3 * points)
    for point, cov in zip(problem.gcps.point, problem.gcps.cov, strict=True):
        add("image_observations", {6 * images + 3 * int(point): np.eye(3)}, cov)
    for i, point in enumerate(problem.control):
        add("control_points", {6 * images + 3 * points + 3 * i: np.eye(3)}, point.cov)
    for i, given in problem.orientations.items():
        add("reference_rotation", {6 * i: np.eye(3)}, np.diag(given.rotation_sigma_rad**2))
        rotation = solution.world_from_cams[i].rotation
        add("reference_position", {6 * i + 3: rotation}, np.diag(given.position_sigma_m**2))
    for i, prior in problem.pose_priors.items():
        add("pose_priors", {6 * i: np.eye(6)}, prior.cov)
    for i, position in problem.position_priors.items():
        add("gnss", {6 * i + 3: solution.world_from_cams[i].rotation}, position.cov)
    names = np.concatenate([[name] * len(row) for name, row in rows])
    basis, _ = np.linalg.qr(np.concatenate([row for _, row in rows]))
    leverage = np.square(basis).sum(axis=1)
    return {name: float(leverage[names == name].sum()) for name in dict.fromkeys(names.tolist())}


def test_redundancies_are_those_of_the_full_design_matrix_and_add_up() -> None:
    problem = everything(1)
    solution = solve(problem, cauchy_scale=None, max_iterations=30)
    found = variance_components(problem, solution, posteriors(problem, solution)[0])
    expected = hat_traces(problem, solution)
    assert set(found) == set(expected)
    for name, component in found.items():
        # first order: the derivative of Log at a residual of a pose prior
        assert component.redundancy == pytest.approx(component.observations - expected[name], abs=0.02), name
    observations = sum(component.observations for component in found.values())
    unknowns = 6 * len(problem.image_ids) + 3 * len(problem.points) + 3 * len(problem.control)
    assert sum(c.redundancy for c in found.values()) == pytest.approx(observations - unknowns)
    assert sum(expected.values()) == pytest.approx(unknowns)


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_misstated_keypoint_sigma_is_recovered(factor: float) -> None:
    """Stated sigmas are `factor` times the true ones: the scale of the adjustment is 1 / factor."""
    scales, left = [], []
    for seed in range(4):
        adjusted = adjust(block(seed, noise=_EXACT, points=250).problem.scaled(factor), _CONFIG)
        scales.append(adjusted.sigma_scale)
        left.append(adjusted.components["image_observations"].factor)
    assert np.mean(scales) * factor == pytest.approx(1.0, abs=0.04)
    assert left == pytest.approx([1.0] * 4, abs=0.06)


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_misstated_gnss_and_control_sigmas_show_in_their_factors_alone(factor: float) -> None:
    found: dict[str, list[Component]] = {"gnss": [], "control_points": [], "image_observations": []}
    for seed in range(12):
        made, rng = block(seed, noise=_EXACT, points=90), np.random.default_rng([seed, 10])
        priors = gnss(made.world, rng, 0.05)
        problem = replace(
            made.problem,
            position_priors={i: replace(p, cov=p.cov * factor**2) for i, p in priors.items()},
            control=tuple(replace(p, cov=p.cov * factor**2) for p in control(made.world, rng, sigma_m=0.03)),
        )
        solution = solve(problem, cauchy_scale=None, max_iterations=30)
        components = variance_components(problem, solution, posteriors(problem, solution)[0])
        for name, values in found.items():
            values.append(components[name])
    for name, expected in (("gnss", 1.0 / factor), ("control_points", 1.0 / factor), ("image_observations", 1.0)):
        squares, redundancy = (sum(getattr(c, key) for c in found[name]) for key in ("squares", "redundancy"))
        pooled = Component(0, redundancy, squares)
        assert pooled.factor is not None
        assert pooled.factor_sigma is not None
        assert pooled.factor == pytest.approx(expected, abs=4.0 * pooled.factor_sigma), name
        assert pooled.factor_sigma < 0.12 * expected
        scatter = np.std([c.factor or np.nan for c in found[name]])
        stated = np.mean([c.factor_sigma or np.nan for c in found[name]])
        assert 0.5 < scatter / stated < 1.7, name


def test_a_group_without_redundancy_has_no_factor() -> None:
    assert Component(6, 2.9, 1.0).factor is None
    assert Component(6, 2.9, 1.0).factor_sigma is None
    assert Component(6, 4.0, 16.0).factor == pytest.approx(2.0)
