"""Splits of surveyed points into control and check points, and what the check points say of each."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from georef.config import AdjustConfig
from georef.estimation.adjustment.measured.check import BlockCheck, with_points_as_control
from georef.estimation.adjustment.measured.solutions import CleanBlock, Solved, solved, start_with, with_control
from georef.evaluation.check_points import CheckPointErrors
from georef.evaluation.splits import spread_splits
from georef.evaluation.statistics import summarize_nees
from georef.geometry.rigid import Array
from georef.sections import HoldOut
from georef.stages.block_numbers import rms
from georef.stages.block_survey import BlockSurvey


def hold_out_numbers(
    survey: BlockSurvey,
    cleaned: CleanBlock,
    config: AdjustConfig,
    hold_out: HoldOut,
    free: Solved | None,
    left_out: tuple[str, ...] = (),
) -> dict[str, Any]:
    """The splits and their medians. free: the solution without control, where GNSS holds the datum; left_out: points
    that take no part.

    Where GNSS holds the datum, one solution without control tells how all surveyed points and the block hang together,
    and so what each choice of control does; the first split is adjusted as well, and the report says how far the two
    differ. Without GNSS each split is adjusted. No split passes gates: none of its check points may be told by results.
    """
    positions = {point.point_id: point.point_in_world[:2] for point in survey.surveyed}
    if free is not None:
        names = [error.point_id for error in free.check.errors.determined]
    else:
        names = [point.point_id for point in survey.whole if len(point.marks) >= 2]
    names = [name for name in names if name not in left_out]
    chosen = spread_splits(np.array([positions[name] for name in names]), hold_out.control, hold_out.count)
    controls = [[names[i] for i in split] for split in chosen]
    if free is not None:
        known = _without(free.check, left_out)
        errors = [with_points_as_control(known, split) for split in chosen]
    else:
        errors = [_adjusted(survey, cleaned, config, control, left_out) for control in controls]
    splits = [_split_result(*pair) for pair in zip(errors, controls, strict=True)]
    again = _adjusted(survey, cleaned, config, controls[0], left_out) if free is not None else errors[0]
    values = [value for split in splits for value in split["nees"]]
    return {
        "left_out": list(left_out),
        "splits": splits,
        "median_rmse_m": np.median([split["rmse_m"] for split in splits], axis=0).tolist(),
        "largest_rmse_m": np.max([split["rmse_m"] for split in splits], axis=0).tolist(),
        "nees": summarize_nees(values, 3, effective_dof=3.0 * len(names)).to_dict(),
        "first_split_adjusted_differs_m": float(np.abs(_differences(again) - splits[0]["differences_m"]).max()),
    }


def _without(check: BlockCheck, names: tuple[str, ...]) -> BlockCheck:
    """The differences of the points that are not named."""
    errors, joint = check.errors, check.errors.joint_cov
    kept = [i for i, error in enumerate(errors.determined) if error.point_id not in names]
    rows = np.array([3 * i + k for i in kept for k in range(3)], dtype=np.int64)
    part = CheckPointErrors(
        tuple(errors.determined[i] for i in kept),
        errors.not_determined,
        None if joint is None else joint[np.ix_(rows, rows)],
    )
    return replace(check, errors=part)


def _adjusted(
    survey: BlockSurvey, cleaned: CleanBlock, config: AdjustConfig, names: list[str], left_out: tuple[str, ...]
) -> CheckPointErrors:
    """What the check points of a split say of its adjustment."""
    control = survey.control(names)
    block, start = with_control(cleaned.block, control), start_with(cleaned.state, control)
    check = [point for point in survey.check(names) if point.point_id not in left_out]
    return solved(block, start, check, config).check.errors


def _differences(errors: CheckPointErrors) -> Array:
    return np.array([error.difference_m for error in errors.determined])


def _split_result(errors: CheckPointErrors, control: list[str]) -> dict[str, Any]:
    return {
        "control": control,
        "check": [error.point_id for error in errors.determined],
        "rmse_m": rms(_differences(errors)),
        "differences_m": [error.difference_m.tolist() for error in errors.determined],
        "nees": [error.nees for error in errors.determined],
    }
