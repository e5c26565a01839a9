"""A solution of a block as plain values for report.json."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from georef.estimation.adjustment.blunders.gates import RejectedConstraint
from georef.estimation.adjustment.equations.constraint_terms import DISTANCES
from georef.estimation.adjustment.measured.check import check_block
from georef.estimation.adjustment.measured.correlations import correlations_of, unknowns_of
from georef.estimation.adjustment.measured.solution_quality import (
    control_quality,
    position_quality,
    variance_components,
)
from georef.estimation.adjustment.measured.solutions import Solved
from georef.estimation.adjustment.quality.reliability import DELTA0
from georef.evaluation.statistics import finite, finite_list
from georef.geometry.rigid import Array
from georef.types.constraints import CheckKind, CheckPoint, ControlPoint

_CHECKED = 0.01  # a redundancy number below it: next to nothing checks the observation
_UNKNOWN_M = 1e3  # no survey is that uncertain


def variant_numbers(found: Solved, tie_ids: Sequence[str] = ()) -> dict[str, Any]:
    """A solution with its quality; tie_ids: names of the first points of its block, for the ends of distances."""
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
        "components": {name: part.to_dict() for name, part in variance_components(found).items()},
        "control_points": control,
        "control_residuals_m": [row["residual_m"] for row in control],
        "control_rms_m": rms(residuals),
        "distances": distance_numbers(found, tie_ids),
        "gnss": None if positions is None else asdict(positions),
        "gnss_residual_rms_m": None if positions is None else list(positions.residual_rms_m),
        "rejected": [rejected_numbers(named(entry, tie_ids)) for entry in found.rejected],
        "rejected_marks": [asdict(mark) for mark in found.rejected_marks],
        "check": {str(kind): summary.to_dict() for kind, summary in summaries.items()},
        "check_points": [error.to_dict() for error in found.check.errors.determined],
        "not_determined": [entry.to_dict() for entry in found.check.errors.not_determined],
        "shared_unknowns": [asdict(unknown) for unknown in unknowns_of(found)],
        "correlations": [asdict(c) for c in correlations_of(found)],
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


def named(entry: RejectedConstraint, tie_ids: Sequence[str]) -> RejectedConstraint:
    """The entry with the names of tie points for their numbers."""
    name = re.sub(r"point (\d+)", lambda m: tie_ids[int(m[1])] if int(m[1]) < len(tie_ids) else m[0], entry.name)
    return replace(entry, name=name)


def distance_numbers(found: Solved, tie_ids: Sequence[str]) -> list[dict[str, Any]]:
    """Each measured distance that took part: what it differs by, and how well it is checked."""
    test = next((t for t in found.quality.constraints if t.name == DISTANCES), None)
    if test is None:
        return []
    given, points = found.block.distances, found.solution.state.points
    out: list[dict[str, Any]] = []
    for k, row in enumerate(test.row.tolist()):
        a, b = int(given.a[row]), int(given.b[row])
        length, redundancy = float(np.linalg.norm(points[a] - points[b])), float(test.cofactor[k, 0, 0])
        sigma = float(given.sigma_m[row])
        checked = redundancy > _CHECKED
        out.append(
            {
                "a": tie_ids[a],
                "b": tie_ids[b],
                "distance_m": float(given.distance_m[row]),
                "residual_m": length - float(given.distance_m[row]),
                "redundancy": redundancy,
                "w": float(test.residual[k, 0] / np.sqrt(redundancy)) if checked else None,
                "detectable_m": float(DELTA0 * sigma / np.sqrt(redundancy)) if checked else None,
            }
        )
    return out


def partial_check_numbers(found: Solved, points: Sequence[ControlPoint]) -> list[dict[str, Any]]:
    """Points that are no control and known in height or horizontally alone: differences of what is known."""
    asked = [CheckPoint(p.point_id, CheckKind.ABSOLUTE, p.point_in_world, p.cov, p.marks) for p in points]
    checked = check_block(found.block, found.solution.state, found.cofactors.apply, asked).errors
    sizes = {p.point_id: np.sqrt(np.diag(p.cov)) for p in points}
    out: list[dict[str, Any]] = []
    for error in checked.determined:
        known, sigma = sizes[error.point_id] < _UNKNOWN_M, error.predicted_sigma_m
        assert sigma is not None, "an adjusted block predicts"
        out.append(
            {
                "point_id": error.point_id,
                "difference_m": finite_list(np.where(known, error.difference_m, np.nan)),
                "predicted_sigma_m": finite_list(np.where(known, sigma, np.nan)),
            }
        )
    return out


def rms(values: Array) -> list[float | None] | None:
    """Root mean squares of columns; None for a column without values, and without rows."""
    if not len(values):
        return None
    seen = np.isfinite(values)
    count = seen.sum(axis=0)
    squares = np.where(seen, np.square(values), 0.0).sum(axis=0)
    return finite_list(np.sqrt(np.where(count > 0, squares / np.maximum(count, 1), np.nan)))
