"""Verb `adjust` for a block of given image measurements: solutions, what check points say of them, and the report."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from georef import __version__
from georef.config import AdjustConfig
from georef.estimation.adjustment.block import Block, State
from georef.estimation.adjustment.block_check import common_offset, with_points_as_control
from georef.estimation.adjustment.block_correlations import (
    Correlation,
    ground_height_correlations,
    shared_unknowns,
    strong_correlations,
)
from georef.estimation.adjustment.block_solutions import (
    CleanBlock,
    Solved,
    clean,
    solve_with_control,
    solved,
    without_offset,
)
from georef.evaluation.check_points import CheckPointErrors
from georef.evaluation.splits import spread_splits
from georef.evaluation.statistics import summarize_nees
from georef.geometry.camera import Camera
from georef.io.files import write_text_atomically
from georef.io.pix4d import read_pix4d_camera
from georef.project import Project
from georef.sections import HoldOut
from georef.stages.base import Meter
from georef.stages.block_files import write_block_cameras, write_block_poses
from georef.stages.block_survey import BlockSurvey, load_block
from georef.stages.block_words import comparison, text_of
from georef.types.constraints import CheckPoint, ControlPoint

REPORT, TEXT, POSES, CAMERAS = "report.json", "report.txt", "poses.csv", "cameras.csv"
Say = Callable[[str], None]


@dataclass(frozen=True)
class BlockRun:
    """What an adjustment left: the report as data, the lines to say, the files."""

    report: dict[str, Any]
    lines: tuple[str, ...]
    files: tuple[Path, ...]


def run(project: Project, name: str, say: Say = lambda _: None) -> BlockRun:
    """Adjusts a block as the project declares it, and again for each other choice of control points that it asks for.

    Raises InputError, CrsError, GeorefError.
    """
    meter, survey = Meter(), load_block(project, name)
    config, section = project.config.adjust, project.file.blocks[name]
    base = survey.block if survey.block.drift_information.size == 0 else without_offset(survey.block)
    cleaned = clean(base, config, say)
    declared = CleanBlock(
        _with_offset_of(survey, cleaned),
        _start(survey, cleaned),
        *(cleaned.rejected, cleaned.dropped_points, cleaned.sigma_scale),
    )
    say("solution as declared")
    final = solve_with_control(declared, *_split(survey, survey.declared_control), config)
    variants = {"as declared": _variant(survey, final)}
    others = _other_controls(survey)
    for title, control in others.items():
        say(f"solution with {title}")
        variants[title] = _variant(survey, solve_with_control(declared, *_split(survey, control), config))
    report: dict[str, Any] = {
        "georef": __version__,
        "project": project.file.name,
        "block": name,
        "crs": survey.world.describe(),
        "data": _data(survey, cleaned),
        "variants": variants,
    }
    if survey.surveyed and len(base.position_priors):
        say("offset between GNSS and surveyed points")
        report["offset"] = _offset(survey, cleaned, config)
    if section.hold_out is not None and section.hold_out.control < len(survey.surveyed):
        say("splits into control and check points")
        report["hold_out"] = _hold_out(survey, declared, config, section.hold_out)
    if section.compare is not None:
        report["comparison"] = _comparison(project, section.compare.camera, final, section.compare.format)
    report["timing"] = meter.read()
    return _published(project, name, survey, final, report)


def _with_offset_of(survey: BlockSurvey, cleaned: CleanBlock) -> Block:
    """The clean block with the GNSS offset that the project declares."""
    return replace(
        cleaned.block,
        position_priors=survey.block.position_priors,
        drift_information=survey.block.drift_information,
    )


def _start(survey: BlockSurvey, cleaned: CleanBlock) -> State:
    return replace(cleaned.state, drift_m=np.zeros((len(survey.block.drift_information), 3)))


def _split(survey: BlockSurvey, control: Sequence[str]) -> tuple[tuple[ControlPoint, ...], tuple[CheckPoint, ...]]:
    return survey.control(control), survey.check(control)


def _other_controls(survey: BlockSurvey) -> dict[str, tuple[str, ...]]:
    """Solutions that are of interest beside the declared one: without any control, and with all of it."""
    every = tuple(point.point_id for point in survey.surveyed)
    out = {"no control": (), "all control": every} if every else {}
    return {title: control for title, control in out.items() if set(control) != set(survey.declared_control)}


def _data(survey: BlockSurvey, cleaned: CleanBlock) -> dict[str, Any]:
    block = survey.block
    rays = np.bincount(cleaned.block.observations.point)
    return {
        "images": len(block.image_ids),
        "stations": len(block.station_ids),
        "cameras": len(block.calibrations),
        "tie_points": len(cleaned.block.points),
        "image_observations": len(cleaned.block.observations),
        "rays_per_point": float(rays.mean()),
        "rejected_observations": cleaned.rejected,
        "dropped_points": survey.dropped + cleaned.dropped_points,
        "gnss_positions": len(block.position_priors),
        "surveyed_points": len(survey.surveyed),
        "marks": sum(len(point.marks) for point in survey.surveyed),
        "image_sigma_scale": cleaned.sigma_scale,
    }


def _variant(survey: BlockSurvey, found: Solved) -> dict[str, Any]:
    """A solution in numbers."""
    state, priors = found.solution.state, found.block.point_priors
    control = state.points[priors.point] - priors.position
    summaries = found.check.errors.summarize()
    return {
        "control": list(priors.point_ids),
        "iterations": found.solution.iterations,
        "converged": found.solution.converged,
        "sigma0": found.sigma0,
        "control_residuals_m": control.tolist(),
        "control_rms_m": _rms(control),
        "check": {str(kind): summary.to_dict() for kind, summary in summaries.items()},
        "check_points": [error.to_dict() for error in found.check.errors.determined],
        "not_determined": [entry.to_dict() for entry in found.check.errors.not_determined],
        "gnss_residual_rms_m": _rms(_gnss_residuals(found)),
        "shared_unknowns": [asdict(unknown) for unknown in shared_unknowns(found)],
        "correlations": [asdict(c) for c in strong_correlations(found)],
    }


def _gnss_residuals(found: Solved) -> np.ndarray:
    """Adjusted less measured positions (K, 3) of the antenna, the offset taken off."""
    priors, state = found.block.position_priors, found.solution.state
    if not len(priors):
        return np.zeros((0, 3))
    lever = state.lever_arms_m[priors.antenna]
    antenna = state.world_from_rig.take(priors.station).apply(lever)
    drift = np.zeros((len(priors), 3))
    for column in range(2):
        there = priors.drift_node[:, column] >= 0
        drift[there] += priors.drift_weight[there, column, None] * state.drift_m[priors.drift_node[there, column]]
    return antenna + drift - priors.position


def _rms(values: np.ndarray) -> list[float] | None:
    return np.sqrt(np.mean(np.square(values), axis=0)).tolist() if len(values) else None


def _offset(survey: BlockSurvey, cleaned: CleanBlock, config: AdjustConfig) -> dict[str, Any]:
    """The offset of a block that GNSS alone holds from all surveyed points, none of which takes part."""
    found = solved(cleaned.block, cleaned.state, survey.check(()), config)
    offset = common_offset(found.check)
    assert offset is not None, "there are surveyed points"
    height: list[Correlation] = ground_height_correlations(found.block, found.check, found.cofactors.border)
    return {
        "offset_m": offset.offset_m.tolist(),
        "sigma_m": offset.sigma_m.tolist(),
        "statistic": offset.statistic,
        "left_over": offset.left_over,
        "mean_difference_m": np.mean([e.difference_m for e in found.check.errors.determined], axis=0).tolist(),
        "points": len(found.check.errors.determined),
        "shared_unknowns": [asdict(unknown) for unknown in shared_unknowns(found)],
        "height_correlations": [asdict(c) for c in height],
        "correlations": [asdict(c) for c in strong_correlations(found)],
        "check_points": [error.to_dict() for error in found.check.errors.determined],
    }


def _hold_out(survey: BlockSurvey, declared: CleanBlock, config: AdjustConfig, hold_out: HoldOut) -> dict[str, Any]:
    """Splits into control and check points: what the check points say of each.

    One solution without control tells how all surveyed points and the block hang together, and so what each choice of
    control does; the first split is adjusted as well, and the report says how far the two differ.
    """
    free = solve_with_control(declared, (), survey.check(()), config).check
    names = [error.point_id for error in free.errors.determined]
    positions = {point.point_id: point.point_in_world[:2] for point in survey.surveyed}
    chosen = spread_splits(np.array([positions[name] for name in names]), hold_out.control, hold_out.count)
    splits = [_split_result(with_points_as_control(free, split), [names[i] for i in split]) for split in chosen]
    adjusted = solve_with_control(declared, *_split(survey, splits[0]["control"]), config).check.errors
    again = np.array([error.difference_m for error in adjusted.determined])
    values = [value for split in splits for value in split["nees"]]
    return {
        "splits": splits,
        "median_rmse_m": np.median([split["rmse_m"] for split in splits], axis=0).tolist(),
        "largest_rmse_m": np.max([split["rmse_m"] for split in splits], axis=0).tolist(),
        "nees": summarize_nees(values, 3, effective_dof=3.0 * len(names)).to_dict(),
        "first_split_adjusted_differs_m": float(np.abs(again - splits[0]["differences_m"]).max()),
    }


def _split_result(errors: CheckPointErrors, control: list[str]) -> dict[str, Any]:
    return {
        "control": control,
        "check": [error.point_id for error in errors.determined],
        "rmse_m": _rms(np.array([error.difference_m for error in errors.determined])),
        "differences_m": [error.difference_m.tolist() for error in errors.determined],
        "nees": [error.nees for error in errors.determined],
    }


def _comparison(project: Project, path: str, found: Solved, program: str) -> dict[str, Any]:
    ours = found.solution.state.cameras[0]
    theirs: Camera = read_pix4d_camera(project.data(path), (ours.width, ours.height))
    return comparison(ours, theirs, program)


def _published(project: Project, name: str, survey: BlockSurvey, final: Solved, report: dict[str, Any]) -> BlockRun:
    folder, lines = project.published(name), text_of(report)
    write_block_poses(survey, final, folder / POSES)
    write_block_cameras(final, folder / CAMERAS)
    write_text_atomically("\n".join(lines) + "\n", folder / TEXT)
    write_text_atomically(json.dumps(report, indent=1, allow_nan=False), folder / REPORT)
    return BlockRun(report, tuple(lines), tuple(folder / part for part in (REPORT, TEXT, POSES, CAMERAS)))
