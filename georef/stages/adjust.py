"""Stage `adjust`: tie points among the new images, constraints of the configured kind, bundle adjustment."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from georef.config import AdjustConfig
from georef.estimation.adjustment.adjust_block import AdjustedBlock, BlockOptions, adjust_block
from georef.estimation.adjustment.block import Block
from georef.estimation.adjustment.campaign.checkpoints import Resumable
from georef.estimation.adjustment.campaign.partitioned import Partitioned
from georef.estimation.adjustment.campaign.standing import Standing, with_lasting_names
from georef.estimation.adjustment.campaign.updating import updated
from georef.estimation.adjustment.solver import Solve, SolverOptions, solve_block
from georef.estimation.epoch_problem import epoch_problem
from georef.estimation.guided import PosedFeatures
from georef.executor import Held
from georef.stages.adjusted_epoch import read_adjusted, write_adjusted, write_nothing
from georef.stages.adjustment_report import adjustment_data, adjustment_line, all_reliability
from georef.stages.adjustment_tables import write_tables
from georef.stages.base import StageContext, StageSummary
from georef.stages.earlier import note_inputs
from georef.stages.epoch_block import epoch_block
from georef.stages.epoch_images import localized_images, ties_among
from georef.stages.localize import make_task
from georef.stages.solve_files import SOLVES, SolveFiles
from georef.stages.standing_file import adjustment_inputs, standing_before, write_standing

_WORTH_PARTS = 200_000  # observations


def run(context: StageContext) -> StageSummary:
    """Adjusts the localized images of the epoch."""
    new = localized_images(context)
    if not new.images:
        write_nothing(context.folder)
        return StageSummary("no image was localized; nothing to adjust")
    task, config = make_task(context), context.config.adjust
    ties, matched = ties_among(context, task, new)
    problem = epoch_problem(new.images, new.localized, new.posed, ties, task.map, context.survey.control, config)
    given, before = epoch_block(context, new.images, new.localized, problem)
    given = with_lasting_names(given)
    adjusted, told = _adjusted(context, given)
    checked = all_reliability(adjusted, context.survey.world)
    data = adjustment_data(given, adjusted, checked) | before | told | {"pairs_matched": matched}
    write_tables(context.folder, adjusted, checked, context.survey.world)
    marked = {mark.image_id for point in context.survey.check for mark in point.marks}
    write_adjusted(context.folder, adjusted, marked, _colors(adjusted, new.posed), data)
    write_standing(context.folder, Standing.of(given, adjusted))
    _solves(context).clear()
    return StageSummary(adjustment_line(data), data, len(new.images), len(new.images))


def _adjusted(context: StageContext, given: Block) -> tuple[AdjustedBlock, dict[str, Any]]:
    """The block adjusted from the start or, where it only adds to one that stands, from there; and what the report says
    of that."""
    inputs = adjustment_inputs(context)
    note_inputs(context.folder, inputs)
    standing, options = standing_before(context, inputs), options_of(context.config.adjust)
    with context.executor.held() as held:
        solve = Resumable(_solves(context), solve_in(held, context.executor.workers, given))
        if standing is None:
            return adjust_block(given, options, solve=solve), {"updated_from": None}
        return updated(standing[0], given, options, solve), _still_wrong(standing[1])


def _solves(context: StageContext) -> SolveFiles:
    return SolveFiles(context.folder / SOLVES)


def _still_wrong(folder: Path) -> dict[str, Any]:
    """What an update keeps of the adjustment that it began with: coherent blocks are not looked for again."""
    before = read_adjusted(folder).data
    kept = ("coherent_blocks", "undecidable")
    return {"updated_from": folder.name, **{name: before[name] for name in kept if name in before}}


def solve_in(held: Held, workers: int, block: Block) -> Solve:
    """How a block is solved: by all workers where it is large enough to be worth their start."""
    return Partitioned(held, workers) if workers > 1 and len(block.observations) >= _WORTH_PARTS else solve_block


def options_of(config: AdjustConfig) -> BlockOptions:
    """How blocks are adjusted, as the configuration says."""
    options = BlockOptions.of(config.cauchy_scale, config.gate_probability)
    return replace(options, solver=SolverOptions(max_iterations=config.max_iterations))


def _colors(adjusted: AdjustedBlock, posed: list[PosedFeatures]) -> NDArray[np.uint8]:
    """The colour (P, 3) of each point in one of the images that see it."""
    colors = np.zeros((len(adjusted.block.points), 3), np.uint8)
    obs = adjusted.block.observations
    for index, image in enumerate(posed):
        here = (obs.view == index) & (obs.keypoint >= 0)
        colors[obs.point[here]] = image.features.colors_rgb[obs.keypoint[here]]
    return colors
