"""Stage `index`: global descriptors of all reference images, into the vector database."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from georef.config import CandidatesConfig, Config
from georef.errors import StageError
from georef.estimation.candidates import Box
from georef.estimation.search import FindSimilar
from georef.features.globals.base import GlobalDescriptor, Needs, Row
from georef.features.globals.state import LearnedState
from georef.features.images import UnreadableImage, read_image, turned
from georef.features.registry import GLOBAL_DESCRIPTORS, load_component
from georef.geometry.angles import heading_of
from georef.stages.base import StageContext, StageSummary, feature_id, open_features
from georef.stages.failures import internal_failure
from georef.stages.features import failed_images
from georef.store.vector_index import IndexRow, VectorIndex
from georef.types.campaign import Image
from georef.types.features import Features

STATE, VECTORS = "descriptor.safetensors", "vectors"
_LEARNED_FROM = 2000  # images, evenly chosen: more teach little, and learning goes through them twice
_COMMITTED_TOGETHER = 500  # images: what an interruption may lose
logger = logging.getLogger(__name__)


def run(context: StageContext) -> StageSummary:
    """Learns the global descriptor where it must be learned, and describes what is not yet in the database."""
    failed = failed_images(context.before["features"])
    images = [image for image in context.survey.reference.images if feature_id(image) not in failed]
    task = DescribeTask(context.config, context.before["store"], context.folder / STATE)
    task.learn(images)
    vectors = open_vectors(context.folder, task.descriptor)
    there = vectors.keys()
    pending = [image for image in images if feature_id(image) not in there]
    rows = _rows(pending, context.executor.map_items(task, pending, "index"))
    while vectors.upsert(islice(rows, _COMMITTED_TOGETHER)):
        pass
    vectors.optimize()
    name = task.config.retrieval.descriptor
    line = f"{len(vectors)} of {len(images)} reference images in the vector database, by {name}"
    return StageSummary(line, {"indexed": len(vectors)}, len(pending), len(images))


def descriptor_version(config: Config) -> str:
    """What decides the descriptors beside the images and what is learned from them."""
    return _made(config).version()


def open_vectors(folder: Path, descriptor: GlobalDescriptor) -> VectorIndex:
    """The vector database of a stage's folder."""
    return VectorIndex(folder / VECTORS, version=descriptor.version(), size=descriptor.size)


@dataclass
class DescribeTask:
    """Describes one image; None where it can no longer be read."""

    config: Config
    store_folder: Path
    state_path: Path

    @cached_property
    def descriptor(self) -> GlobalDescriptor:
        made = _made(self.config)
        return made.with_state(LearnedState.load(self.state_path)) if _learns(made) else made

    def learn(self, images: Sequence[Image]) -> None:
        """Learns from reference images, unless that was done or there is nothing to learn."""
        made = _made(self.config)
        if _learns(made) and not self.state_path.is_file():
            chosen = np.unique(np.linspace(0, len(images) - 1, _LEARNED_FROM).round().astype(int))
            sample = [images[i] for i in chosen]
            made.learn(_Contents(made.needs, sample, self.store_folder)).save(self.state_path)

    def __call__(self, image: Image) -> Row | None:
        descriptor = self.descriptor  # what is wrong with it is wrong for all images
        try:
            for content in _Contents(descriptor.needs, [image], self.store_folder):
                return self.describe(content)
        except Exception as error:
            internal_failure(error, f"the global descriptor of {image.image_id}")
        return None

    def describe(self, content: Any) -> Row:
        """The row of an image's pixels or features, whichever the descriptor needs."""
        return self.descriptor.describe(*((content, None) if self.descriptor.needs == "pixels" else (None, content)))


@dataclass(frozen=True)
class _Contents:
    """What a descriptor looks at in each image, read as it is gone through; damaged files are left out."""

    needs: Needs
    images: Sequence[Image]
    store_folder: Path

    def __iter__(self) -> Iterator[Any]:
        for image in self.images:
            try:
                if self.needs == "pixels":
                    yield read_image(image.path)
                else:
                    yield open_features(self.store_folder).read(feature_id(image))
            except (UnreadableImage, StageError) as error:
                logger.warning("%s cannot be described: %s", image.image_id, error)


@dataclass(frozen=True, eq=False)
class SimilarImages:
    """Finds the references of a map in the vector database that look most like a new image."""

    task: DescribeTask
    vectors: VectorIndex
    row_of: Mapping[str, int]  # index into the reference map, by key in the database

    def to_image(self, image: Image, features: Features) -> FindSimilar:
        """The search for one image, which is described when it is first searched for, turned as its features were."""
        return _Search(self, image, features)


@dataclass(eq=False)
class _Search:
    """One image in the vector database."""

    similar: SimilarImages
    image: Image
    features: Features

    @cached_property
    def row(self) -> Row:
        task = self.similar.task
        if task.descriptor.needs != "pixels":
            return task.describe(self.features)
        return task.describe(turned(read_image(self.image.path), self.features.quarter_turns))

    def __call__(self, count: int, box: Box, config: CandidatesConfig) -> NDArray[np.int64]:
        """Asks for more where what comes is not in the map: references that were set aside since."""
        asked = count
        while True:
            found = self.similar.vectors.nearest(
                self.row,
                asked,
                centre=box.centre,
                half_side_m=box.half_side_m,
                heading_rad=box.heading_rad,
                heading_window_deg=None if box.heading_rad is None else config.heading_window_deg,
                epochs=config.epochs or None,
            )
            known = [self.similar.row_of[key] for key in found.keys if key in self.similar.row_of]
            if len(known) >= count or len(found.keys) < asked:
                return np.array(known[:count], np.int64)
            asked *= 2


def open_index(folder: Path, store_folder: Path, config: Config, references: Iterable[Image]) -> SimilarImages:
    """The vector database of a finished stage, for the references of a map in their order."""
    task = DescribeTask(config, store_folder, folder / STATE)
    vectors = open_vectors(folder, task.descriptor)
    if len(vectors) == 0:
        raise StageError(
            "The vector database of the reference is empty.",
            "Delete its folder and run again: it is made from the stored features.",
            f"In {folder}",
        )
    return SimilarImages(task, vectors, {feature_id(image): row for row, image in enumerate(references)})


def _rows(images: Sequence[Image], described: Iterable[Row | None]) -> Iterator[IndexRow]:
    for image, row in zip(images, described, strict=True):
        pose = image.world_from_cam
        if row is not None and pose is not None:
            heading = heading_of(pose.rotation)
            known = None if np.isnan(heading) else heading
            yield IndexRow(feature_id(image), pose.translation, known, image.epoch, image.camera.camera_id, row)


def _made(config: Config) -> Any:
    options = {"device": config.features.device, **config.retrieval.options}
    return load_component(GLOBAL_DESCRIPTORS, config.retrieval.descriptor, **options)


def _learns(descriptor: GlobalDescriptor) -> bool:
    return hasattr(descriptor, "learn")
