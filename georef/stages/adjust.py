"""Stage `adjust`: tie points among the new images, constraints of the configured kind, bundle adjustment."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from georef.config import AdjustConfig
from georef.estimation.adjustment.adjust_block import AdjustedBlock, BlockOptions, adjust_block
from georef.estimation.adjustment.image_covariances import image_covariances
from georef.estimation.adjustment.solver import SolverOptions
from georef.estimation.epoch_problem import epoch_problem, match_new_images, tie_pairs
from georef.estimation.guided import PosedFeatures
from georef.geometry.rigid import Array, Rigid3
from georef.io.items import read_item, write_item
from georef.stages.adjustment_report import adjustment_data, adjustment_line, all_reliability, scene_points
from georef.stages.adjustment_tables import write_tables
from georef.stages.base import StageContext, StageSummary, feature_id, open_features
from georef.stages.epoch_block import epoch_block
from georef.stages.localize import make_task
from georef.stages.stations import final_outcomes
from georef.types.results import Localized, with_estimated_cameras

RESULT = "adjusted.npz"


@dataclass(frozen=True, eq=False)
class AdjustedEpoch:
    """The published result of an adjustment, as it is stored."""

    image_ids: tuple[str, ...]
    world_from_cams: tuple[Rigid3, ...]
    joint_cov: Array  # (6M, 6M)
    relative_joint_cov: Array  # (6M, 6M) against the reference as it is published: without its own errors
    points: Array  # (P, 3) automatic GCPs and tie points
    colors_rgb: Array  # (P, 3)
    data: dict[str, Any]

    def cov(self, index: int) -> Array:
        return self.joint_cov[6 * index : 6 * index + 6, 6 * index : 6 * index + 6]

    def joint(self, indices: list[int]) -> Array:
        """Joint covariance (6k, 6k) of some images."""
        return _blocks(self.joint_cov, indices)

    def relative_joint(self, indices: list[int]) -> Array:
        """The same without the errors of the reference."""
        return _blocks(self.relative_joint_cov, indices)


def run(context: StageContext) -> StageSummary:
    """Adjusts the localized images of the epoch."""
    config, outcomes = context.config, final_outcomes(context)
    epoch = with_estimated_cameras(context.survey.epoch, outcomes)
    localized = [o for o in outcomes if isinstance(o, Localized)]
    if not localized:
        write_item(context.folder / RESULT, {"image_ids": [], "data": {}}, _arrays(None, np.zeros((0, 3), np.uint8)))
        return StageSummary("no image was localized; nothing to adjust")
    store = open_features(context.before["store"])
    images = [epoch[o.image_id] for o in localized]
    posed = [
        PosedFeatures.of(store.read(feature_id(image, o.quarter_turns)), image.camera, o.world_from_cam)
        for image, o in zip(images, localized, strict=True)
    ]
    task = make_task(context)
    reference = task.map
    ties = []
    if config.adjust.tie_points:
        pairs = tie_pairs(posed, localized, config.adjust.tie_neighbours)
        keypoints, gate = config.matching.max_keypoints, config.localize.guided_gate
        ties = match_new_images(posed, localized, pairs, task.matcher, keypoints, gate, context.executor.progress)
    problem = epoch_problem(images, localized, posed, ties, reference, context.survey.control, config.adjust)
    given, before = epoch_block(context, images, localized, problem)
    adjusted = adjust_block(given, options_of(config.adjust))
    checked = all_reliability(adjusted, context.survey.world)
    data = adjustment_data(given, adjusted, checked) | before
    write_tables(context.folder, adjusted, checked, context.survey.world)
    arrays = _arrays(adjusted, _colors(adjusted, posed))
    write_item(context.folder / RESULT, {"image_ids": list(given.image_ids), "data": data}, arrays)
    return StageSummary(adjustment_line(data), data, len(localized), len(localized))


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
        joint_cov=arrays["joint_cov"],
        relative_joint_cov=arrays["relative_joint_cov"],
        points=arrays["points"],
        colors_rgb=arrays["colors"],
        data=header["data"],
    )


def _blocks(joint: Array, indices: list[int]) -> Array:
    rows = np.concatenate([np.arange(6 * i, 6 * i + 6) for i in indices])
    return joint[np.ix_(rows, rows)]


def _arrays(adjusted: AdjustedBlock | None, colors: NDArray[np.uint8]) -> dict[str, np.ndarray]:
    if adjusted is None:
        none = np.zeros((0, 0))
        return {
            "poses": np.zeros((0, 4, 4)),
            "joint_cov": none,
            "relative_joint_cov": none,
            "points": np.zeros((0, 3)),
            "colors": colors,
        }
    state = adjusted.solution.state
    relative, joint = image_covariances(adjusted)
    return {
        "poses": np.array([pose.matrix() for pose in adjusted.block.world_from_cam(state).to_list()]),
        "joint_cov": joint,
        "relative_joint_cov": relative,
        "points": state.points[scene_points(adjusted)],
        "colors": colors,
    }


def _colors(adjusted: AdjustedBlock, posed: list[PosedFeatures]) -> NDArray[np.uint8]:
    """The colour of each point in one of the images that see it."""
    colors = np.zeros((len(adjusted.block.points), 3), np.uint8)
    obs = adjusted.block.observations
    for index, image in enumerate(posed):
        here = (obs.view == index) & (obs.keypoint >= 0)
        colors[obs.point[here]] = image.features.colors_rgb[obs.keypoint[here]]
    return colors[scene_points(adjusted)]
