"""The adjustment: Cauchy, gates, refit without a robust loss, posterior covariances."""

from __future__ import annotations

from dataclasses import dataclass

from georef.config import AdjustConfig
from georef.estimation.adjustment.components import Component, variance_components
from georef.estimation.adjustment.gate import GateCount, gate_observations, gate_priors
from georef.estimation.adjustment.posterior import Posterior, posterior
from georef.estimation.adjustment.problem import Problem
from georef.estimation.adjustment.solve import Solution, solve

_GATE_ROUNDS = 3
_SETTLED_SHARE = 1e-4  # of the observations: a gate that drops fewer changes nothing
_FACTOR_TOLERANCE = 0.05


@dataclass(frozen=True, eq=False)
class Adjusted:
    """A solved adjustment: what took part in it, the solution, and how good it is."""

    problem: Problem  # what passed the gates, image sigmas scaled by their variance component
    solution: Solution
    posterior: Posterior  # with the errors of the reference
    cofactors: Posterior  # against the reference as it is published
    gates: dict[str, GateCount]
    components: dict[str, Component]
    sigma_scale: float  # of the image observations, against the problem as it was given


def adjust(problem: Problem, config: AdjustConfig) -> Adjusted:
    """Solves a problem; raises GeorefError where its constraints leave the datum open.

    The image sigmas are scaled by their own variance component, so that the posterior covariances need no other
    factor. Sigmas that the user stated (GNSS, control) are tested and reported, never changed.
    """
    given = len(problem.observations)
    solution = solve(problem, cauchy_scale=config.cauchy_scale, max_iterations=config.max_iterations)
    problem, _ = gate_observations(problem, solution, config.gate_probability)
    solution = solve(problem, cauchy_scale=None, max_iterations=config.max_iterations)
    scale = 1.0
    problem, solution, scale = _rescaled(problem, solution, scale, config)
    problem, gates = gate_priors(problem, solution, _cofactors(problem, solution), config.gate_probability)
    solution = solve(problem, cauchy_scale=None, max_iterations=config.max_iterations)
    for _ in range(_GATE_ROUNDS):
        gated, dropped = gate_observations(problem, solution, config.gate_probability)
        if dropped <= _SETTLED_SHARE * given:
            break
        problem = gated
        solution = solve(problem, cauchy_scale=None, max_iterations=config.max_iterations)
    problem, solution, scale = _rescaled(problem, solution, scale, config)
    gates["image_observations"] = GateCount(given, given - len(problem.observations))
    cofactors = _cofactors(problem, solution)
    components = variance_components(problem, solution, cofactors)
    return Adjusted(problem, solution, posterior(problem, solution), cofactors, gates, components, scale)


def _cofactors(problem: Problem, solution: Solution) -> Posterior:
    return posterior(problem, solution, reference_errors=False)


def _rescaled(
    problem: Problem, solution: Solution, scale: float, config: AdjustConfig
) -> tuple[Problem, Solution, float]:
    """The image sigmas brought to what the residuals show, and the solution for them."""
    components = variance_components(problem, solution, _cofactors(problem, solution))
    factor = components["image_observations"].factor
    if factor is None or not len(problem.observations) or abs(factor - 1.0) < _FACTOR_TOLERANCE:
        return problem, solution, scale
    problem = problem.scaled(factor).with_poses(solution.world_from_cams, solution.points)
    return problem, solve(problem, cauchy_scale=None, max_iterations=config.max_iterations), scale * factor
