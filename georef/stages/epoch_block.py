"""The block of an epoch: its problem with what the project declares of rigs, and the checks before it is adjusted."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from georef.estimation.adjustment.block import Block
from georef.estimation.adjustment.from_problem import Exposure, block_of
from georef.estimation.adjustment.problem import Problem
from georef.stages.base import StageContext
from georef.types.campaign import Campaign, Image
from georef.types.results import Localized


def epoch_block(
    context: StageContext, images: Sequence[Image], localized: Sequence[Localized], problem: Problem
) -> tuple[Block, dict[str, Any]]:
    """The block that is adjusted, and what the report says of it beforehand. All sequences in one order."""
    return block_of(problem, [exposure_of(image, context.survey.epoch) for image in images]), {}


def exposure_of(image: Image, epoch: Campaign) -> Exposure | None:
    """The station and mounting of an image whose rig is known."""
    mounting = epoch.mountings.get(image.image_id)
    return None if mounting is None or image.station is None else Exposure(image.station, mounting)
