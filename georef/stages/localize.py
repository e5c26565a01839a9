"""Stage `localize`: every image of the epoch against the reference; each gets an outcome."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from georef.config import Config
from georef.errors import ConfigError, StageError
from georef.estimation.localization import localize_image
from georef.estimation.reference_map import ReferenceMap
from georef.features.base import Extractor, Matcher
from georef.features.images import UnreadableImage
from georef.features.registry import MATCHERS, load_component
from georef.io.items import item_ids, item_path, read_outcome, write_outcome
from georef.io.structures import read_structure
from georef.stages.base import StageContext, StageSummary, feature_id, open_features
from georef.stages.earlier import note_inputs, take_over
from georef.stages.failures import internal_failure
from georef.stages.features import failed_images, load_extractor
from georef.stages.fingerprints import image_inputs
from georef.stages.index import SimilarImages, open_index
from georef.stages.network import read_noise
from georef.stages.turned import TurnableImage
from georef.types.campaign import Campaign, Image
from georef.types.features import Features
from georef.types.results import Outcome, ReferenceNoise, Rejected, RejectReason
from georef.types.scene import ImageStructure

ITEMS, STRUCTURE = "items", "structure"
_OF_IMAGES = ("epoch tables", "stage features")  # parts of the fingerprint that tell of images one by one


@dataclass
class LocalizeTask:
    """Localizes one image; what goes wrong with it is its outcome."""

    reference: Campaign
    noise: ReferenceNoise
    store_folder: Path
    config: Config
    failed: dict[str, tuple[str, str]]
    index_folder: Path | None  # of the vector database, where the ranking needs one
    map_folder: Path | None  # of the precomputed map, where the method needs one
    upright: frozenset[Path] = frozenset()  # pictures that are known to stand upright

    @cached_property
    def similar(self) -> SimilarImages | None:
        if self.index_folder is None:
            return None
        return open_index(self.index_folder, self.store_folder, self.config, self.map.images)

    @cached_property
    def map(self) -> ReferenceMap:
        store = open_features(self.store_folder)
        keys = {image.image_id: feature_id(image) for image in self.reference.images}

        def read(image_id: str, count: int | None) -> Features:
            return store.read(keys[image_id], count)

        folder, places = self.map_folder, {image.image_id: k for k, image in enumerate(self.reference.images)}

        def structure(index: int) -> ImageStructure:
            assert folder is not None
            return read_structure(item_path(folder / STRUCTURE, self.reference.images[index].image_id), places)

        return ReferenceMap(self.reference, read, self.noise, None if folder is None else structure)

    @cached_property
    def matcher(self) -> Matcher:
        return _matcher(self.config)

    def __call__(self, image: Image) -> Outcome:
        return self.localized(image, self.map, self.similar)

    def localized(self, image: Image, reference: ReferenceMap, index: SimilarImages | None) -> Outcome:
        """The outcome of an image against a reference map, by the search in the vector database that belongs to it."""
        failure = self.failed.get(feature_id(image))
        if failure is not None:
            return Rejected(image.image_id, RejectReason(failure[0]), failure[1])
        matcher = self.matcher  # what keeps it from loading ends the run, and so with map and index
        try:
            features = open_features(self.store_folder).read(feature_id(image))
            similar = None if index is None else index.to_image(image, features)
            return localize_image(
                image,
                features,
                reference,
                matcher,
                self.config.candidates,
                self.config.localize,
                self.config.matching.max_keypoints,
                similar,
                self._picture(image, index),
            )
        except UnreadableImage as error:
            return Rejected(image.image_id, RejectReason.UNREADABLE, error.problem)
        except Exception as error:
            reason, detail = internal_failure(error, f"localization of {image.image_id}")
            return Rejected(image.image_id, RejectReason(reason), detail)

    def _picture(self, image: Image, index: SimilarImages | None) -> TurnableImage | None:
        """None for an image that cannot lie on its side, and where turned ones are not to be tried."""
        if not self.config.localize.try_turned or image.path in self.upright:
            return None
        return TurnableImage(image, self.store_folder, self.config.features, lambda: self.extractor, index)

    @cached_property
    def extractor(self) -> Extractor:
        return load_extractor(self.config.features)


def run(context: StageContext) -> StageSummary:
    """Localises every image that has no outcome yet, storing each outcome as it comes; those of images that did not
    change are taken over from before others were added."""
    folder = context.folder / ITEMS
    inputs = image_inputs(context.survey, failed_images(context.before["features"]))
    note_inputs(context.folder, inputs)
    take_over(context, "localize", ITEMS, inputs, _OF_IMAGES)
    done = item_ids(folder)
    images = context.survey.epoch.images
    pending = [image for image in images if image.image_id not in done]
    task = make_task(context)
    for outcome in context.executor.map_items(task, pending, "localize"):
        write_outcome(item_path(folder, outcome.image_id), outcome)
    outcomes = read_outcomes(context.folder, context.survey.epoch)
    return summary_of(outcomes, len(pending))


def make_task(context: StageContext) -> LocalizeTask:
    """The reference as it takes part: of the chosen epochs, without suspects and what has no features."""
    epochs = set(context.config.candidates.epochs or context.project.file.reference_epochs)
    usable = tuple(image for image in usable_references(context) if image.epoch in epochs)
    if len(usable) < 2:
        raise StageError(f"Only {len(usable)} reference images can be used, at least two are needed.")
    campaign, folders = Campaign(context.survey.reference.epoch, usable), context.before
    noise, failed = read_noise(folders["network"])[0], failed_images(folders["features"])
    index, precomputed = folders.get("index"), folders.get("tracks", folders.get("global-map"))
    upright = frozenset(cutout.path for cutout in context.survey.cutouts)  # of panoramas
    return LocalizeTask(campaign, noise, folders["store"], context.config, failed, index, precomputed, upright)


def usable_references(context: StageContext) -> list[Image]:
    """The reference images of all epochs that have features and do not contradict the others."""
    suspects, failed = read_noise(context.before["network"])[1], failed_images(context.before["features"])
    images = context.survey.reference.images
    return [i for i in images if i.image_id not in suspects and feature_id(i) not in failed]


def outcomes_exist(context: StageContext) -> bool:
    """Whether every image of the epoch has a stored outcome."""
    items = context.folder / ITEMS
    return all(item_path(items, image.image_id).is_file() for image in context.survey.epoch.images)


def read_outcomes(folder: Path, epoch: Campaign, items: str = ITEMS) -> Iterator[Outcome]:
    """The outcomes of all images of an epoch, in its order, one by one."""
    return (read_outcome(item_path(folder / items, image.image_id)) for image in epoch.images)


def summary_of(outcomes: Iterable[Outcome], computed: int) -> StageSummary:
    """Outcomes in a line, and in figures; none is kept."""
    rejected: Counter[str] = Counter()
    localized: list[tuple[float, int]] = []  # sigma in metres, correspondences
    for o in outcomes:
        if isinstance(o, Rejected):
            rejected[o.reason.value] += 1
        else:
            localized.append((float(np.sqrt(np.trace(o.world_from_cam_cov[3:, 3:]))), o.correspondence_count))
    total = len(localized) + rejected.total()
    line = f"{len(localized)} of {total} images localized"
    if localized:
        sigma, count = np.median(localized, axis=0)
        line += f", median sigma {1e3 * sigma:.1f} mm, {count:.0f} correspondences"
    if rejected:
        line += "; rejected: " + ", ".join(f"{count} {reason}" for reason, count in rejected.items())
    return StageSummary(line, {"localized": len(localized), "rejected": dict(rejected)}, computed, total)


def matcher_version(config: Config) -> str:
    """The matcher's version. Raises ConfigError where it does not fit the features."""
    matcher = _matcher(config)
    fitting = getattr(matcher, "extractors", None)  # None: any
    if fitting is not None and config.features.extractor not in fitting:
        raise ConfigError(
            f"The matcher '{config.matching.matcher}' cannot match features of '{config.features.extractor}'.",
            f"Expected features.extractor to be {' or '.join(fitting)}.",
            "Choose another with --set matching.matcher=mutual-nn, or a preset such as sift.",
        )
    return matcher.version()


def _matcher(config: Config) -> Matcher:
    options = {"device": config.features.device, **config.matching.options}
    return load_component(MATCHERS, config.matching.matcher, **options)
