"""Stage `global-map`: all references matched and triangulated once; for `localize.method = "global-model"` alone.

Matches are stored a reference image at a time, structure a block of images at a time: an interrupted run goes on, and
no more than a block with its neighbours is in memory. A reference that cannot be read or computed has no matches and
no points, which is logged and told in the summary; the others go on.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from georef.estimation.global_model import Pair, block_structure, blocks_of, choose_pairs, match_pair
from georef.estimation.guided import PosedFeatures
from georef.geometry.frusta import Frusta
from georef.io.items import item_ids, item_path
from georef.io.structures import read_matches, read_structure, write_matches, write_structure
from georef.stages.base import StageContext, StageSummary
from georef.stages.failures import internal_failure
from georef.stages.localize import STRUCTURE, LocalizeTask, make_task
from georef.types.features import Matches
from georef.types.scene import ImageStructure

MATCHES = "matches"
_NAMED = 5  # references without points that the summary names


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

    @cached_property
    def places(self) -> dict[str, int]:
        """The place of each reference by its id."""
        return {name: k for k, name in enumerate(self.ids)}

    def path(self, kind: str, index: int) -> Path:
        return item_path(self.folder / kind, self.ids[index])

    def posed(self, indices: Iterable[int]) -> dict[int, PosedFeatures]:
        """References with their features, by their place; one whose features cannot be used is logged and left out."""
        out: dict[int, PosedFeatures] = {}
        for index in indices:
            try:
                out[index] = self.localize.map.posed(index)
            except Exception as error:
                internal_failure(error, f"reading of reference {self.ids[index]}")
        return out


@dataclass
class MatchTask(MapTask):
    """Matches one reference image with its partners behind it; returns how many matches agree with the poses."""

    def __call__(self, index: int) -> int:
        config = self.localize.config
        others = [b for a, b in self.partners[index] if a == index]
        matcher, count, gate = self.localize.matcher, config.matching.max_keypoints, config.global_map.gate
        found: dict[int, Matches] = {}
        posed = self.posed([index, *others])
        for other in others:
            if index in posed and other in posed:
                try:
                    found[other] = match_pair(posed[index], posed[other], matcher, count, gate)
                except Exception as error:
                    internal_failure(error, f"matching of references {self.ids[index]} and {self.ids[other]}")
        write_matches(self.path(MATCHES, index), {self.ids[other]: matches for other, matches in found.items()})
        return sum(map(len, found.values()))


@dataclass
class TriangulateTask(MapTask):
    """Triangulates a block of reference images; returns how many keypoints have a point."""

    def __call__(self, block: NDArray[np.int64]) -> int:
        members = sorted({int(i) for i in block} | {i for k in block for pair in self.partners[int(k)] for i in pair})
        posed = self.posed(members)
        found = self._triangulated([int(i) for i in block if int(i) in posed], posed)
        for index in (int(i) for i in block):
            write_structure(self.path(STRUCTURE, index), found.get(index, ImageStructure.empty()), self.ids)
        return sum(map(len, found.values()))

    def _triangulated(self, block: list[int], posed: Mapping[int, PosedFeatures]) -> dict[int, ImageStructure]:
        """Where a block fails, it is halved with its partners, until only what is beside the cause has no points."""
        if not block:
            return {}
        members = {*block, *(i for k in block for pair in self.partners[k] for i in pair)} & posed.keys()
        matches = {pair: m for i in sorted(members) for pair, m in self.matches(i).items() if members.issuperset(pair)}
        try:
            return self.solved(block, {i: posed[i] for i in members}, matches)
        except Exception as error:
            internal_failure(error, f"triangulation of {len(block)} references from {self.ids[block[0]]} on")
        if len(block) == 1:
            return {}
        half = len(block) // 2
        return self._triangulated(block[:half], posed) | self._triangulated(block[half:], posed)

    def matches(self, index: int) -> dict[Pair, Matches]:
        """The stored matches of an image with its partners behind it that there are any with."""
        partners, found = read_matches(self.path(MATCHES, index))
        pairs = [(index, self.places[name]) for name in partners]
        return {pair: m for pair, m in zip(pairs, found, strict=True) if len(m)}

    def solved(
        self, block: list[int], posed: Mapping[int, PosedFeatures], matches: Mapping[Pair, Matches]
    ) -> dict[int, ImageStructure]:
        """The structure of the images of a block from those and their partners."""
        indices = {pair: m.indices for pair, m in matches.items()}
        return block_structure(block, posed, indices, self.localize.noise)


def run(context: StageContext) -> StageSummary:
    """Matches what is not matched yet, then triangulates the blocks that are not complete."""
    reference, config = make_task(context).map, context.config.global_map
    ids, cameras = tuple(i.image_id for i in reference.images), [i.camera for i in reference.images]
    pairs = tuple(choose_pairs(Frusta.of(reference.poses, cameras, config.viewing_reach_m), config.neighbours))
    match = MatchTask(make_task(context), context.folder, ids, pairs)
    triangulate = TriangulateTask(make_task(context), context.folder, ids, pairs)
    computed = map_references(context, match, triangulate, config.block_images)
    return summary_of(triangulate, computed)


def map_references(
    context: StageContext, match: Callable[[int], int], triangulate: TriangulateTask, block_images: int
) -> int:
    """Runs both tasks over what has no result yet; returns how many images were matched."""
    done, ids = item_ids(context.folder / MATCHES), triangulate.ids
    pending = [index for index, name in enumerate(ids) if name not in done]
    for _ in context.executor.map_items(match, pending, "map matching"):
        pass
    there = item_ids(context.folder / STRUCTURE)
    blocks = [
        block
        for block in blocks_of(triangulate.localize.map.positions, block_images)
        if not there.issuperset(ids[int(i)] for i in block)
    ]
    for _ in context.executor.map_items(triangulate, blocks, "map points"):
        pass
    return len(pending)


def summary_of(task: MapTask, computed: int) -> StageSummary:
    """How many points there are, and which references have none."""
    pairs, points, observations = len(task.pairs), 0, 0
    without = []
    for index in range(len(task.ids)):
        structure = read_structure(task.path(STRUCTURE, index), task.places)
        points += int(np.count_nonzero(structure.identity[:, 0] == index))
        observations += len(structure)
        without += [] if len(structure) else [task.ids[index]]
    line = f"{points} points from {pairs} pairs of {len(task.ids)} reference images"
    if without:
        line += f"; {len(without)} without any: {', '.join(without[:_NAMED])}{', ...' if len(without) > _NAMED else ''}"
    data = {"points": points, "pairs": pairs, "keypoints_with_point": observations, "without_points": without}
    return StageSummary(line, data, computed, len(task.ids))
