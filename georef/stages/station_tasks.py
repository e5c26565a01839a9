"""What the stage `stations` does with one exposure, one pair of images, one sequence."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from georef.estimation.guided import GuidedOptions, PosedFeatures, guided_matches
from georef.estimation.station_image import StationImage
from georef.estimation.station_search import first_station_pose
from georef.estimation.stations import localize_station, localize_window
from georef.estimation.tracks import PairMatches
from georef.geometry.rigid import Rigid3
from georef.stages.base import feature_id, open_features
from georef.stages.failures import internal_failure
from georef.stages.localize import LocalizeTask
from georef.types.campaign import Image, Mounting
from georef.types.results import Localized, Outcome

_KEPT_IMAGES = 64
Pair = tuple[str, str]
Window = tuple[list[list[Image]], int]
"""The exposures of a sequence, and which of them takes its pose from it."""


@dataclass
class StationTask:
    """Poses stations or windows; what goes wrong with one leaves its images as they were."""

    localize: LocalizeTask
    mountings: dict[str, Mounting]
    outcomes: dict[str, Outcome]
    ties: dict[Pair, NDArray[np.int32]] = field(default_factory=dict)

    def __call__(self, group: list[Image]) -> list[Outcome]:
        """The images of one exposure, together."""
        if len(group) < 2:
            return [self.outcomes[image.image_id] for image in group]
        return self.guarded(group, lambda: self._exposure(group))

    def _exposure(self, group: list[Image]) -> list[Outcome]:
        config = self.localize.config
        images = [self.station_image(image) for image in group if self._readable(image)]
        found = localize_station(images, self.localize.map, config.stations, config.localize, self._find)
        by_id = {outcome.image_id: outcome for outcome in found}
        return [by_id.get(image.image_id, self.outcomes[image.image_id]) for image in group]

    def _find(self, images: Sequence[StationImage]) -> Rigid3 | None:
        task, config = self.localize, self.localize.config
        keypoints, references = config.matching.max_keypoints, config.candidates.first_count
        return first_station_pose(images, task.map, task.matcher, keypoints, references, config.localize)

    def _readable(self, image: Image) -> bool:
        return feature_id(image) not in self.localize.failed

    def guarded(self, group: list[Image], compute: Callable[[], list[Outcome]]) -> list[Outcome]:
        try:
            return compute()
        except Exception as error:
            _, detail = internal_failure(error, f"the station of {group[0].image_id}")
            before = [self.outcomes[image.image_id] for image in group]
            return [replace(o, notes=(*o.notes, f"not posed together: {detail}")) for o in before]

    @cached_property
    def _kept(self) -> dict[str, PosedFeatures]:
        return {}

    def station_image(self, image: Image) -> StationImage:
        """An image with its features and its mounting; one that is a station by itself is its own rig."""
        known = self._kept.get(image.image_id)
        if known is None:
            outcome = self.outcomes[image.image_id]
            turns = outcome.quarter_turns if isinstance(outcome, Localized) else 0
            features = open_features(self.localize.store_folder).read(feature_id(image, turns))
            known = PosedFeatures.of(features, image.camera, Rigid3.identity())
            self._kept[image.image_id] = known
            if len(self._kept) > _KEPT_IMAGES:
                self._kept.pop(next(iter(self._kept)))
        mounting = self.mountings.get(image.image_id, Mounting("its own", Rigid3.identity()))
        return StationImage(image, known, mounting, self.outcomes[image.image_id])

    def posed(self, image: Image) -> PosedFeatures:
        outcome = self.outcomes[image.image_id]
        assert isinstance(outcome, Localized)
        return self.station_image(image).features.posed(outcome.world_from_cam)

    def __getstate__(self) -> dict[str, object]:
        return {key: value for key, value in self.__dict__.items() if key != "_kept"}


@dataclass
class TieTask:
    """Matches two images of neighbouring exposures along their epipolar lines."""

    stations: StationTask

    def __call__(self, pair: tuple[Image, Image]) -> tuple[Pair, NDArray[np.int32]]:
        config = self.stations.localize.config.localize
        options = GuidedOptions.of(config)
        a, b = (self.stations.posed(image) for image in pair)
        return (pair[0].image_id, pair[1].image_id), guided_matches(a, b, options).indices


@dataclass
class WindowTask:
    """The middle exposure of a sequence, posed with the others."""

    stations: StationTask

    def __call__(self, window: Window) -> list[Outcome]:
        groups, middle = window
        return self.stations.guarded(groups[middle], lambda: self._window(groups, middle))

    def _window(self, groups: list[list[Image]], middle: int) -> list[Outcome]:
        task, config = self.stations, self.stations.localize.config
        usable = [[s for s in map(task.station_image, group) if s.usable] for group in groups]
        kept = [k for k, group in enumerate(usable) if group]
        before = [task.outcomes[image.image_id] for image in groups[middle]]
        if len(kept) < 2 or middle not in kept:
            return before
        chosen = [usable[k] for k in kept]
        names = [s.image.image_id for group in chosen for s in group]
        ties = _ties_among(names, task.ties)
        found = localize_window(chosen, kept.index(middle), ties, task.localize.map, config.stations, config.localize)
        by_id = {outcome.image_id: outcome for outcome in found}
        return [by_id.get(outcome.image_id, outcome) for outcome in before]


def _ties_among(names: Sequence[str], ties: dict[Pair, NDArray[np.int32]]) -> list[PairMatches]:
    place = {name: i for i, name in enumerate(names)}
    return [PairMatches(place[a], place[b], m) for (a, b), m in ties.items() if a in place and b in place]
