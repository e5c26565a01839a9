"""Stage `leave-one-out`: chosen reference images against the others, as if they were new.

An image is localized without itself and without the images of its station, which share its error. What it is compared
with, its given pose, is no part of its localization, but for the place that it is searched about.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from georef.config import Config
from georef.errors import ConfigError
from georef.estimation.reference_map import given_pose_cov
from georef.io.items import item_ids, item_path, read_outcome, write_outcome
from georef.stages.base import StageContext, StageSummary, feature_id
from georef.stages.localize import ITEMS, LocalizeTask, make_task, summary_of, usable_references
from georef.stages.network import read_noise
from georef.types.campaign import Image, PosePrior
from georef.types.results import Outcome

NAME = "leave-one-out"
_REST_ON_ALL = ("global-model",)  # methods whose points were made from all references, the left out one included


@dataclass(frozen=True)
class Choice:
    """Which reference images are localized: of one epoch or of all, at most so many, evenly spread over their list."""

    references: str | None = None
    count: int | None = None

    def of(self, images: Sequence[Image]) -> list[Image]:
        """The chosen ones of reference images."""
        found = [image for image in images if self.references in (None, image.epoch)]
        if self.count is None or self.count >= len(found):
            return found
        return [found[i] for i in np.linspace(0, len(found) - 1, self.count).round().astype(int)]

    def check(self, epochs: Sequence[str], config: Config) -> None:
        """Raises ConfigError: no such epoch, no image, or a method that cannot leave an image out."""
        if self.references is not None and self.references not in epochs:
            raise ConfigError(
                f"There is no reference epoch '{self.references}'.", f"Name one with --references: {', '.join(epochs)}."
            )
        if self.count is not None and self.count < 1:
            raise ConfigError(f"--count {self.count} leaves no image to localize.", "Expected at least 1.")
        if config.localize.method in _REST_ON_ALL:
            raise ConfigError(
                f"The method '{config.localize.method}' cannot leave a reference image out: its points rest on all.",
                "Use another, e.g. --set localize.method=query-centred.",
            )


@dataclass
class LeaveOneOutTask:
    """Localizes one reference image against the others."""

    task: LocalizeTask

    def __call__(self, image: Image) -> Outcome:
        similar = self.task.similar
        rest = self.task.map.without({other.image_id for other in self.task.reference.images if together(image, other)})
        if similar is not None:
            similar = replace(similar, row_of={feature_id(other): row for row, other in enumerate(rest.images)})
        return self.task.localized(as_new(image), rest, similar)


def together(image: Image, other: Image) -> bool:
    """Whether two reference images are one, or were taken as one."""
    if image.image_id == other.image_id:
        return True
    return image.station is not None and (image.epoch, image.station) == (other.epoch, other.station)


def as_new(image: Image) -> Image:
    """A reference image as a new one: of its pose only a place to search about is left."""
    assert image.world_from_cam is not None
    near = image.world_from_cam.translation
    return replace(image, world_from_cam=None, near=near, gnss=None, heading_rad=None, station=None, given_sigma=None)


def run(choice: Choice, context: StageContext) -> StageSummary:
    """Localizes every chosen image that has no outcome yet, storing each outcome as it comes."""
    folder = context.folder / ITEMS
    done = item_ids(folder)
    images = choice.of(usable_references(context))
    pending = [image for image in images if image.image_id not in done]
    task = LeaveOneOutTask(make_task(context))
    for outcome in context.executor.map_items(task, pending, NAME):
        write_outcome(item_path(folder, outcome.image_id), outcome)
    return summary_of(read_outcomes(choice, context), len(pending))


def outcomes_exist(choice: Choice, context: StageContext) -> bool:
    """Whether every chosen image has a stored outcome."""
    items = context.folder / ITEMS
    return all(item_path(items, image.image_id).is_file() for image in choice.of(usable_references(context)))


@dataclass(frozen=True, eq=False)
class Compared:
    """A left out image with its outcome and its given pose."""

    image: Image
    outcome: Outcome
    given: PosePrior


def read_compared(choice: Choice, context: StageContext) -> list[Compared]:
    """The chosen images with their outcomes and given poses, whose covariances are declared or estimated."""
    noise, _ = read_noise(context.before["network"])
    out = []
    for outcome in read_outcomes(choice, context):
        image = context.survey.reference[outcome.image_id]
        assert image.world_from_cam is not None
        out.append(Compared(image, outcome, PosePrior(image.world_from_cam, given_pose_cov(image, noise))))
    return out


def read_outcomes(choice: Choice, context: StageContext) -> list[Outcome]:
    """The outcomes of the chosen images, in the order of the reference."""
    items = context.folder / ITEMS
    return [read_outcome(item_path(items, image.image_id)) for image in choice.of(usable_references(context))]
