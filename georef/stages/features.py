"""Stage `features`: local features of all reference and new images, into the feature store."""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from georef.config import FeaturesConfig
from georef.features.base import EXTRACTION_VERSION, Extractor, extract_features
from georef.features.images import UnreadableImage, read_image
from georef.features.registry import EXTRACTORS, load_component
from georef.stages.base import StageContext, StageSummary, feature_id
from georef.stages.failures import internal_failure
from georef.stages.panoramas import cut_missing
from georef.store.feature_store import FeatureStore
from georef.types.campaign import Image
from georef.types.results import RejectReason


@dataclass
class ExtractTask:
    """Extracts and stores the features of one image; returns why it could not, or None."""

    folder: Path
    version: str
    config: FeaturesConfig

    @cached_property
    def extractor(self) -> Extractor:
        return load_extractor(self.config)

    def __call__(self, image: Image) -> tuple[str, str] | None:
        extractor = self.extractor  # what keeps it from being loaded is no fault of the image
        try:
            return self._extract(extractor, image)
        except UnreadableImage as error:
            return RejectReason.UNREADABLE.value, error.problem
        except Exception as error:
            return internal_failure(error, f"extraction of {feature_id(image)}")

    def _extract(self, extractor: Extractor, image: Image) -> tuple[str, str] | None:
        pixels = read_image(image.path)
        camera, size = image.camera, (pixels.shape[1], pixels.shape[0])
        if size != (camera.width, camera.height):
            problem = f"the image has {size[0]} x {size[1]} px, its camera {camera.width} x {camera.height}"
            return RejectReason.WRONG_SIZE.value, problem
        features = extract_features(extractor, pixels, *level_and_budget(self.config))
        feature_store(self.folder, self.version, self.config).write(feature_id(image), features, image.path)
        return None


def run(context: StageContext) -> StageSummary:
    """Extracts what is not yet in the store; an image that cannot be read is listed, never fatal."""
    images = [*context.survey.reference.images, *context.survey.epoch.images]
    uncut = cut_missing(context.survey.cutouts, context.executor)
    version = extractor_version(context.config.features)
    folder = context.before["store"]
    store = feature_store(folder, version, context.config.features)
    pending = [image for image in images if not store.has(feature_id(image), image.path)]
    task = ExtractTask(folder, version, context.config.features)
    failed = {
        feature_id(image): failure
        for image, failure in zip(pending, context.executor.map_items(task, pending, "features"), strict=True)
        if failure is not None
    }
    failed |= {feature_id(image): uncut[image.path] for image in images if image.path in uncut}
    line = f"{len(images) - len(failed)} of {len(images)} images have features"
    unreadable = f"; not usable: {', '.join(sorted(failed))}" if failed else ""
    return StageSummary(line + unreadable, {"failed": failed}, len(pending) - len(failed), len(images))


def level_and_budget(config: FeaturesConfig) -> tuple[int | None, int | None]:
    """Longest side and number of keypoints; None for the full resolution, and for the budget of the level."""
    return config.longest_side_px or None, config.max_keypoints or None


def feature_store(folder: Path, version: str, config: FeaturesConfig) -> FeatureStore:
    """The store for features of a version, as the configuration keeps them."""
    return FeatureStore(folder, extractor_version=version, quantize=config.quantize)


def extractor_version(config: FeaturesConfig) -> str:
    """What decides the features beside the image: the component, its weights and settings, what is
    done alike for all components, level and budget."""
    level = f"longest side {config.longest_side_px or 'full'}"
    budget = f"at most {config.max_keypoints or 'the budget of the level'}"
    stored = "quantized" if config.quantize else "exact"
    return f"{load_extractor(config).version()}; extraction {EXTRACTION_VERSION}; {level}; {budget}; {stored}"


def load_extractor(config: FeaturesConfig) -> Extractor:
    """The configured extractor."""
    return load_component(EXTRACTORS, config.extractor, device=config.device)


def failed_images(folder: Path) -> dict[str, tuple[str, str]]:
    """Images without usable features, by key in the feature store: reason and detail, of a finished stage."""
    data = json.loads((folder / "stage.json").read_text(encoding="utf-8"))
    return {key: (reason, detail) for key, (reason, detail) in data["data"]["failed"].items()}
