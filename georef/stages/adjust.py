"""Stage `adjust`: tie points among the new images, constraints of the configured kind, bundle adjustment."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from georef.estimation.adjustment.adjust import Adjusted, adjust
from georef.estimation.adjustment.components import Component
from georef.estimation.adjustment.problem import Problem, control_observations
from georef.estimation.adjustment.solve import solution_views
from georef.estimation.epoch_problem import epoch_problem, match_new_images, tie_pairs
from georef.estimation.guided import PosedFeatures
from georef.geometry.rigid import Array, Rigid3
from georef.io.items import read_item, write_item
from georef.stages.base import StageContext, StageSummary, feature_id, open_features
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
    adjusted = adjust(problem, config.adjust)
    data = _data(problem, adjusted)
    arrays = _arrays(adjusted, _colors(adjusted.problem, posed))
    write_item(context.folder / RESULT, {"image_ids": list(adjusted.problem.image_ids), "data": data}, arrays)
    return StageSummary(_line(data), data, len(localized), len(localized))


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


def _arrays(adjusted: Adjusted | None, colors: NDArray[np.uint8]) -> dict[str, np.ndarray]:
    none = np.zeros((0, 0))
    poses = () if adjusted is None else adjusted.solution.world_from_cams
    return {
        "poses": np.array([pose.matrix() for pose in poses]).reshape(-1, 4, 4),
        "joint_cov": none if adjusted is None else adjusted.posterior.poses,
        "relative_joint_cov": none if adjusted is None else adjusted.cofactors.poses,
        "points": np.zeros((0, 3)) if adjusted is None else adjusted.solution.points,
        "colors": colors,
    }


def _colors(problem: Problem, posed: list[PosedFeatures]) -> NDArray[np.uint8]:
    """The colour of each point in one of the images that see it."""
    colors = np.zeros((len(problem.points), 3), np.uint8)
    obs = problem.observations
    for index, image in enumerate(posed):
        here = obs.view == index
        colors[obs.point[here]] = image.features.colors_rgb[obs.keypoint[here]]
    return colors


def _data(given: Problem, adjusted: Adjusted) -> dict[str, Any]:
    problem, solution = adjusted.problem, adjusted.solution
    in_gcps = len(problem.gcps)
    return {
        "images": len(problem.image_ids),
        "automatic_gcps": in_gcps,
        "tie_points": len(problem.points) - in_gcps,
        "image_observations": len(problem.observations),
        "gnss_positions": len(problem.position_priors),
        "pose_priors": len(problem.pose_priors),
        "gates": {
            **{name: asdict(count) for name, count in adjusted.gates.items()},
            "automatic_gcps": {"tested": len(given.gcps), "rejected": len(given.gcps) - in_gcps, "rejected_ids": []},
        },
        "variance_components": {name: component_data(c) for name, c in adjusted.components.items()},
        "image_sigma_scale": adjusted.sigma_scale,
        "iterations": solution.iterations,
        "converged": solution.converged,
        "images_used": _per_image(problem, adjusted),
        "control": _control(problem, adjusted),
    }


def component_data(component: Component) -> dict[str, Any]:
    return {
        "observations": component.observations,
        "redundancy": component.redundancy,
        "factor": component.factor,
        "factor_sigma": component.factor_sigma,
    }


def _per_image(problem: Problem, adjusted: Adjusted) -> dict[str, Any]:
    """Number of observations, residual RMS in pixels and offset from GNSS of each image."""
    views = solution_views(problem, adjusted.solution)
    obs = problem.observations
    residual = views.project(obs.view, adjusted.solution.points[obs.point]) - obs.pixel
    out: dict[str, Any] = {}
    for index, name in enumerate(problem.image_ids):
        here = obs.view == index
        rms = float(np.sqrt(np.mean(np.square(residual[here])))) if here.any() else None
        out[name] = {"observations": int(here.sum()), "residual_rms_px": rms}
        prior = problem.position_priors.get(index)
        if prior is not None:
            offset = adjusted.solution.world_from_cams[index].translation - prior.position_in_world
            out[name]["gnss_residual_m"] = offset.tolist()
    return out


def _control(problem: Problem, adjusted: Adjusted) -> list[dict[str, Any]]:
    """Residuals of the control points that took part, in world axes: estimated minus given."""
    marks = np.bincount(control_observations(problem).point, minlength=len(problem.control))
    return [
        {
            "point": point.point_id,
            "residual_m": (adjusted.solution.control_points[i] - point.point_in_world).tolist(),
            "sigma_m": np.sqrt(np.diag(point.cov)).tolist(),
            "images": int(marks[i]),
        }
        for i, point in enumerate(problem.control)
    ]


def _line(data: dict[str, Any]) -> str:
    scale = data["variance_components"]["image_observations"]["factor"]
    gate = data["gates"]["image_observations"]
    return (
        f"{data['images']} images, {data['automatic_gcps']} automatic GCPs, {data['tie_points']} tie points, "
        f"{data['image_observations']} observations ({gate['rejected']} rejected), "
        f"sigma0 {'-' if scale is None else f'{scale:.2f}'}" + ("" if data["converged"] else ", NOT CONVERGED")
    )
