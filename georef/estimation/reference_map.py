"""The reference as localization sees it: poses, cameras, and features read from the store when they are needed."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Collection, Sequence
from copy import copy
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from georef.estimation.guided import PosedFeatures
from georef.estimation.left_out import remaining
from georef.estimation.reference_errors import ReferenceErrors
from georef.geometry.angles import heading_of
from georef.geometry.projection import Views
from georef.geometry.rigid import Array, Rigid3
from georef.types.campaign import Campaign, Image
from georef.types.features import Features
from georef.types.results import ReferenceNoise
from georef.types.scene import ImageStructure

FeatureReader = Callable[[str, int | None], Features]
"""Features of an image id; the second argument reads only that many of the best."""

StructureReader = Callable[[int], ImageStructure]
"""What the precomputed map holds of a reference image, by its place among all of them."""

_KEPT_IMAGES = 64
_KEPT_PAIRS = 2000  # a few hundred matches each


class ReferenceMap:
    """Posed reference images with lazily read features; the most recently used ones are kept."""

    def __init__(
        self,
        campaign: Campaign,
        read_features: FeatureReader,
        noise: ReferenceNoise,
        read_structure: StructureReader | None = None,  # of the precomputed map, where there is one
    ) -> None:
        self.images: tuple[Image, ...] = tuple(image for image in campaign.images if image.world_from_cam is not None)
        self.poses: list[Rigid3] = [image.world_from_cam for image in self.images if image.world_from_cam is not None]
        self.noise = noise
        self.positions: Array = np.array([pose.translation for pose in self.poses]).reshape(-1, 3)
        self.headings_rad: Array = np.array([heading_of(pose.rotation) for pose in self.poses])  # NaN: up or down
        self._pairs: OrderedDict[tuple[int, int], Any] = OrderedDict()
        self._read, self._read_structure = read_features, read_structure
        self._heads: OrderedDict[tuple[str, int], Features] = OrderedDict()
        self._posed: OrderedDict[str, PosedFeatures] = OrderedDict()
        self._structures: OrderedDict[int, ImageStructure] = OrderedDict()

    def __len__(self) -> int:
        return len(self.images)

    def without(self, left_out: Collection[str]) -> ReferenceMap:
        """The map without some images (ids), the others in their order; features read so far are shared.

        Tracks are intersected again without the observations of the images that are left out.
        """
        keep = [i for i, image in enumerate(self.images) if image.image_id not in left_out]
        part = copy(self)
        part.images = tuple(self.images[i] for i in keep)
        part.poses = [self.poses[i] for i in keep]
        part.positions, part.headings_rad = self.positions[keep], self.headings_rad[keep]
        part._pairs, part._structures = OrderedDict(), OrderedDict()
        if self._read_structure is not None:
            place = np.full(len(self), -1, np.int64)
            place[keep] = np.arange(len(keep))
            part._read_structure = lambda index: self._remaining(keep[index], place)
        return part

    def _remaining(self, index: int, place: NDArray[np.int64]) -> ImageStructure:
        return remaining(self.structure(index), index, place, self.posed, self.pose_cov, self.noise)

    def head(self, index: int, count: int) -> Features:
        """The best `count` features of a reference image."""
        image_id = self.images[index].image_id
        return _remember(self._heads, (image_id, count), 4096, lambda: self._read(image_id, count))

    def posed(self, index: int) -> PosedFeatures:
        """All features of a reference image with its pose."""
        image = self.images[index]
        return _remember(
            self._posed,
            image.image_id,
            _KEPT_IMAGES,
            lambda: PosedFeatures.of(self._read(image.image_id, None), image.camera, self.poses[index]),
        )

    def structure(self, index: int) -> ImageStructure:
        """The points of the precomputed map that a reference image sees; ValueError where there is no such map."""
        if self._read_structure is None:
            raise ValueError("this reference has no precomputed map")
        read = self._read_structure
        return _remember(self._structures, index, _KEPT_IMAGES, lambda: read(index))

    def pair(self, indices: tuple[int, int], verify: Callable[[], Any]) -> Any:
        """What is known of a pair of references, found once as long as it is among those used last."""
        return _remember(self._pairs, indices, _KEPT_PAIRS, verify)

    def views(self, indices: Sequence[int]) -> Views:
        return Views.of([self.poses[i] for i in indices], [self.images[i].camera for i in indices])

    def pose_cov(self, index: int) -> Array:
        """Covariance (6, 6) of a reference pose."""
        return given_pose_cov(self.images[index], self.noise)

    def errors(self, indices: Sequence[int]) -> ReferenceErrors:
        """The errors of reference poses; images of one station share theirs."""
        images = [self.images[i] for i in indices]
        stations = [None if image.station is None else (image.epoch, image.station) for image in images]
        return ReferenceErrors.of_stations(
            [self.poses[i] for i in indices], [self.pose_cov(i) for i in indices], stations
        )


def given_pose_cov(image: Image, noise: ReferenceNoise) -> Array:
    """Covariance (6, 6) of a reference image's given pose: as declared for its epoch, else as estimated for all."""
    assert image.world_from_cam is not None
    given = image.given_sigma
    if given is not None and noise.source == "declared":
        noise = replace(noise, position_sigma_m=given.position_m, rotation_sigma_rad=given.rotation_rad)
    return noise.pose_cov(image.world_from_cam)


def _remember(cache: OrderedDict, key: object, size: int, make: Callable):
    if key not in cache:
        cache[key] = make()
        if len(cache) > size:
            cache.popitem(last=False)
    cache.move_to_end(key)
    return cache[key]
