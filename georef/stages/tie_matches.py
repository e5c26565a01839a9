"""Matches of pairs of new images, stored in shards as they are found: an interrupted run loses seconds of matching.

A pair is kept under a digest of all that its matches depend on, so that pairs of images which did not change are found
again after others were added.
"""

from __future__ import annotations

import logging
import time
import uuid
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from georef.errors import StageError
from georef.estimation.adjustment.campaign.checkpoints import digest_of
from georef.estimation.epoch_problem import match_pair, pose_sigma_px
from georef.estimation.guided import PosedFeatures
from georef.estimation.tracks import PairMatches
from georef.executor import Executor
from georef.geometry.rigid import Rigid3
from georef.io.items import read_item, write_item
from georef.stages.base import feature_id, open_features
from georef.stages.localize import LocalizeTask, matcher_version
from georef.types.campaign import Image
from georef.types.results import Localized

_log = logging.getLogger(__name__)
_KEPT_IMAGES = 64
_SHARD_S, _SHARD_PAIRS = 10.0, 200


@dataclass(frozen=True)
class TieImage:
    """What is needed of a new image to match it: its features' key, its pose, and what that is uncertain by, in px."""

    image: Image
    feature_id: str
    world_from_cam: Rigid3
    pose_px: float

    @staticmethod
    def of(image: Image, outcome: Localized) -> TieImage:
        key = feature_id(image, outcome.quarter_turns)
        return TieImage(image, key, outcome.world_from_cam, pose_sigma_px(image.camera, outcome))

    @cached_property
    def digest(self) -> str:
        return digest_of(self.feature_id, self.image.camera, self.world_from_cam, self.pose_px)


@dataclass
class PairTask:
    """Matches two new images, by their places among all."""

    localize: LocalizeTask
    images: Sequence[TieImage]

    def __call__(self, pair: tuple[int, int]) -> NDArray[np.int32]:
        a, b = (self.images[i] for i in pair)
        config = self.localize.config
        keypoints = config.matching.max_keypoints
        posed = self._posed(a, keypoints), self._posed(b, keypoints)
        gate = config.localize.guided_gate
        return match_pair(posed, (a.pose_px, b.pose_px), self.localize.matcher, keypoints, gate)

    @cached_property
    def _read(self):
        store = open_features(self.localize.store_folder)
        return lru_cache(_KEPT_IMAGES)(store.read)

    def _posed(self, image: TieImage, keypoints: int) -> PosedFeatures:
        return PosedFeatures.of(self._read(image.feature_id, keypoints), image.image.camera, image.world_from_cam)

    def __getstate__(self) -> dict[str, object]:
        return {"localize": self.localize, "images": self.images}


@dataclass
class TieFiles:
    """Matches by the digest of their pair, in files of many pairs each. A damaged file counts as none."""

    folder: Path
    _pending: dict[str, NDArray[np.int32]] = field(default_factory=dict)
    _since: float = field(default_factory=time.monotonic)

    def read(self) -> dict[str, NDArray[np.int32]]:
        found: dict[str, NDArray[np.int32]] = {}
        for path in sorted(self.folder.glob("*.npz")):
            try:
                header, arrays = read_item(path)
            except StageError as error:
                _log.warning("%s", error)
                continue
            parts = np.split(arrays["indices"], np.cumsum(header["counts"])[:-1])
            found.update(zip(header["keys"], parts, strict=True))
        return found

    def add(self, key: str, indices: NDArray[np.int32]) -> None:
        self._pending[key] = indices
        if len(self._pending) >= _SHARD_PAIRS or time.monotonic() - self._since > _SHARD_S:
            self.flush()

    def flush(self) -> None:
        """Writes what was found since the last file."""
        if self._pending:
            header = {"keys": list(self._pending), "counts": [len(found) for found in self._pending.values()]}
            every = np.concatenate([found.reshape(-1, 2) for found in self._pending.values()])
            write_item(self.folder / f"{uuid.uuid4().hex}.npz", header, {"indices": every})
        self._pending, self._since = {}, time.monotonic()


def matched_pairs(
    task: LocalizeTask, images: Sequence[TieImage], pairs: Sequence[tuple[int, int]], folder: Path, executor: Executor
) -> tuple[list[PairMatches], int]:
    """Matches of all pairs that have any, and how many pairs were matched now: the others were found in the folder."""
    how = digest_of(matcher_version(task.config), task.config.matching.max_keypoints, task.config.localize.guided_gate)
    files = TieFiles(folder)
    known = files.read()
    keys = {pair: digest_of(how, images[pair[0]].digest, images[pair[1]].digest) for pair in pairs}
    pending = [pair for pair in pairs if keys[pair] not in known]
    for pair, found in zip(pending, executor.map_items(PairTask(task, images), pending, "tie points"), strict=True):
        known[keys[pair]] = found
        files.add(keys[pair], found)
    files.flush()
    matches = [PairMatches(i, j, known[keys[i, j]]) for i, j in pairs if len(known[keys[i, j]])]
    return matches, len(pending)
