"""Stage `adjust`: tie points among the new images, constraints of the configured kind, bundle adjustment."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from georef.config import AdjustConfig
from georef.estimation.adjustment.adjust_block import AdjustedBlock, BlockOptions, adjust_block
from georef.estimation.adjustment.block import KINDS_OF_POINT, KINDS_OF_POSE, Block
from georef.estimation.adjustment.coherent import CoherentBlock
from georef.estimation.adjustment.components import Component
from georef.estimation.adjustment.constraint_terms import POSITION_PRIORS
from georef.estimation.adjustment.eliminate import IMAGE_OBSERVATIONS
from georef.estimation.adjustment.from_problem import Exposure, block_of
from georef.estimation.adjustment.image_covariances import image_covariances
from georef.estimation.adjustment.solver import SolverOptions
from georef.estimation.epoch_problem import epoch_problem, match_new_images, tie_pairs
from georef.estimation.guided import PosedFeatures
from georef.geometry.rigid import Array, Rigid3
from georef.io.items import read_item, write_item
from georef.stages.base import StageContext, StageSummary, feature_id, open_features
from georef.stages.localize import make_task
from georef.stages.stations import final_outcomes
from georef.types.campaign import Campaign, Image
from georef.types.results import Localized, with_estimated_cameras

RESULT = "adjusted.npz"
GROUPS = {
    IMAGE_OBSERVATIONS: "image_observations",
    "automatic": "automatic_gcps",
    "localized": "pose_priors",
    POSITION_PRIORS: "gnss",
    "control": "control_points",
}
"""Names in reports of what a block calls its groups of observations."""


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
    given = block_of(problem, [exposure_of(image, context.survey.epoch) for image in images])
    adjusted = adjust_block(given, options_of(config.adjust))
    data = _data(given, adjusted)
    arrays = _arrays(adjusted, _colors(adjusted, posed))
    write_item(context.folder / RESULT, {"image_ids": list(given.image_ids), "data": data}, arrays)
    return StageSummary(_line(data), data, len(localized), len(localized))


def exposure_of(image: Image, epoch: Campaign) -> Exposure | None:
    """The station and mounting of an image whose rig is known."""
    mounting = epoch.mountings.get(image.image_id)
    return None if mounting is None or image.station is None else Exposure(image.station, mounting)


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
        "points": state.points[_scene_points(adjusted)],
        "colors": colors,
    }


def _scene_points(adjusted: AdjustedBlock) -> NDArray[np.int64]:
    """Tie points and automatic GCPs that the adjustment determined."""
    determined = np.flatnonzero(np.isfinite(adjusted.quality.images.points).all(axis=(1, 2)))
    return np.setdiff1d(determined, _points_of(adjusted.block, "control"))


def _points_of(block: Block, kind: str) -> NDArray[np.int64]:
    priors = block.point_priors
    return priors.point[priors.kind == KINDS_OF_POINT.index(kind)]


def _colors(adjusted: AdjustedBlock, posed: list[PosedFeatures]) -> NDArray[np.uint8]:
    """The colour of each point in one of the images that see it."""
    colors = np.zeros((len(adjusted.block.points), 3), np.uint8)
    obs = adjusted.block.observations
    for index, image in enumerate(posed):
        here = (obs.view == index) & (obs.keypoint >= 0)
        colors[obs.point[here]] = image.features.colors_rgb[obs.keypoint[here]]
    return colors[_scene_points(adjusted)]


def _data(given: Block, adjusted: AdjustedBlock) -> dict[str, Any]:
    block, solution = adjusted.block, adjusted.solution
    in_gcps = len(_points_of(block, "automatic"))
    return {
        "images": len(block.image_ids),
        "stations": len(block.station_ids),
        "automatic_gcps": in_gcps,
        "tie_points": len(_scene_points(adjusted)) - in_gcps,
        "image_observations": len(block.observations),
        "gnss_positions": len(block.position_priors),
        "pose_priors": len(block.pose_priors),
        "gates": _gates(given, adjusted),
        "coherent_blocks": [_coherent(wrong) for wrong in adjusted.wrong],
        "undecidable": adjusted.undecidable,
        "variance_components": {
            GROUPS[name]: component_data(c) for name, c in adjusted.quality.components.items() if name in GROUPS
        },
        "image_sigma_scale": adjusted.sigma_scale,
        "iterations": solution.iterations,
        "converged": solution.converged,
        "images_used": _per_image(adjusted),
        "control": _control(given, adjusted),
    }


def _gates(given: Block, adjusted: AdjustedBlock) -> dict[str, Any]:
    """How many of each group were tested, and which were rejected; of automatic GCPs the number alone."""
    kinds = np.array(KINDS_OF_POINT)[given.point_priors.kind]
    tested = {
        IMAGE_OBSERVATIONS: len(given.observations),
        KINDS_OF_POSE[0]: len(given.pose_priors),
        POSITION_PRIORS: len(given.position_priors),
        **{kind: int((kinds == kind).sum()) for kind in KINDS_OF_POINT},
    }
    names = {kind: [r.name for r in adjusted.rejected if r.kind == kind] for kind in tested}
    rejected = {kind: len(found) for kind, found in names.items()} | {IMAGE_OBSERVATIONS: adjusted.dropped}
    names["automatic"] = []
    return {
        GROUPS[kind]: {"tested": count, "rejected": rejected[kind], "rejected_ids": names[kind]}
        for kind, count in tested.items()
    }


def _coherent(wrong: CoherentBlock) -> dict[str, Any]:
    """Neighbouring stations whose localized poses are off by one shift: given minus adjusted, world axes."""
    return {
        "stations": list(wrong.station_ids),
        "shift_m": wrong.shift_m.tolist(),
        "sigma_m": np.sqrt(np.diag(wrong.cov)).tolist(),
        "statistic": wrong.statistic,
    }


def component_data(component: Component) -> dict[str, Any]:
    return {
        "observations": component.observations,
        "redundancy": component.redundancy,
        "factor": component.factor,
        "factor_sigma": component.factor_sigma,
    }


def _per_image(adjusted: AdjustedBlock) -> dict[str, Any]:
    """Number of observations, residual RMS in pixels and offset from GNSS of each image."""
    block, state = adjusted.block, adjusted.solution.state
    obs = block.observations
    square = np.square(block.views(state).project(obs.view, state.points[obs.point]) - obs.pixel).mean(axis=1)
    count = np.bincount(obs.view, minlength=len(block.image_ids))
    total = np.bincount(obs.view, weights=square, minlength=len(count))
    out: dict[str, Any] = {
        name: {"observations": int(n), "residual_rms_px": float(np.sqrt(t / n)) if n else None}
        for name, n, t in zip(block.image_ids, count, total, strict=True)
    }
    places = zip(block.station.tolist(), block.mounting.tolist(), strict=True)
    image_at = dict(zip(places, block.image_ids, strict=True))
    priors = block.position_priors
    measured = state.world_from_rig.take(priors.station).apply(state.lever_arms_m[priors.antenna])
    for station, mounting, offset in zip(priors.station, priors.antenna, measured - priors.position, strict=True):
        out[image_at[int(station), int(mounting)]]["gnss_residual_m"] = offset.tolist()
    return out


def _control(given: Block, adjusted: AdjustedBlock) -> list[dict[str, Any]]:
    """Residuals of the control points that took part, in world axes: estimated minus given."""
    priors = adjusted.block.point_priors
    marks = np.bincount(given.observations.point, minlength=len(given.points))
    return [
        {
            "point": priors.point_ids[row],
            "residual_m": (adjusted.solution.state.points[priors.point[row]] - priors.position[row]).tolist(),
            "sigma_m": np.sqrt(np.diag(np.linalg.inv(priors.information[row]))).tolist(),
            "images": int(marks[priors.point[row]]),
        }
        for row in np.flatnonzero(priors.kind == KINDS_OF_POINT.index("control"))
    ]


def _line(data: dict[str, Any]) -> str:
    scale = data["variance_components"]["image_observations"]["factor"]
    gate = data["gates"]["image_observations"]
    return (
        f"{data['images']} images, {data['automatic_gcps']} automatic GCPs, {data['tie_points']} tie points, "
        f"{data['image_observations']} observations ({gate['rejected']} rejected), "
        f"sigma0 {'-' if scale is None else f'{scale:.2f}'}"
        + ("" if data["converged"] else ", NOT CONVERGED")
        + (", UNDECIDABLE which localized poses are wrong" if data["undecidable"] else "")
    )
