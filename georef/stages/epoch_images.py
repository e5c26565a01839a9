"""The localized images of an epoch as its adjustment takes them; what is large of each is read when it is needed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import overload

import numpy as np

from georef.estimation.epoch_problem import tie_pairs
from georef.estimation.guided import Bearings, PosedFeatures
from georef.estimation.tracks import PairMatches
from georef.io.items import item_path, read_outcome
from georef.stages.base import StageContext, feature_id, open_features
from georef.stages.localize import ITEMS, LocalizeTask
from georef.stages.stations import final_outcomes, final_results
from georef.stages.tie_matches import TieImage, matched_pairs
from georef.types.campaign import Image
from georef.types.results import Localized

TIES = "ties"


@dataclass(frozen=True, eq=False)
class EpochImages:
    """Images with their cameras as estimated, outcomes without the points behind them, where their keypoints are, and
    what matching needs; all in one order."""

    images: list[Image]
    localized: list[Localized]
    posed: list[PosedFeatures]
    tied: list[TieImage]


@dataclass(frozen=True)
class _Stored(Sequence[Localized]):
    """Outcomes that are read one by one."""

    folder: Path
    image_ids: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.image_ids)

    @overload
    def __getitem__(self, index: int) -> Localized: ...
    @overload
    def __getitem__(self, index: slice) -> Sequence[Localized]: ...
    def __getitem__(self, index: int | slice) -> Localized | Sequence[Localized]:
        if isinstance(index, slice):
            return _Stored(self.folder, self.image_ids[index])
        outcome = read_outcome(item_path(self.folder / ITEMS, self.image_ids[index]))
        assert isinstance(outcome, Localized)
        return outcome


def localized_images(context: StageContext) -> EpochImages:
    """Reads outcome after outcome and the keypoints of each image; descriptors, rays and points stay on the disk."""
    store, out = open_features(context.before["store"]), EpochImages([], [], [], [])
    for outcome in final_outcomes(context):
        if not isinstance(outcome, Localized):
            continue
        image = context.survey.epoch[outcome.image_id]
        image = image if outcome.camera is None else replace(image, camera=outcome.camera)
        features = store.read(feature_id(image, outcome.quarter_turns))
        plain = replace(features, descriptors=np.zeros((len(features), 0), features.descriptors.dtype))
        rays = Bearings(np.zeros((0, 3)), np.zeros((0, 3, 2)))
        out.images.append(image)
        out.tied.append(TieImage.of(image, outcome))
        out.posed.append(PosedFeatures(plain, image.camera, outcome.world_from_cam, rays))
        nothing = {"points_in_world": np.zeros((0, 3)), "keypoints": np.zeros(0, np.int64)}
        out.localized.append(replace(outcome, **nothing, notes=(), candidates=()))
    return out


def ties_among(context: StageContext, task: LocalizeTask, new: EpochImages) -> tuple[list[PairMatches], int]:
    """Matches among the images, and how many pairs were matched for them now."""
    if not context.config.adjust.tie_points:
        return [], 0
    stored = _Stored(final_results(context), tuple(image.image_id for image in new.images))
    pairs = tie_pairs(new.posed, stored, context.config.adjust.tie_neighbours)
    return matched_pairs(task, new.tied, pairs, context.folder.parent / TIES, context.executor)
