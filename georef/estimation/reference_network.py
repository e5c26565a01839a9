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
from georef.estimation.adjustment.block import Block
from georef.estimation.adjustment.network import AdjustedNetwork, adjust_network, network_block, worst_orientation
from georef.estimation.adjustment.quality.components import Component
from georef.estimation.guided import GuidedOptions, PosedFeatures, epipolar_band, guided_matches
from georef.estimation.smooth_errors import Residuals, SmoothErrors, smooth_errors
from georef.estimation.tracks import (
    PairMatches,
    build_tracks,
    distributed,
    select_points,
    triangulated_tracks,
)
from georef.estimation.widening import widening_angle
from georef.executor import Progress
from georef.features.nearest import MutualNearest
from georef.geometry.rigid import Array
from georef.types.results import ReferenceNoise

_VOTERS = 512
_START_POSITION_M, _START_ROTATION_RAD, START_KEYPOINT = 0.01, 3e-4, 0.5
_LEAST_POSITION_M, _LEAST_ROTATION_RAD = 1e-4, 1e-6
_ROUNDS, _SETTLED = 10, 0.03
_LEAST_POINTS = 30
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
    block, suspects = _block(images, matches, config, noise)
    suspects = suspects[: int(limit)]
    block = _set_aside(block, suspects)
    while True:
        noise, adjusted = _iterated(block, noise, adjust_config, estimate_poses=declared is None)
        worst = worst_orientation(adjusted.block, adjusted.quality, adjust_config.gate_probability)
        if worst is None or len(suspects) >= limit:
            break
        suspects.append(worst)
        block = _set_aside(_continued(adjusted, noise), [worst])
    smooth = _smooth(adjusted, noise) if declared is None else None
    if smooth is not None:
        own = _uniform(smooth.own_position_m), _uniform(smooth.own_rotation_rad)
        noise = replace(noise, position_sigma_m=own[0], rotation_sigma_rad=own[1])
    obs, views = adjusted.block.observations, adjusted.block.views(adjusted.state)
    return NetworkResult(
        replace(noise, widening_angle_rad=widening_angle(adjusted.state.points, obs, views)),
        adjusted.components,
        tuple(suspects),
        smooth,
        len(images),
        len(np.unique(obs.point)),
        len(obs),
    )


def _smooth(adjusted: AdjustedNetwork, noise: ReferenceNoise) -> SmoothErrors | None:
    residuals = Residuals.of(adjusted.block, adjusted.state, adjusted.quality.cofactors, noise)
    return smooth_errors(residuals, noise.position_sigma_m[0], noise.rotation_sigma_rad[0])


def _uniform(sigma: float) -> tuple[float, float, float]:
    return sigma, sigma, sigma


def _iterated(
    block: Block, noise: ReferenceNoise, adjust_config: AdjustConfig, *, estimate_poses: bool
) -> tuple[ReferenceNoise, AdjustedNetwork]:
    """Adjusts and scales the sigmas by their components until these settle near 1."""
    adjusted = adjust_network(_with_noise(block, noise), adjust_config)
    noise, change = _updated(noise, adjusted, estimate_poses=estimate_poses)
    for _ in range(_ROUNDS - 1):
        if change < _SETTLED:
            break
        adjusted = adjust_network(_continued(adjusted, noise), adjust_config)
        noise, change = _updated(noise, adjusted, estimate_poses=estimate_poses)
    return noise, adjusted


def _set_aside(block: Block, images: Sequence[int]) -> Block:
    """The network without the observations of some images; their orientations stay, with nothing to contradict."""
    return replace(block, observations=block.observations.take(~np.isin(block.observations.view, images)))


def _block(
    images: Sequence[PosedFeatures], matches: Sequence[PairMatches], config: NetworkConfig, noise: ReferenceNoise
) -> tuple[Block, list[int]]:
    """The network, and the images whose matches the poses contradict so grossly that hardly any took part, worst first.

    Tracks are gated loosely: the sigmas of the poses are not known yet, and wrong poses are to be found.
    """
    count, matched = build_tracks(images, matches, noise.keypoint_sigma)
    given = [image.world_from_cam for image in images]
    covs = np.array([noise.pose_cov(pose) for pose in given])
    points, observations = triangulated_tracks(count, matched, images, list(_LOOSE**2 * covs))
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
    return network_block([image.camera for image in images], given, covs, points, observations), suspects


def _contradicting(matched: NDArray[np.int64], used: NDArray[np.int64], count: int) -> list[int]:
    """Images that lose far more of their observations (by view index) to the geometry than others, worst first."""
    before, after = np.bincount(matched, minlength=count), np.bincount(used, minlength=count)
    share = after / np.maximum(before, 1)
    usual = float(np.median(share[before > 0])) if (before > 0).any() else 0.0
    suspicious = (before >= _LEAST_MATCHED) & (share < _CONTRADICTED * usual)
    return [int(i) for i in np.argsort(share, kind="stable") if suspicious[i]]


def _with_noise(block: Block, noise: ReferenceNoise) -> Block:
    priors = block.pose_priors
    covs = np.array([noise.pose_cov(pose) for pose in priors.world_from_cam.to_list()])
    return replace(block, pose_priors=replace(priors, cov=covs))


def _continued(adjusted: AdjustedNetwork, noise: ReferenceNoise) -> Block:
    return _with_noise(adjusted.block.started(adjusted.state), noise)


def _updated(noise: ReferenceNoise, adjusted: AdjustedNetwork, *, estimate_poses: bool) -> tuple[ReferenceNoise, float]:
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


def _factor(adjusted: AdjustedNetwork, group: str, noise: ReferenceNoise) -> float:
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
