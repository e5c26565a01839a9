"""Second thoughts about what a gate took out: rows are tested against the solution that lacks them.

A gate that rejects many at once takes good neighbours of wrong ones along. Once these are out, the good ones agree with
the rest: r' (S + A Q A')^-1 r, which for a single row is the statistic that it would have if it took part.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.stats import chi2

from georef.estimation.adjustment.block import Block, Indices, PointPriors, RelativePoses, State
from georef.estimation.adjustment.blunders.gates import Contradictions
from georef.estimation.adjustment.equations.constraint_terms import POSE_PRIORS, POSITION_PRIORS, constraint_terms, root
from georef.estimation.adjustment.quality.block_quality import Quality
from georef.estimation.adjustment.quality.group_tests import fitted_cofactor
from georef.geometry.rigid import Array

_PARTS = {POSE_PRIORS: "pose_priors", POSITION_PRIORS: "position_priors"}


def agreeing(
    wrong: Contradictions, block: Block, state: State, found: Quality, probability: float
) -> dict[str, Indices]:
    """Rows of what is out that agree with the rest, by list: poses, GNSS positions and points. block: with all rows;
    state, found: of the block without what is out."""
    given = np.flatnonzero(wrong.out["point_priors"])
    rows = {"point_priors": _agreeing_points(block, state, found.images.points, given, probability)}
    only = replace(
        block,
        pose_priors=block.pose_priors.take(wrong.out["pose_priors"]),
        position_priors=block.position_priors.take(wrong.out["position_priors"]),
        relative_poses=RelativePoses.none(),
        point_priors=PointPriors.none(),
    )
    for term in constraint_terms(only, state, found.cofactors.layout):
        if term.name not in _PARTS:
            continue
        part, width = _PARTS[term.name], term.residual.shape[1]
        shared: Array | float = 0.0 if found.references is None else found.references.of_rows(term.columns, width)
        square = _squares(term.residual, np.eye(width) + fitted_cofactor(term, found.cofactors) + shared)
        rows[part] = np.flatnonzero(wrong.out[part])[square <= chi2.ppf(probability, width)]
    return rows


def _agreeing_points(block: Block, state: State, points: Array, rows: Indices, probability: float) -> Indices:
    """Rows of given points that agree; of a point that nothing else determines nothing is known."""
    priors = block.point_priors
    rows = rows[np.isfinite(points[priors.point[rows]]).all(axis=(1, 2))]
    weight = root(priors.information[rows])
    weighted = np.any(weight != 0.0, axis=2)
    residual = np.einsum("kij,kj->ki", weight, state.points[priors.point[rows]] - priors.position[rows])
    fitted = weight @ points[priors.point[rows]] @ np.swapaxes(weight, 1, 2)
    square = _squares(residual, np.eye(3) + fitted)
    return rows[square <= chi2.ppf(probability, np.maximum(weighted.sum(axis=1), 1))]


def _squares(residual: Array, cov: Array) -> Array:
    return np.einsum("ki,ki->k", residual, np.linalg.solve(cov, residual[:, :, None])[:, :, 0])
