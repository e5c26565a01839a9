"""The reference judged by itself: how well its poses and keypoints agree with each other.

Reference images are matched along their epipolar lines and adjusted with their given exterior orientations as
weighted observations; variance components of keypoints, positions and rotations follow from the residuals. What is
common to the whole reference (a shift, a turn) leaves no residual and is not observable here.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from georef.config import AdjustConfig, NetworkConfig
from georef.errors import StageError
from georef.estimation.adjustment.adjust import Adjusted, adjust
from georef.estimation.adjustment.components import Component
from georef.estimation.adjustment.gate import variance_ratios, worst_orientation
from georef.estimation.adjustment.posterior import posterior
from georef.estimation.adjustment.problem import Orientation, Problem
from georef.estimation.adjustment.solve import Solution, solution_views
from georef.estimation.guided import GuidedOptions, PosedFeatures, epipolar_band, guided_matches
from georef.estimation.smooth_errors import Residuals, SmoothErrors, smooth_errors
from georef.estimation.tracks import (
    PairMatches,
    build_tracks,
    distributed,
    nearest_ray_angles,
    select_points,
    triangulated_tracks,
)
from georef.executor import Progress
from georef.features.nearest import MutualNearest
from georef.geometry.rigid import Array
from georef.geometry.triangulation import triangulate
from georef.types.results import ReferenceNoise

_VOTERS = 512
_START_POSITION_M, _START_ROTATION_RAD, START_KEYPOINT = 0.01, 3e-4, 0.5
_LEAST_POSITION_M, _LEAST_ROTATION_RAD = 1e-4, 1e-6
_ROUNDS, _SETTLED = 10, 0.03
_LEAST_POINTS = 30
_ANGLE_EDGES, _LEAST_ANGLE_BINS = np.radians([5.0, 10.0, 15.0, 20.0, 30.0, 45.0, 60.0]), 3
_LEAST_WIDENING_RAD, _WIDENING_ROUNDS = np.radians(3.0), 5
_LOOSE = 5.0  # times the sigmas of poses, for the gate of the tracks
_LEAST_MATCHED, _CONTRADICTED = 20, 0.5  # observations of an image; its share of them that is used against the usual


@dataclass(frozen=True, eq=False)
class NetworkResult:
    noise: ReferenceNoise
    components: dict[str, Component]  # of the last round, factors near 1 where they were estimated
    suspects: tuple[int, ...]  # images whose given orientation contradicts the others
    smooth: SmoothErrors | None  # of estimated sigmas: what neighbours share, which is no part of them
    images: int
    points: int
    observations: int


def choose_images(positions: Array, limit: int) -> NDArray[np.int64]:
    """At most `limit` images that lie together: those nearest to the image nearest to the middle."""
    if len(positions) <= limit:
        return np.arange(len(positions))
    middle = np.linalg.norm(positions - np.median(positions, axis=0), axis=1).argmin()
    return np.sort(np.linalg.norm(positions - positions[middle], axis=1).argsort(kind="stable")[:limit])


def match_network(
    images: Sequence[PosedFeatures],
    neighbours: int,
    options: GuidedOptions,
    progress: Progress,
) -> list[PairMatches]:
    """Guided matches of each image with the others that share most content with it under the known geometry."""
    votes = _pair_votes(images, options.gate)
    pairs = {
        (min(i, int(j)), max(i, int(j)))
        for i in range(len(images))
        for j in np.argsort(-votes[i], kind="stable")[:neighbours]
        if votes[i, j] > 0
    }
    progress.begin("network", len(pairs))
    out = []
    for i, j in sorted(pairs):
        out.append(PairMatches(i, j, guided_matches(images[i], images[j], options).indices))
        progress.advance()
    progress.end()
    return out


def _pair_votes(images: Sequence[PosedFeatures], gate: float) -> NDArray[np.int64]:
    """Mutual nearest neighbours among the best features that also lie on each other's epipolar lines."""
    matcher = MutualNearest(ratio=0.95)
    heads = [image.head(_VOTERS) for image in images]
    votes = np.zeros((len(images), len(images)), np.int64)
    for i in range(len(images)):
        for j in range(i):
            pairs = matcher.match(heads[i].features, heads[j].features).indices
            band = epipolar_band(heads[i], heads[j], gate)
            votes[i, j] = votes[j, i] = int(band[pairs[:, 0], pairs[:, 1]].sum())
    return votes


def estimate_noise(
    images: Sequence[PosedFeatures],
    matches: Sequence[PairMatches],
    config: NetworkConfig,
    adjust_config: AdjustConfig,
    declared: ReferenceNoise | None,
) -> NetworkResult:
    """Sigmas of keypoints, and of reference positions and rotations where they are not declared.

    Estimated ones are those of an image against its neighbours, without what these share (see `smooth_errors`).
    Raises StageError where the reference images share too little to say.
    """
    start = _uniform(_START_POSITION_M), _uniform(_START_ROTATION_RAD)
    noise = declared or ReferenceNoise(START_KEYPOINT, *start, "estimated")
    limit = config.max_suspect_share * len(images)
    problem, suspects = _problem(images, matches, config, noise)
    suspects = suspects[: int(limit)]
    problem = _set_aside(problem, suspects)
    while True:
        noise, adjusted = _iterated(problem, noise, adjust_config, estimate_poses=declared is None)
        cofactors = posterior(adjusted.problem, adjusted.solution)
        worst = worst_orientation(adjusted.problem, adjusted.solution, cofactors, adjust_config.gate_probability)
        if worst is None or len(suspects) >= limit:
            break
        suspects.append(worst)
        problem = _set_aside(_continued(adjusted, noise), [worst])
    smooth = None
    if declared is None:
        residuals = Residuals.of(adjusted.problem, adjusted.solution, cofactors)
        smooth = smooth_errors(residuals, noise.position_sigma_m[0], noise.rotation_sigma_rad[0])
    if smooth is not None:
        own = _uniform(smooth.own_position_m), _uniform(smooth.own_rotation_rad)
        noise = replace(noise, position_sigma_m=own[0], rotation_sigma_rad=own[1])
    return NetworkResult(
        replace(noise, widening_angle_rad=widening_angle(adjusted.problem, adjusted.solution)),
        adjusted.components,
        tuple(suspects),
        smooth,
        len(images),
        len(adjusted.problem.points),
        len(adjusted.problem.observations),
    )


def widening_angle(problem: Problem, solution: Solution) -> float:
    """How the variance of keypoints grows with the angle they are matched across: that of `ReferenceNoise.widening`.

    Residuals show it undiluted only where the points were intersected with the right weights: so it is iterated, poses
    held. Infinite where the network shows no growth.
    """
    obs, views = problem.observations, solution_views(problem, solution)
    angle = nearest_ray_angles(solution.points, obs, views.centres)
    widening = np.ones(len(obs))
    found = np.inf
    for _ in range(_WIDENING_ROUNDS):
        weighted = replace(problem, observations=replace(obs, sigma_px=obs.sigma_px * widening))
        sigma = weighted.observations.sigma_px
        points = triangulate(views, obs.point, obs.view, obs.pixel, sigma, len(solution.points)).points
        ratio = variance_ratios(weighted, replace(solution, points=points)) * np.square(widening)
        found = _growth(angle, ratio)
        widening = np.sqrt(1.0 + angle / found)
    return found


def _growth(angle: Array, variance: Array) -> float:
    """The angle across which a variance doubles, from a straight line through the medians of angle bins."""
    known = np.isfinite(variance) & np.isfinite(angle)
    angle, variance = angle[known], variance[known]
    index = np.searchsorted(_ANGLE_EDGES, angle)
    bins = [index == i for i in range(len(_ANGLE_EDGES) + 1) if (index == i).sum() >= _LEAST_POINTS]
    if len(bins) < _LEAST_ANGLE_BINS:
        return np.inf
    middle = np.array([np.median(angle[part]) for part in bins])
    level = np.array([np.median(variance[part]) for part in bins])
    count = np.array([part.sum() for part in bins])
    slope, start = np.polyfit(middle, level, 1, w=np.sqrt(count) / level)
    return float(max(start / slope, _LEAST_WIDENING_RAD)) if slope > 0 else np.inf


def _uniform(sigma: float) -> tuple[float, float, float]:
    return sigma, sigma, sigma


def _iterated(
    problem: Problem, noise: ReferenceNoise, adjust_config: AdjustConfig, *, estimate_poses: bool
) -> tuple[ReferenceNoise, Adjusted]:
    """Adjusts and scales the sigmas by their components until these settle near 1."""
    adjusted = adjust(_with_noise(problem, noise), adjust_config)
    noise, change = _updated(noise, adjusted, estimate_poses=estimate_poses)
    for _ in range(_ROUNDS - 1):
        if change < _SETTLED:
            break
        adjusted = adjust(_continued(adjusted, noise), adjust_config)
        noise, change = _updated(noise, adjusted, estimate_poses=estimate_poses)
    return noise, adjusted


def _set_aside(problem: Problem, images: Sequence[int]) -> Problem:
    """The problem without the observations of some images; their orientations stay, with nothing to contradict."""
    return problem.restricted(~np.isin(problem.observations.view, images), np.zeros(0, bool))


def _problem(
    images: Sequence[PosedFeatures], matches: Sequence[PairMatches], config: NetworkConfig, noise: ReferenceNoise
) -> tuple[Problem, list[int]]:
    """The problem, and the images whose matches the poses contradict so grossly that hardly any took part, worst first.

    Tracks are gated loosely: the sigmas of the poses are not known yet, and wrong poses are to be found.
    """
    count, matched = build_tracks(images, matches, noise.keypoint_sigma)
    covs = [_LOOSE**2 * noise.pose_cov(image.world_from_cam) for image in images]
    points, observations = triangulated_tracks(count, matched, images, covs)
    suspects = _contradicting(matched.view, observations.view, len(images))
    sizes = np.array([[image.camera.width, image.camera.height] for image in images], dtype=float)
    keep = distributed(observations, sizes, np.ones(len(images), bool), config.max_points_per_image)
    points, observations = select_points(points, observations, keep)
    if len(points) < _LEAST_POINTS:
        raise StageError(
            f"The reference images share only {len(points)} points, too few to estimate the reference's sigma.",
            f"Expected at least {_LEAST_POINTS} points seen by two or more reference images.",
            "Declare it in project.toml: [reference] sigma = { position_m = [...], rotation_deg = [...] }.",
        )
    problem = Problem(
        image_ids=tuple(str(i) for i in range(len(images))),
        cameras=tuple(image.camera for image in images),
        world_from_cams=tuple(image.world_from_cam for image in images),
        points=points,
        observations=observations,
        orientations={i: _orientation(image, noise) for i, image in enumerate(images)},
    )
    return problem, suspects


def _contradicting(matched: NDArray[np.int64], used: NDArray[np.int64], count: int) -> list[int]:
    """Images that lose far more of their observations (by view index) to the geometry than others, worst first."""
    before, after = np.bincount(matched, minlength=count), np.bincount(used, minlength=count)
    share = after / np.maximum(before, 1)
    usual = float(np.median(share[before > 0])) if (before > 0).any() else 0.0
    suspicious = (before >= _LEAST_MATCHED) & (share < _CONTRADICTED * usual)
    return [int(i) for i in np.argsort(share, kind="stable") if suspicious[i]]


def _orientation(image: PosedFeatures, noise: ReferenceNoise) -> Orientation:
    return Orientation(image.world_from_cam, np.array(noise.position_sigma_m), np.array(noise.rotation_sigma_rad))


def _with_noise(problem: Problem, noise: ReferenceNoise) -> Problem:
    orientations = {
        i: Orientation(o.world_from_cam, np.array(noise.position_sigma_m), np.array(noise.rotation_sigma_rad))
        for i, o in problem.orientations.items()
    }
    return replace(problem, orientations=orientations)


def _continued(adjusted: Adjusted, noise: ReferenceNoise) -> Problem:
    problem = adjusted.problem.with_poses(adjusted.solution.world_from_cams, adjusted.solution.points)
    return _with_noise(problem, noise)


def _updated(noise: ReferenceNoise, adjusted: Adjusted, *, estimate_poses: bool) -> tuple[ReferenceNoise, float]:
    """The sigmas times the square roots of their components, and the largest relative change."""
    position = _factor(adjusted, "reference_position", noise) if estimate_poses else 1.0
    rotation = _factor(adjusted, "reference_rotation", noise) if estimate_poses else 1.0
    new_position = max(noise.position_sigma_m[0] * position, _LEAST_POSITION_M)
    new_rotation = max(noise.rotation_sigma_rad[0] * rotation, _LEAST_ROTATION_RAD)
    change = max(
        abs(adjusted.sigma_scale - 1.0),
        abs(new_position / noise.position_sigma_m[0] - 1.0) if estimate_poses else 0.0,
        abs(new_rotation / noise.rotation_sigma_rad[0] - 1.0) if estimate_poses else 0.0,
    )
    updated = replace(noise, keypoint_sigma=noise.keypoint_sigma * adjusted.sigma_scale)
    if estimate_poses:
        updated = replace(updated, position_sigma_m=_uniform(new_position), rotation_sigma_rad=_uniform(new_rotation))
    return updated, change


def _factor(adjusted: Adjusted, group: str, noise: ReferenceNoise) -> float:
    """Estimated over stated sigma; 1 where a sigma is so small already that the keypoints do not show it any more."""
    factor = adjusted.components[group].factor
    if factor is not None:
        return factor
    if noise.position_sigma_m[0] == _START_POSITION_M and noise.rotation_sigma_rad[0] == _START_ROTATION_RAD:
        raise StageError(
            "The reference images overlap too little to estimate the sigma of their exterior orientation.",
            "Declare it in project.toml: [reference] sigma = { position_m = [...], rotation_deg = [...] }.",
        )
    return 1.0
