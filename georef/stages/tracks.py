"""Stage `tracks`: verified tracks of the reference, found once; for `localize.method = "tracks"`.

Matches are stored a reference image at a time, structure a block of images at a time, as for the precomputed map: an
interrupted run goes on. Where epochs are added or retired, pairs whose images and poses are as they were take their
matches from the folders of earlier runs; only what is new is matched.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

from georef.errors import StageError
from georef.estimation.global_model import Pair, choose_pairs
from georef.estimation.guided import GuidedOptions, PosedFeatures, guided_matches
from georef.estimation.reference_tracks import block_tracks
from georef.geometry.frusta import Frusta
from georef.io.items import item_path
from georef.io.structures import read_matches, write_matches
from georef.stages.base import StageContext, StageSummary, feature_id
from georef.stages.failures import internal_failure
from georef.stages.global_map import MATCHES, MapTask, TriangulateTask, map_references, summary_of
from georef.stages.localize import make_task
from georef.types.campaign import Image
from georef.types.features import Matches
from georef.types.scene import ImageStructure


@dataclass
class MatchTask(MapTask):
    """Matches one reference with its partners behind it along epipolar lines; returns how many pairs were computed."""

    earlier: tuple[Path, ...]  # folders of earlier runs, the newest first
    states: tuple[str, ...]  # what the matches of each reference depend on, by its place

    def __call__(self, index: int) -> int:
        keys = {b: self._key(index, b) for a, b in self.partners[index] if a == index}
        found = self._kept(index, keys)
        missing = [other for other in keys if other not in found]
        posed = self.posed([index, *missing]) if missing else {}
        options = GuidedOptions.of(self.localize.config.localize)
        for other in missing:
            if index in posed and other in posed:
                try:
                    found[other] = guided_matches(posed[index], posed[other], options)
                except Exception as error:
                    internal_failure(error, f"matching of references {self.ids[index]} and {self.ids[other]}")
        named = {self.ids[other]: matches for other, matches in found.items()}
        write_matches(self.path(MATCHES, index), named, {self.ids[other]: key for other, key in keys.items()})
        return len(missing)

    def _kept(self, index: int, keys: Mapping[int, str]) -> dict[int, Matches]:
        """Matches of earlier runs from the very same images and poses."""
        wanted = {key: other for other, key in keys.items()}
        found: dict[int, Matches] = {}
        for folder in self.earlier:
            path = item_path(folder / MATCHES, self.ids[index])
            if not path.is_file() or len(found) == len(keys):
                continue
            try:
                partners, matches = read_matches(path, wanted)
            except StageError:  # matched again
                continue
            found |= {self.places[name]: m for name, m in zip(partners, matches, strict=True)}
        return found

    def _key(self, a: int, b: int) -> str:
        return _digest([self.states[a], self.states[b], asdict(GuidedOptions.of(self.localize.config.localize))])


@dataclass
class TrackTask(TriangulateTask):
    """Joins the matches of a block of reference images to tracks; returns how many keypoints have one."""

    def solved(
        self, block: list[int], posed: Mapping[int, PosedFeatures], matches: Mapping[Pair, Matches]
    ) -> dict[int, ImageStructure]:
        pose_covs = {index: self.localize.map.pose_cov(index) for index in posed}
        return block_tracks(block, posed, matches, self.localize.noise, pose_covs)


def run(context: StageContext) -> StageSummary:
    """Matches what is not matched yet, then finds the tracks of the blocks that are not complete."""
    task = make_task(context)
    reference, config = task.map, context.config.tracks
    ids, cameras = tuple(i.image_id for i in reference.images), [i.camera for i in reference.images]
    pairs = tuple(choose_pairs(Frusta.of(reference.poses, cameras, config.viewing_reach_m), config.neighbours))
    history = sorted(context.folder.parent.glob("*"), key=lambda folder: folder.stat().st_mtime, reverse=True)
    earlier = tuple(folder for folder in history if folder.is_dir() and folder != context.folder)
    states = tuple(_state(context, image) for image in reference.images)
    match = MatchTask(make_task(context), context.folder, ids, pairs, earlier, states)
    tracks = TrackTask(make_task(context), context.folder, ids, pairs)
    return summary_of(tracks, map_references(context, match, tracks, config.block_images))


def _state(context: StageContext, image: Image) -> str:
    """What the matches of a reference depend on: its features, by their file and extractor, its camera and its pose."""
    assert image.world_from_cam is not None
    status = context.survey.source_of(image).stat()
    return _digest(
        [
            context.before["store"].name,
            feature_id(image),
            [status.st_size, status.st_mtime_ns],
            asdict(image.camera),
            image.world_from_cam.matrix().tolist(),
        ]
    )


def _digest(value: object) -> str:
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()[:16]
