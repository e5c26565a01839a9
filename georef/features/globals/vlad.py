"""VLAD (Jegou et al. 2010) of local descriptors, with centres and whitening learned from the reference map itself."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from georef.errors import StageError
from georef.features.globals.base import Image, Needs, Row, check_features, check_repeatable, unit_or_even_rows
from georef.features.globals.kmeans import assign, kmeans
from georef.features.globals.sampling import Reservoir
from georef.features.globals.state import LearnedState
from georef.features.globals.whitening import Whitening, learn_whitening
from georef.types.features import Features

_SAMPLED_DESCRIPTORS = 200_000  # 102 MB of 128 components
_SAMPLED_AN_IMAGE = 512  # so that no image rules the centres
_SAMPLED_ROWS = 4_096  # 134 MB of 64 centres x 128 components: whitening to 512 is well determined by 8 times as many


@dataclass(frozen=True, eq=False)
class _Learned:
    centres: NDArray[np.float32]  # (K, D)
    whitening: Whitening
    tag: str


class Vlad:
    """Residuals of an image's descriptors from K centres, summed by centre; rows (size,) after whitening.

    Each centre's sum is brought to unit length (intra normalisation, Arandjelovic and Zisserman 2013) after the signed
    square root of its components (power normalisation, Perronnin et al. 2010); both keep repeated structure from
    ruling. An image without features has the row of zeros, whitened like any other.

    max_keypoints: only that many best keypoints of an image count. The descriptors may come from any extractor, the
    same for all images. seed: of sampling and k-means.
    """

    name = "vlad"
    needs: Needs = "features"

    def __init__(
        self, *, size: int = 512, centres: int = 64, max_keypoints: int = 2048, power: float = 0.5, seed: int = 0
    ) -> None:
        self.size = size
        self._centres, self._max_keypoints, self._power, self._seed = centres, max_keypoints, power, seed
        self._learned: _Learned | None = None

    def version(self) -> str:
        tag = "not-learned" if self._learned is None else self._learned.tag
        return f"{self._settings()} state={tag}"

    def learn(self, samples: Iterable[Features]) -> LearnedState:
        """Centres and whitening of the reference's features, in two passes; memory does not grow with their number.

        Raises ValueError for an iterator, and StageError where the samples have too few descriptors for the centres,
        or too few images (two).
        """
        check_repeatable(samples)
        descriptors = Reservoir(_SAMPLED_DESCRIPTORS, self._seed)
        random = np.random.default_rng(self._seed)
        for features in samples:
            rows = self._descriptors(features)
            descriptors.add(rows[random.permutation(len(rows))[:_SAMPLED_AN_IMAGE]])
        if len(descriptors.rows) < self._centres:
            raise StageError(
                f"{len(descriptors.rows)} local descriptors cannot teach {self._centres} centres.\n"
                "Give more reference images, or fewer centres."
            )
        centres = kmeans(descriptors.rows, self._centres, self._seed)
        vlads = Reservoir(_SAMPLED_ROWS, self._seed)
        for features in samples:
            place = vlads.places(1)
            if place[0] >= 0:
                vlads.put(place, self._vlad(features, centres)[None])
        try:
            whitening = learn_whitening(vlads.rows, self.size)
        except ValueError as error:
            raise StageError(f"The reference images cannot teach a global descriptor: {error}.") from error
        arrays = {"centres": centres, "mean": whitening.mean, "axes": whitening.axes}
        return LearnedState(self._settings(), arrays)

    def with_state(self, state: LearnedState) -> Vlad:
        state.check_learned_by(self._settings())
        made = Vlad(
            size=self.size,
            centres=self._centres,
            max_keypoints=self._max_keypoints,
            power=self._power,
            seed=self._seed,
        )
        whitening = Whitening(state.arrays["mean"], state.arrays["axes"], self.size)
        made._learned = _Learned(state.arrays["centres"], whitening, state.sha256[:12])
        return made

    def describe(self, image_rgb: Image | None, features: Features | None) -> Row:
        """The row (size,) of an image's features. Raises StageError before anything was learned."""
        del image_rgb
        if self._learned is None:
            raise StageError("The global descriptor 'vlad' has learned nothing yet.\nLearn it from the reference map.")
        return self._learned.whitening.apply(self._vlad(check_features(features), self._learned.centres)[None])[0]

    def _settings(self) -> str:
        settings = f"size={self.size} centres={self._centres} keypoints={self._max_keypoints}"
        return f"{self.name}-1 {settings} power={self._power} seed={self._seed}"

    def _descriptors(self, features: Features) -> NDArray[np.float32]:
        return unit_or_even_rows(features.descriptors[: self._max_keypoints])

    def _vlad(self, features: Features, centres: NDArray[np.float32]) -> NDArray[np.float32]:
        """The row (K x D,) of unit length, zero for an image without features."""
        rows = self._descriptors(features)
        if len(rows) == 0:
            return np.zeros(centres.size, np.float32)
        if rows.shape[1] != centres.shape[1]:
            raise StageError(
                f"The features have {rows.shape[1]} components, those of the reference had {centres.shape[1]}.\n"
                "Extract all images with the same extractor."
            )
        nearest, _ = assign(rows, centres)
        held = np.zeros((len(centres), len(rows)), np.float32)
        held[nearest, np.arange(len(rows))] = 1
        sums = held @ rows - held.sum(1)[:, None] * centres
        sums = np.sign(sums) * np.abs(sums) ** self._power
        lengths = np.linalg.norm(sums, axis=1, keepdims=True)
        return (sums / np.maximum(lengths, 1e-12)).ravel() / np.sqrt(max(1, np.count_nonzero(lengths > 1e-12)))
