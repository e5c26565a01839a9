"""The adjustment: Cauchy, gates, refit without a robust loss, posterior covariances."""

from __future__ import annotations

from dataclasses import dataclass

from georef.config import AdjustConfig
from georef.estimation.adjustment.components import Component, variance_components
from georef.estimation.adjustment.gate import GateCount, gate_observations, gate_priors, residual_scale
from georef.estimation.adjustment.posterior import Posterior, posteriors
from georef.estimation.adjustment.problem import Problem
from georef.estimation.adjustment.solve import Solution, solve

_GATE_ROUNDS, _ROBUST_ROUNDS = 3, 2
_FAR_OFF = 1.25  # of a sigma against its residuals
_SETTLED_SHARE = 1e-4  # of the observations: a gate that drops fewer changes nothing
_FACTOR_TOLERANCE = 0.05
_GROSS = 1e-3  # share of the false alarms of a gate that the first one may give: a robust solution is not the best one


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
    problem, solution, scale = _robust(problem, config)
    first_gate = 1.0 - _GROSS * (1.0 - config.gate_probability)
    problem, gates, _ = _gated(problem, solution, first_gate)
    solution = solve(problem, cauchy_scale=None, max_iterations=config.max_iterations)
    problem, solution, scale = _rescaled(problem, solution, scale, config)
    for _ in range(_GATE_ROUNDS):
        gated, more, dropped = _gated(problem, solution, config.gate_probability)
        if dropped <= _SETTLED_SHARE * given and not any(count.rejected for count in more.values()):
            break
        problem, gates = gated, {name: gates[name].then(more[name]) for name in gates}
        solution = solve(problem, cauchy_scale=None, max_iterations=config.max_iterations)
    problem, solution, scale = _rescaled(problem, solution, scale, config)
    gates["image_observations"] = GateCount(given, given - len(problem.observations))
    cofactors, posterior = posteriors(problem, solution)
    components = variance_components(problem, solution, cofactors)
    return Adjusted(problem, solution, posterior, cofactors, gates, components, scale)


def _robust(problem: Problem, config: AdjustConfig) -> tuple[Problem, Solution, float]:
    """The robust solution, with image sigmas near what the residuals show: a loss far too narrow fits too few."""
    scale = 1.0
    solution = solve(problem, cauchy_scale=config.cauchy_scale, max_iterations=config.max_iterations)
    for _ in range(_ROBUST_ROUNDS):
        factor = min(max(residual_scale(problem, solution), 0.1), 10.0)
        if 1.0 / _FAR_OFF < factor < _FAR_OFF:
            break
        problem, scale = problem.scaled(factor).with_poses(solution.world_from_cams, solution.points), scale * factor
        solution = solve(problem, cauchy_scale=config.cauchy_scale, max_iterations=config.max_iterations)
    return problem, solution, scale


def _gated(problem: Problem, solution: Solution, probability: float) -> tuple[Problem, dict[str, GateCount], int]:
    """The problem without priors and observations that contradict the rest, and how many observations were dropped."""
    kept, gates = gate_priors(problem, solution, *posteriors(problem, solution), probability)
    kept, dropped = gate_observations(kept, solution, probability)
    return kept, gates, dropped


def _rescaled(
    problem: Problem, solution: Solution, scale: float, config: AdjustConfig
) -> tuple[Problem, Solution, float]:
    """The image sigmas brought to what the residuals show, and the solution for them."""
    components = variance_components(problem, solution, posteriors(problem, solution)[0])
    factor = components["image_observations"].factor
    if factor is None or not len(problem.observations) or abs(factor - 1.0) < _FACTOR_TOLERANCE:
        return problem, solution, scale
    problem = problem.scaled(factor).with_poses(solution.world_from_cams, solution.points)
    return problem, solve(problem, cauchy_scale=None, max_iterations=config.max_iterations), scale * factor
