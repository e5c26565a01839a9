"""A solution of a block as plain values for report.json."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np

from georef.estimation.adjustment.block_correlations import shared_unknowns, strong_correlations
from georef.estimation.adjustment.block_gates import RejectedConstraint
from georef.estimation.adjustment.block_quality import control_quality, position_quality, variance_components
from georef.estimation.adjustment.block_solutions import Solved
from georef.estimation.adjustment.components import Component
from georef.evaluation.statistics import finite, finite_list
from georef.geometry.rigid import Array


def variant_numbers(found: Solved) -> dict[str, Any]:
    """A solution with its quality."""
    summaries = found.check.errors.summarize()
    control = control_numbers(found)
    positions = position_quality(found)
    residuals = np.array([row["residual_m"] for row in control], dtype=np.float64).reshape(-1, 3)
    return {
        "control": [row["point_id"] for row in control],
        "iterations": found.solution.iterations,
        "converged": found.solution.converged,
        "sigma0": found.sigma0,
        "redundancy": found.redundancy,
        "components": {name: component_numbers(part) for name, part in variance_components(found).items()},
        "control_points": control,
        "control_residuals_m": [row["residual_m"] for row in control],
        "control_rms_m": rms(residuals),
        "gnss": None if positions is None else asdict(positions),
        "gnss_residual_rms_m": None if positions is None else list(positions.residual_rms_m),
        "rejected": [rejected_numbers(entry) for entry in found.rejected],
        "rejected_marks": [asdict(mark) for mark in found.rejected_marks],
        "check": {str(kind): summary.to_dict() for kind, summary in summaries.items()},
        "check_points": [error.to_dict() for error in found.check.errors.determined],
        "not_determined": [entry.to_dict() for entry in found.check.errors.not_determined],
        "shared_unknowns": [asdict(unknown) for unknown in shared_unknowns(found)],
        "correlations": [asdict(c) for c in strong_correlations(found)],
    }


def component_numbers(part: Component) -> dict[str, Any]:
    """factor: estimated over stated 1-sigma; None where too little checks the group."""
    return {
        "observations": part.observations,
        "redundancy": part.redundancy,
        "factor": part.factor,
        "factor_sigma": part.factor_sigma,
    }


def rejected_numbers(entry: RejectedConstraint) -> dict[str, Any]:
    return {"kind": entry.kind, "name": entry.name, "statistic": finite(entry.statistic), "dof": entry.dof}


def control_numbers(found: Solved) -> list[dict[str, Any]]:
    """Each control point that took part; None where a coordinate is not given, or nothing checks it."""
    given = control_quality(found)
    if given is None:
        return []
    table, priors = given.coordinates, found.block.point_priors
    where = dict(zip(priors.point_ids, found.solution.state.points[priors.point], strict=True))
    marks = dict(zip(priors.point_ids, np.bincount(found.block.observations.point)[priors.point], strict=True))
    return [
        {
            "point_id": name,
            "position_in_world_m": [float(v) for v in where[name]],
            "marks": int(marks[name]),
            "residual_m": finite_list(table.residual[k]),
            "redundancy": finite_list(table.redundancy[k]),
            "w": finite_list(table.w[k]),
            "detectable_m": finite_list(table.detectable[k]),
            "effect_m": finite_list(table.effect[k]),
            "statistic": finite(float(given.statistic[k])),
            "dof": int(given.dof[k]),
        }
        for k, name in enumerate(table.ids)
    ]


def rms(values: Array) -> list[float | None] | None:
    """Root mean squares of columns; None for a column without values, and without rows."""
    if not len(values):
        return None
    seen = np.isfinite(values)
    count = seen.sum(axis=0)
    squares = np.where(seen, np.square(values), 0.0).sum(axis=0)
    return finite_list(np.sqrt(np.where(count > 0, squares / np.maximum(count, 1), np.nan)))
