"""Verified tracks without some of the images that they were found with, as if these were new images.

Their observations are dropped from every track, and what has lost one is intersected again, by the same rules, from
those that are left: no pixel of an image that is left out enters a point or its covariance. What remains of it is that
its matches may have joined keypoints of other images to one track.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from georef.estimation.guided import PosedFeatures
from georef.estimation.reference_tracks import consistent_tracks, structure_of
from georef.geometry.projection import Views
from georef.geometry.rigid import Array
from georef.types.results import ReferenceNoise
from georef.types.scene import ImageStructure, Observations


def remaining(
    structure: ImageStructure,
    own: int,
    place: NDArray[np.int64],
    posed: Callable[[int], PosedFeatures],
    pose_cov: Callable[[int], Array],
    noise: ReferenceNoise,
) -> ImageStructure:
    """What is left of the tracks that an image sees. Views of the result are places among the images that stay.

    own: the image's place among all; place: (N,) of each image among those that stay, -1: it is left out; posed,
    pose_cov: an image and the covariance (6, 6) of its pose, by its place among all.
    """
    obs = structure.observations
    stays = place[obs.view] >= 0
    changed = np.zeros(len(structure), bool)
    changed[obs.point[~stays]] = True
    left = obs.take(stays & changed[obs.point])
    again = ImageStructure.empty()
    if len(left):
        members, view = np.unique(left.view, return_inverse=True)
        images = [posed(int(image)) for image in members]
        _, point = np.unique(left.point, return_inverse=True)
        numbered = replace(left, point=point.astype(np.int64), view=view.astype(np.int64))
        views = Views.of([image.world_from_cam for image in images], [image.camera for image in images])
        pose_covs = np.array([pose_cov(int(image)) for image in members])
        tracks = consistent_tracks(views, _unwidened(numbered, images, noise), noise, pose_covs)
        again = structure_of(int(np.searchsorted(members, own)), place[members], tracks)
    return _together(_unchanged(structure, ~changed, place), again)


def _unwidened(observations: Observations, images: list[PosedFeatures], noise: ReferenceNoise) -> Observations:
    """The observations with the sigmas of their keypoints: how far their rays are from others has changed."""
    scale_px = np.zeros(len(observations))
    for view, image in enumerate(images):
        here = observations.view == view
        scale_px[here] = image.features.scales_px[observations.keypoint[here]]
    return replace(observations, sigma_px=noise.keypoint_sigma * scale_px)


def _unchanged(structure: ImageStructure, chosen: NDArray[np.bool_], place: NDArray[np.int64]) -> ImageStructure:
    kept = structure.observations.take(chosen[structure.observations.point])
    identity = structure.identity[chosen]
    return ImageStructure(
        structure.keypoint[chosen],
        np.column_stack([place[identity[:, 0]], identity[:, 1]]),
        structure.points[chosen],
        structure.cov[chosen],
        replace(kept, point=(np.cumsum(chosen) - 1)[kept.point], view=place[kept.view]),
    )


def _together(a: ImageStructure, b: ImageStructure) -> ImageStructure:
    """The points of two structures of one image, in the order of its keypoints."""
    order = np.argsort(np.concatenate([a.keypoint, b.keypoint]), kind="stable")
    place = np.empty(len(order), np.int64)
    place[order] = np.arange(len(order))
    obs = Observations.joined([a.observations, b.observations.with_points(b.observations.point + len(a))])
    obs = obs.with_points(place[obs.point])
    return ImageStructure(
        np.concatenate([a.keypoint, b.keypoint])[order],
        np.concatenate([a.identity, b.identity])[order],
        np.concatenate([a.points, b.points])[order],
        np.concatenate([a.cov, b.cov])[order],
        obs.take(np.argsort(obs.point, kind="stable")),
    )
