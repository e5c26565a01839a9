"""The block of an epoch: its problem with what the project declares of rigs, and the checks before it is adjusted."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from georef.estimation.adjustment.block import Block
from georef.estimation.adjustment.from_problem import Exposure, block_of
from georef.estimation.adjustment.problem import Problem
from georef.stages.base import StageContext
from georef.stages.datum import check_datum
from georef.types.campaign import Campaign, Image
from georef.types.results import Localized


def epoch_block(
    context: StageContext, images: Sequence[Image], localized: Sequence[Localized], problem: Problem
) -> tuple[Block, dict[str, Any]]:
    """The block that is adjusted, and what the report says of it beforehand. All sequences in one order.

    Raises InputError where map, GNSS and control contradict each other.
    """
    arms = [np.zeros(3) for _ in images]
    datum = check_datum(context, images, localized, arms)
    return block_of(problem, [exposure_of(image, context.survey.epoch) for image in images]), {"datum": datum}


def exposure_of(image: Image, epoch: Campaign) -> Exposure | None:
    """The station and mounting of an image whose rig is known."""
    mounting = epoch.mountings.get(image.image_id)
    return None if mounting is None or image.station is None else Exposure(image.station, mounting)
