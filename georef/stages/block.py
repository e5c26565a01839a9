"""Verb `adjust` for a block of given image measurements: solutions, what check points say of them, and the report."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from georef import __version__
from georef.config import AdjustConfig
from georef.estimation.adjustment.campaign.checkpoints import Resumable
from georef.estimation.adjustment.measured.check import common_offset
from georef.estimation.adjustment.measured.correlations import correlations_of, ground_height_correlations, unknowns_of
from georef.estimation.adjustment.measured.solution_quality import CONTROL
from georef.estimation.adjustment.measured.solutions import (
    CleanBlock,
    Solved,
    clean,
    solve_with_control,
    solved,
    without_offset,
)
from georef.estimation.adjustment.solver import solve_block
from georef.io.files import write_text_atomically
from georef.project import Project
from georef.report.block_page import render_block
from georef.sections import HoldOut
from georef.stages.base import Meter
from georef.stages.block_comparison import comparisons
from georef.stages.block_files import write_block_cameras, write_block_poses
from georef.stages.block_hold_out import hold_out_numbers
from georef.stages.block_numbers import named, partial_check_numbers, rejected_numbers, variant_numbers
from georef.stages.block_pictures import picture_numbers
from georef.stages.block_state import block_inputs
from georef.stages.block_survey import BlockSurvey, load_block
from georef.stages.block_words import text_of
from georef.stages.solve_files import SOLVES, SolveFiles
from georef.types.constraints import CheckPoint, ControlPoint

REPORT, TEXT, PAGE, POSES, CAMERAS = "report.json", "report.txt", "report.html", "poses.csv", "cameras.csv"
Say = Callable[[str], None]


@dataclass(frozen=True)
class BlockRun:
    """What an adjustment left: the report as data, the lines to say, the files."""

    report: dict[str, Any]
    lines: tuple[str, ...]
    files: tuple[Path, ...]


def run(project: Project, name: str, say: Say = lambda _: None) -> BlockRun:
    """Adjusts a block as the project declares it, and again for each other choice of control points that it asks for.

    Interrupted, it goes on from its last iteration. Raises InputError, CrsError, GeorefError.
    """
    meter, survey = Meter(), load_block(project, name)
    config, section = project.config.adjust, project.file.blocks[name]
    datum = () if survey.has_gnss else survey.control(survey.declared_control)
    kept = SolveFiles(project.published(name) / SOLVES)
    solve = Resumable(kept, solve_block)
    cleaned = clean(survey.block, config, say, datum=datum, solve=solve)
    say("solution as declared")
    final = solve_with_control(cleaned, *_split(survey, survey.declared_control), config, solve)
    solutions = {"as declared": final}
    for title, control in _other_controls(survey).items():
        say(f"solution with {title}")
        solutions[title] = solve_with_control(cleaned, *_split(survey, control), config, solve)
    report: dict[str, Any] = {
        "georef": __version__,
        "project": project.file.name,
        "block": name,
        "crs": survey.world.describe(),
        "inputs": block_inputs(project, name),
        "data": _data(survey, cleaned),
        "rejected": [rejected_numbers(named(entry, survey.tie_ids)) for entry in cleaned.rejected],
        "variants": {title: _variant(survey, cleaned, found) for title, found in solutions.items()},
    }
    if survey.surveyed and survey.has_gnss and len(survey.block.drift_information) <= 1:
        say("offset between GNSS and surveyed points")
        report["offset"] = _offset(survey, cleaned, config, solutions)
    report["hold_outs"] = _hold_outs(survey, cleaned, config, section.hold_out, solutions, say)
    if section.compare is not None:
        report["comparisons"] = comparisons(project, section.compare, final)
    report["figures"] = picture_numbers(survey, final, solutions.get("all control"))
    report["timing"] = meter.read()
    done = _published(project, name, survey, final, report)
    kept.clear()
    return done


def _split(survey: BlockSurvey, control: Sequence[str]) -> tuple[tuple[ControlPoint, ...], tuple[CheckPoint, ...]]:
    return survey.control(control), survey.check(control)


def _other_controls(survey: BlockSurvey) -> dict[str, tuple[str, ...]]:
    """Solutions that are of interest beside the declared one: with all control, and, where GNSS says where the block
    is, without any."""
    every = tuple(point.point_id for point in survey.surveyed)
    out: dict[str, tuple[str, ...]] = {"no control": ()} if every and survey.has_gnss else {}
    out |= {"all control": every} if every else {}
    return {title: control for title, control in out.items() if set(control) != set(survey.declared_control)}


def _wrong(solutions: Mapping[str, Solved]) -> list[str]:
    """Points that contradict the others where they are control."""
    return sorted({entry.name for found in solutions.values() for entry in found.rejected if entry.kind == CONTROL})


def _hold_outs(
    survey: BlockSurvey,
    cleaned: CleanBlock,
    config: AdjustConfig,
    asked: HoldOut | None,
    solutions: Mapping[str, Solved],
    say: Say,
) -> list[dict[str, Any]]:
    """Splits of all points and, where some contradict the others, of those that do not as well."""
    if asked is None or asked.control >= len(survey.whole):
        return []
    say("splits into control and check points")
    free = solutions["no control" if survey.declared_control else "as declared"] if survey.has_gnss else None
    wrong = _wrong(solutions)
    out = [hold_out_numbers(survey, cleaned, config, asked, free)]
    left = [point for point in survey.whole if point.point_id not in wrong]
    if wrong and asked.control < len(left):
        out.append(hold_out_numbers(survey, cleaned, config, asked, free, tuple(wrong)))
    return out


def _variant(survey: BlockSurvey, cleaned: CleanBlock, found: Solved) -> dict[str, Any]:
    """A solution in numbers, with points that are known in part, and distances by the names of their ends."""
    kept = np.ones(len(survey.tie_ids), bool) if cleaned.kept_points is None else cleaned.kept_points
    ties = tuple(name for name, there in zip(survey.tie_ids, kept, strict=True) if there)
    partial = partial_check_numbers(found, survey.partly_known(found.given_control))
    return variant_numbers(found, ties) | {"partial_check_points": partial}


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
        "rejected_observations": cleaned.dropped,
        "dropped_points": survey.dropped + cleaned.dropped_points,
        "gnss_positions": len(block.position_priors),
        "surveyed_points": len(survey.surveyed),
        "marks": sum(len(point.marks) for point in survey.surveyed),
        "image_sigma_scale": cleaned.sigma_scale,
    }


def _offset(
    survey: BlockSurvey, cleaned: CleanBlock, config: AdjustConfig, solutions: Mapping[str, Solved]
) -> dict[str, Any]:
    """The offset of a block that GNSS alone holds from all surveyed points, none of which takes part; without those
    that contradict the others where they are control."""
    wrong = _wrong(solutions)
    points = [point for point in survey.check(()) if point.point_id not in wrong]
    start = replace(cleaned.state, drift_m=np.zeros((0, 3)))
    found = solved(without_offset(cleaned.block), start, points, config)
    offset = common_offset(found.check)
    if offset is None:
        return {}
    height = ground_height_correlations(found.block, found.check, found.cofactors.border)
    return {
        "offset_m": offset.offset_m.tolist(),
        "sigma_m": offset.sigma_m.tolist(),
        "statistic": offset.statistic,
        "left_over": offset.left_over,
        "mean_difference_m": np.mean([e.difference_m for e in found.check.errors.determined], axis=0).tolist(),
        "points": len(found.check.errors.determined),
        "left_out": wrong,
        "shared_unknowns": [asdict(unknown) for unknown in unknowns_of(found)],
        "height_correlations": [asdict(c) for c in height],
        "correlations": [asdict(c) for c in correlations_of(found)],
        "check_points": [error.to_dict() for error in found.check.errors.determined],
    }


def _published(project: Project, name: str, survey: BlockSurvey, final: Solved, report: dict[str, Any]) -> BlockRun:
    folder, lines = project.published(name), text_of(report)
    write_block_poses(survey, final, folder / POSES)
    write_block_cameras(final, folder / CAMERAS)
    write_text_atomically("\n".join(lines) + "\n", folder / TEXT)
    write_text_atomically(render_block(report), folder / PAGE)
    write_text_atomically(json.dumps(report, indent=1, allow_nan=False), folder / REPORT)
    return BlockRun(report, tuple(lines), tuple(folder / part for part in (REPORT, TEXT, PAGE, POSES, CAMERAS)))
