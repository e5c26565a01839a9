"""Stage `adjust`: tie points among the new images, constraints of the configured kind, bundle adjustment."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from georef.config import AdjustConfig
from georef.errors import StageError
from georef.estimation.adjustment.adjust_block import AdjustedBlock, BlockOptions, adjust_block
from georef.estimation.adjustment.block import Block
from georef.estimation.adjustment.checkpoints import Resumable
from georef.estimation.adjustment.image_covariances import image_covariances
from georef.estimation.adjustment.partitioned import Partitioned
from georef.estimation.adjustment.solver import Solve, SolverOptions, solve_block
from georef.estimation.adjustment.standing import Standing, with_lasting_names
from georef.estimation.adjustment.updating import updated
from georef.estimation.epoch_problem import epoch_problem, tie_pairs
from georef.estimation.guided import Bearings, PosedFeatures
from georef.estimation.tracks import PairMatches
from georef.executor import Held
from georef.geometry.rigid import Array, Rigid3
from georef.io.items import read_item, write_item
from georef.stages.adjustment_report import adjustment_data, adjustment_line, all_reliability, scene_points
from georef.stages.adjustment_tables import write_tables
from georef.stages.base import StageContext, StageSummary, feature_id, open_features
from georef.stages.earlier import note_inputs
from georef.stages.epoch_block import epoch_block
from georef.stages.localize import make_task
from georef.stages.solve_files import SolveFiles
from georef.stages.standing_file import adjustment_inputs, standing_before, write_standing
from georef.stages.stations import final_outcomes
from georef.stages.tie_matches import TieImage, matched_pairs
from georef.types.campaign import Image
from georef.types.results import Localized, with_estimated_cameras

_WORTH_PARTS = 200_000  # observations
_FEW_IMAGES = 200  # whose joint covariance is stored whole
RESULT, SOLVES, TIES = "adjusted.npz", "solves", "ties"


@dataclass(frozen=True, eq=False)
class AdjustedEpoch:
    """The published result of an adjustment, as it is stored: covariances of all M images, and jointly of the k that
    check points are marked in (of all where they are few)."""

    image_ids: tuple[str, ...]
    world_from_cams: tuple[Rigid3, ...]
    covs: Array  # (M, 6, 6)
    joint_images: NDArray[np.int64]  # (k,) rising
    joint_cov: Array  # (6 k, 6 k)
    relative_joint_cov: Array  # (6 k, 6 k) against the reference as it is published: without its own errors
    points: Array  # (P, 3) automatic GCPs and tie points
    colors_rgb: Array  # (P, 3)
    data: dict[str, Any]
    folder: Path

    def cov(self, index: int) -> Array:
        return self.covs[index]

    def joint(self, indices: list[int]) -> Array:
        """Joint covariance (6k, 6k) of some images. Raises StageError where it was not stored."""
        return self._blocks(self.joint_cov, indices)

    def relative_joint(self, indices: list[int]) -> Array:
        """The same without the errors of the reference."""
        return self._blocks(self.relative_joint_cov, indices)

    def _blocks(self, joint: Array, indices: list[int]) -> Array:
        places = np.searchsorted(self.joint_images, indices)
        missing = [i for i in indices if i not in self.joint_images]
        if missing:
            raise StageError(
                f"Joint covariances with image '{self.image_ids[missing[0]]}' are not stored: nothing was marked in it "
                "when the epoch was adjusted.",
                "Delete the folder and run again, so that check points which were marked since then are known.",
                f"In {self.folder}.",
            )
        rows = (6 * places[:, None] + np.arange(6)).ravel()
        return joint[np.ix_(rows, rows)]


def run(context: StageContext) -> StageSummary:
    """Adjusts the localized images of the epoch."""
    config, outcomes = context.config, final_outcomes(context)
    epoch = with_estimated_cameras(context.survey.epoch, outcomes)
    localized = [o for o in outcomes if isinstance(o, Localized)]
    if not localized:
        write_item(context.folder / RESULT, {"image_ids": [], "data": {}}, _nothing())
        return StageSummary("no image was localized; nothing to adjust")
    images = [epoch[o.image_id] for o in localized]
    posed = _placed_keypoints(context, images, localized)
    task = make_task(context)
    ties: list[PairMatches] = []
    matched = 0
    if config.adjust.tie_points:
        pairs = tie_pairs(posed, localized, config.adjust.tie_neighbours)
        seen = [TieImage.of(image, outcome) for image, outcome in zip(images, localized, strict=True)]
        ties, matched = matched_pairs(task, seen, pairs, context.folder.parent / TIES, context.executor)
    problem = epoch_problem(images, localized, posed, ties, task.map, context.survey.control, config.adjust)
    given, before = epoch_block(context, images, localized, problem)
    given = with_lasting_names(given)
    inputs = adjustment_inputs(context)
    note_inputs(context.folder, inputs)
    standing = standing_before(context, inputs)
    solves = SolveFiles(context.folder / SOLVES)
    with context.executor.held() as held:
        solve = solve_in(held, context.executor.workers, given)
        resumable, options = Resumable(solves, solve), options_of(config.adjust)
        if standing is None:
            adjusted = adjust_block(given, options, solve=resumable)
        else:
            adjusted = updated(standing[0], given, options, resumable)
    checked = all_reliability(adjusted, context.survey.world)
    data = adjustment_data(given, adjusted, checked) | before | {"pairs_matched": matched, "updated_from": None}
    if standing is not None:
        data |= _still_wrong(standing[1])
    write_tables(context.folder, adjusted, checked, context.survey.world)
    marked = {mark.image_id for point in context.survey.check for mark in point.marks}
    arrays = _arrays(adjusted, marked, _colors(adjusted, posed))
    write_item(context.folder / RESULT, {"image_ids": list(given.image_ids), "data": data}, arrays)
    write_standing(context.folder, Standing.of(given, adjusted))
    solves.clear()
    return StageSummary(adjustment_line(data), data, len(localized), len(localized))


def _placed_keypoints(
    context: StageContext, images: Sequence[Image], localized: Sequence[Localized]
) -> list[PosedFeatures]:
    """Where the keypoints of all images are; without descriptors and rays, which matching alone needs, pair by pair."""
    store, out = open_features(context.before["store"]), []
    for image, outcome in zip(images, localized, strict=True):
        features = store.read(feature_id(image, outcome.quarter_turns))
        plain = replace(features, descriptors=np.zeros((len(features), 0), features.descriptors.dtype))
        rays = Bearings(np.zeros((0, 3)), np.zeros((0, 3, 2)))
        out.append(PosedFeatures(plain, image.camera, outcome.world_from_cam, rays))
    return out


def _still_wrong(folder: Path) -> dict[str, Any]:
    """What an update keeps of the adjustment that it began with: coherent blocks are not looked for again."""
    before = read_adjusted(folder).data
    kept = ("coherent_blocks", "undecidable")
    return {"updated_from": folder.name, **{name: before[name] for name in kept if name in before}}


def solve_in(held: Held, workers: int, block: Block) -> Solve:
    """How a block is solved: by all workers where it is large enough to be worth their start."""
    return Partitioned(held, workers) if workers > 1 and len(block.observations) >= _WORTH_PARTS else solve_block


def options_of(config: AdjustConfig) -> BlockOptions:
    """How blocks are adjusted, as the configuration says."""
    options = BlockOptions.of(config.cauchy_scale, config.gate_probability)
    return replace(options, solver=SolverOptions(max_iterations=config.max_iterations))


def read_adjusted(folder: Path) -> AdjustedEpoch:
    """The stored result of this stage."""
    header, arrays = read_item(folder / RESULT)
    return AdjustedEpoch(
        image_ids=tuple(header["image_ids"]),
        world_from_cams=tuple(Rigid3.from_matrix(m) for m in arrays["poses"]),
        covs=arrays["covs"],
        joint_images=arrays["joint_images"],
        joint_cov=arrays["joint_cov"],
        relative_joint_cov=arrays["relative_joint_cov"],
        points=arrays["points"],
        colors_rgb=arrays["colors"],
        data=header["data"],
        folder=folder,
    )


def _arrays(adjusted: AdjustedBlock, wanted: set[str], colors: NDArray[np.uint8]) -> dict[str, np.ndarray]:
    """What is stored; wanted: images whose covariances are wanted jointly."""
    state, ids = adjusted.solution.state, adjusted.block.image_ids
    few = len(ids) <= _FEW_IMAGES
    covs = image_covariances(adjusted, np.array([i for i, name in enumerate(ids) if few or name in wanted], np.int64))
    return {
        "poses": np.array([pose.matrix() for pose in adjusted.block.world_from_cam(state).to_list()]),
        "covs": covs.own,
        "joint_images": covs.images,
        "joint_cov": covs.joint,
        "relative_joint_cov": covs.relative_joint,
        "points": state.points[scene_points(adjusted)],
        "colors": colors,
    }


def _nothing() -> dict[str, np.ndarray]:
    zero = np.zeros
    return {
        "poses": zero((0, 4, 4)),
        "covs": zero((0, 6, 6)),
        "joint_images": zero(0, np.int64),
        "joint_cov": zero((0, 0)),
        "relative_joint_cov": zero((0, 0)),
        "points": zero((0, 3)),
        "colors": zero((0, 3), np.uint8),
    }


def _colors(adjusted: AdjustedBlock, posed: list[PosedFeatures]) -> NDArray[np.uint8]:
    """The colour of each point in one of the images that see it."""
    colors = np.zeros((len(adjusted.block.points), 3), np.uint8)
    obs = adjusted.block.observations
    for index, image in enumerate(posed):
        here = (obs.view == index) & (obs.keypoint >= 0)
        colors[obs.point[here]] = image.features.colors_rgb[obs.keypoint[here]]
    return colors[scene_points(adjusted)]
