"""Stage `global-map`: all references matched and triangulated once; for `localize.method = "global-model"` alone.

Matches are stored a reference image at a time, structure a block of images at a time: an interrupted run goes on, and
no more than a block with its neighbours is in memory.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from georef.estimation.global_model import Pair, block_structure, blocks_of, choose_pairs, match_pair
from georef.geometry.frusta import Frusta
from georef.io.items import item_ids, item_path, read_item, write_item
from georef.io.structures import read_structure, write_structure
from georef.stages.base import StageContext, StageSummary
from georef.stages.localize import STRUCTURE, LocalizeTask, make_task

MATCHES = "matches"


@dataclass
class MapTask:
    """What matching and triangulating have in common: the references, where results go, and which pairs there are."""

    localize: LocalizeTask
    folder: Path
    ids: tuple[str, ...]  # of the references, by their place
    pairs: tuple[Pair, ...]

    @cached_property
    def partners(self) -> dict[int, list[Pair]]:
        """The pairs of each image, by its place."""
        out: dict[int, list[Pair]] = {index: [] for index in range(len(self.ids))}
        for pair in self.pairs:
            for index in pair:
                out[index].append(pair)
        return out

    def path(self, kind: str, index: int) -> Path:
        return item_path(self.folder / kind, self.ids[index])


@dataclass
class MatchTask(MapTask):
    """Matches one reference image with its partners behind it; returns how many matches agree with the poses."""

    def __call__(self, index: int) -> int:
        config = self.localize.config
        others = [b for a, b in self.partners[index] if a == index]
        reference, matcher = self.localize.map, self.localize.matcher
        count, gate = config.matching.max_keypoints, config.global_map.gate
        own = reference.posed(index)
        found = [match_pair(own, reference.posed(other), matcher, count, gate) for other in others]
        header = {"partners": [self.ids[other] for other in others]}
        arrays = {f"matches_{k}": matches.indices for k, matches in enumerate(found)}
        write_item(self.path(MATCHES, index), header, arrays)
        return sum(map(len, found))


@dataclass
class TriangulateTask(MapTask):
    """Triangulates a block of reference images; returns how many keypoints have a point."""

    def __call__(self, block: NDArray[np.int64]) -> int:
        reference = self.localize.map
        members = sorted({int(i) for i in block} | {i for k in block for pair in self.partners[int(k)] for i in pair})
        inside = set(members)
        matches = {pair: m for i in members for pair, m in self._matches(i).items() if inside.issuperset(pair)}
        posed = {index: reference.posed(index) for index in members}
        found = block_structure([int(i) for i in block], posed, matches, self.localize.noise)
        for index, structure in found.items():
            write_structure(self.path(STRUCTURE, index), structure, self.ids)
        return sum(map(len, found.values()))

    def _matches(self, index: int) -> dict[Pair, NDArray[np.int32]]:
        header, arrays = read_item(self.path(MATCHES, index))
        place = {name: k for k, name in enumerate(self.ids)}
        pairs = [(index, place[name]) for name in header["partners"]]
        return {pair: m for k, pair in enumerate(pairs) if len(m := arrays[f"matches_{k}"])}


def run(context: StageContext) -> StageSummary:
    """Matches what is not matched yet, then triangulates the blocks that are not complete."""
    reference, config = make_task(context).map, context.config.global_map
    ids, cameras = tuple(i.image_id for i in reference.images), [i.camera for i in reference.images]
    pairs = tuple(choose_pairs(Frusta.of(reference.poses, cameras, config.viewing_reach_m), config.neighbours))
    match = MatchTask(make_task(context), context.folder, ids, pairs)
    triangulate = TriangulateTask(make_task(context), context.folder, ids, pairs)
    done = item_ids(context.folder / MATCHES)
    pending = [index for index, name in enumerate(ids) if name not in done]
    for _ in context.executor.map_items(match, pending, "map matching"):
        pass
    there = item_ids(context.folder / STRUCTURE)
    blocks = [
        block
        for block in blocks_of(reference.positions, config.block_images)
        if not there.issuperset(ids[int(i)] for i in block)
    ]
    for _ in context.executor.map_items(triangulate, blocks, "map points"):
        pass
    return _summary(triangulate, len(pairs), len(pending))


def _summary(task: MapTask, pairs: int, computed: int) -> StageSummary:
    places = {name: k for k, name in enumerate(task.ids)}
    points = observations = 0
    for index in range(len(task.ids)):
        structure = read_structure(task.path(STRUCTURE, index), places)
        points += int(np.count_nonzero(structure.identity[:, 0] == index))
        observations += len(structure)
    line = f"{points} points from {pairs} pairs of {len(task.ids)} reference images"
    data = {"points": points, "pairs": pairs, "keypoints_with_point": observations}
    return StageSummary(line, data, computed, len(task.ids))
