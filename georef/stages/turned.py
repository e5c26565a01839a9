"""The pictures of new images, turned by quarter turns: their features are extracted when they are needed, and kept."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from georef.config import FeaturesConfig
from georef.estimation.turning import Looked
from georef.features.base import Extractor, extract_features
from georef.features.images import read_image, turned
from georef.io.exif import stated_quarter_turns
from georef.stages.base import feature_id
from georef.stages.features import extractor_version, feature_store, level_and_budget
from georef.stages.index import SimilarImages
from georef.store.feature_store import FeatureStore
from georef.types.campaign import Image
from georef.types.features import Features

_GLANCE_KEYPOINTS = 1024


@dataclass(frozen=True)
class TurnableImage:
    """A new image whose picture can be looked at turned."""

    image: Image
    store_folder: Path
    config: FeaturesConfig
    extractor: Callable[[], Extractor]  # loaded when it is first needed, which is seldom
    similar: SimilarImages | None

    @property
    def stated_turns(self) -> int:
        """Quarter turns clockwise that make the picture upright by its EXIF orientation."""
        try:
            return stated_quarter_turns(self.image.path)
        except OSError:
            return 0  # its features were extracted, so that it can be read: what is damaged is not the picture

    def glance(self, quarter_turns: int) -> Looked:
        """Features at half the level of the stored ones."""
        level, _ = level_and_budget(self.config)
        half = (level or max(self.image.camera.width, self.image.camera.height)) // 2
        return self._looked(self._extract(quarter_turns, half, _GLANCE_KEYPOINTS))

    def look(self, quarter_turns: int) -> Looked:
        """All features, from the store or into it."""
        key, store = feature_id(self.image, quarter_turns), self._store
        if not store.has(key, self.image.path):
            store.write(key, self._extract(quarter_turns, *level_and_budget(self.config)), self.image.path)
        return self._looked(store.read(key))

    def _extract(self, quarter_turns: int, level: int | None, budget: int | None) -> Features:
        pixels = turned(self._pixels, quarter_turns)
        return extract_features(self.extractor(), pixels, level, budget).turned_back(quarter_turns)

    def _looked(self, features: Features) -> Looked:
        return Looked(features, None if self.similar is None else self.similar.to_image(self.image, features))

    @cached_property
    def _pixels(self) -> NDArray[np.uint8]:
        return read_image(self.image.path)

    @cached_property
    def _store(self) -> FeatureStore:
        return feature_store(self.store_folder, extractor_version(self.config), self.config)
