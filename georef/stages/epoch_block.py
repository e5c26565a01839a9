"""The block of an epoch: its problem with what the project declares beside it, and the checks before it is adjusted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from georef.estimation.adjustment.block import Block
from georef.estimation.adjustment.from_problem import Exposure, block_of
from georef.estimation.adjustment.problem import Problem
from georef.estimation.epoch_problem import position_priors
from georef.stages.base import StageContext
from georef.stages.datum import check_datum
from georef.stages.epoch_constraints import lever_arms, offset_sigma_m, with_declared
from georef.types.campaign import Campaign, Image
from georef.types.results import Localized


def epoch_block(
    context: StageContext, images: Sequence[Image], localized: Sequence[Localized], problem: Problem
) -> tuple[Block, dict[str, Any]]:
    """The block that is adjusted, and what the report says of it beforehand. All sequences in one order.

    Raises InputError where map, GNSS and control contradict each other, and for what is wrong with declarations.
    """
    epoch = context.survey.epoch
    images = [_as_measured(image, epoch) for image in images]
    arms = lever_arms(context, [image.image_id for image in images])
    spread = offset_sigma_m(context.project.file.epochs[context.epoch])
    datum = check_datum(context, images, localized, arms, spread)
    if epoch.fixes and problem.position_priors:
        problem = replace(problem, position_priors=position_priors(images, localized))
    block = block_of(problem, [exposure_of(image, epoch) for image in images])
    return with_declared(context, block), {"datum": datum}


def exposure_of(image: Image, epoch: Campaign) -> Exposure | None:
    """The station and mounting of an image whose rig is known."""
    mounting = epoch.mountings.get(image.image_id)
    return None if mounting is None or image.station is None else Exposure(image.station, mounting)


def _as_measured(image: Image, epoch: Campaign) -> Image:
    """The image with its fix as it was measured, where that of localization allows for antenna and offset."""
    fix = epoch.fixes.get(image.image_id)
    return image if fix is None else replace(image, gnss=fix)
