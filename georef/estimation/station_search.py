"""Looking for images where their station is, and for a station none of whose images was localized alone."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pycolmap
from numpy.typing import NDArray

from georef.config import LocalizeConfig
from georef.estimation.colmap import colmap_camera
from georef.estimation.guided import GuidedOptions, guided_matches
from georef.estimation.local_model import LocalModel, query_centred_model
from georef.estimation.reference_map import ReferenceMap
from georef.estimation.station_image import StationImage
from georef.features.base import Matcher
from georef.geometry.camera import rays_from_pixels
from georef.geometry.rigid import Array, Rigid3
from georef.types.results import ReferenceMatches

_SIMILAR_VIEW_RAD = np.radians(60.0)
_LEAST_CAMERAS = 2
_LEAST_DEPTH = 0.25  # of a unit ray: COLMAP's fisheye ends at 90 degrees


def second_chance(
    image: StationImage, world_from_rig: Rigid3, reference: ReferenceMap, config: LocalizeConfig, count: int = 10
) -> tuple[ReferenceMatches, ...]:
    """Matches along the epipolar lines of the pose that the station gives an image, with the nearest references."""
    pose = world_from_rig @ image.mounting.rig_from_cam
    options = GuidedOptions.of(config)
    found = []
    for index in _references_near(pose, reference, count):
        matches = guided_matches(image.features.posed(pose), reference.posed(index), options)
        if len(matches):
            found.append(ReferenceMatches(reference.images[index].image_id, matches.indices))
    return tuple(found)


def _references_near(pose: Rigid3, reference: ReferenceMap, count: int) -> list[int]:
    """The nearest references that look in a similar direction."""
    axes = np.array([p.rotation[:, 2] for p in reference.poses])
    similar = axes @ pose.rotation[:, 2] >= np.cos(_SIMILAR_VIEW_RAD)
    distance = np.linalg.norm(reference.positions - pose.translation, axis=1)
    order = np.argsort(np.where(similar, distance, np.inf), kind="stable")
    return [int(i) for i in order[:count] if similar[i]]


def first_station_pose(
    images: Sequence[StationImage],
    reference: ReferenceMap,
    matcher: Matcher,
    keypoints: int,
    references: int,
    config: LocalizeConfig,
) -> Rigid3 | None:
    """world_from_rig of images that were all rejected alone: matched again with the first of their candidates.

    Generalized absolute pose by LO-RANSAC on the points of all images together. None where too few points agree, or
    those of one image alone.
    """
    known = [image for image in images if not image.image.camera.estimate]
    models = [_local_model(image, reference, matcher, keypoints, references) for image in known]
    if sum(len(model) for model in models) < config.min_inliers:
        return None
    return _generalized(known, models, config)


def _local_model(
    image: StationImage, reference: ReferenceMap, matcher: Matcher, keypoints: int, count: int
) -> LocalModel:
    index = {r.image_id: i for i, r in enumerate(reference.images)}
    chosen = [reference.posed(index[name]) for name in image.outcome.candidates[:count] if name in index]
    head = image.features.features.head(keypoints)
    matches = [matcher.match(head, other.features.head(keypoints)) for other in chosen]
    return query_centred_model(chosen, matches, reference.noise.keypoint_sigma)


def _generalized(images: Sequence[StationImage], models: Sequence[LocalModel], config: LocalizeConfig) -> Rigid3 | None:
    """COLMAP's generalized absolute pose (GP3P), in an origin of its own."""
    pixels = [image.features.pixels[model.keypoint] for image, model in zip(images, models, strict=True)]
    shown = np.concatenate([_shown(image, seen) for image, seen in zip(images, pixels, strict=True)])
    camera = np.repeat(np.arange(len(models)), [len(model) for model in models])[shown]
    points = np.concatenate([model.points for model in models])[shown]
    if len(points) < config.min_inliers:
        return None
    origin = points.mean(axis=0)
    options = pycolmap.RANSACOptions()
    options.max_error, options.random_seed = config.ransac_gate_px, config.seed
    found = pycolmap.estimate_and_refine_generalized_absolute_pose(
        np.concatenate(pixels)[shown],
        points - origin,
        camera.tolist(),
        [pycolmap.Rigid3d(image.mounting.rig_from_cam.inverse().matrix()[:3]) for image in images],
        [colmap_camera(image.image.camera) for image in images],
        options,
    )
    if found is None:
        return None
    inliers = np.bincount(camera[np.asarray(found["inlier_mask"], bool)], minlength=len(models))
    if inliers.sum() < config.min_inliers or (inliers >= 6).sum() < min(_LEAST_CAMERAS, len(images)):
        return None
    local_from_rig = Rigid3.from_matrix(found["rig_from_world"].matrix()).inverse()
    return Rigid3(local_from_rig.rotation, local_from_rig.translation + origin)


def _shown(image: StationImage, pixels: Array) -> NDArray[np.bool_]:
    rays = rays_from_pixels(image.image.camera, pixels)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    return np.asarray(np.isfinite(rays).all(axis=1) & (rays[:, 2] >= _LEAST_DEPTH))
