"""Outcomes of localization: every image has one."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from georef.geometry.camera import Camera
from georef.geometry.covariance import pose_cov_from_parts
from georef.geometry.rigid import Array, Rigid3
from georef.types.campaign import Campaign


class RejectReason(StrEnum):
    """Why an image has no pose."""

    UNREADABLE = "unreadable"  # the file cannot be decoded
    WRONG_SIZE = "wrong_size"  # the image does not have the size of its camera
    NO_PRIOR = "no_prior"  # no position at all, and a whole-reference search was not allowed
    FEW_FEATURES = "few_features"
    NO_CANDIDATES = "no_candidates"  # no reference image can see the same place
    FEW_MATCHES = "few_matches"
    FEW_INLIERS = "few_inliers"
    DEGENERATE = "degenerate"  # geometry that does not fix the pose
    PRIOR_CONTRADICTS = "prior_contradicts"  # the images say one place, the position prior another
    INTERNAL = "internal"  # an unexpected error in the computation of this image, its text in `detail`


@dataclass(frozen=True, eq=False)
class ReferenceMatches:
    """Verified correspondences of a query image with one reference image, as keypoint indices."""

    reference_id: str
    indices: NDArray[np.int32]  # (M, 2): query keypoint, reference keypoint


@dataclass(frozen=True, eq=False)
class Localized:
    """The pose of an image with a covariance that can be believed, and what it rests on."""

    image_id: str
    world_from_cam: Rigid3
    world_from_cam_cov: Array  # (6, 6), right perturbation, (rad, m), against the reference as a whole
    relative_cov: Array  # (6, 6), the same against the reference as it is published: without its own errors
    correspondence_count: int  # points used
    sigma0: float  # a-posteriori over a-priori standard deviation of an observation
    matches: tuple[ReferenceMatches, ...]
    points_in_world: Array  # (P, 3) the map points behind the correspondences
    keypoints: NDArray[np.int64]  # (P,) the query keypoints that see them
    gnss_rejected: bool = False
    gnss_offset_m: float | None = None  # distance from a rejected position prior
    notes: tuple[str, ...] = ()
    cpu_s: dict[str, float] = field(default_factory=dict)
    camera: Camera | None = None  # as estimated, where the image's own is not known
    intrinsics_cov: Array | None = None  # (q, q) of steps of camera.estimate, see ESTIMABLE
    candidates: tuple[str, ...] = ()  # references that were tried, the most promising first
    quarter_turns: int = 0  # clockwise, of the picture whose features `keypoints` and `matches` index

    @property
    def intrinsic_sigmas(self) -> dict[str, tuple[float, float]]:
        """Value and 1-sigma of what was estimated of the camera; focal (fx), cx, cy in pixels."""
        if self.camera is None or self.intrinsics_cov is None:
            return {}
        sigmas = np.sqrt(np.diag(self.intrinsics_cov))
        values = [self.camera.value(name) for name in self.camera.estimate]
        units = [self.camera.unit(name) for name in self.camera.estimate]
        names = self.camera.estimate
        return {n: (v, float(s * u)) for n, v, s, u in zip(names, values, sigmas, units, strict=True)}


@dataclass(frozen=True, eq=False)
class Rejected:
    image_id: str
    reason: RejectReason
    detail: str
    notes: tuple[str, ...] = ()
    cpu_s: dict[str, float] = field(default_factory=dict)
    candidates: tuple[str, ...] = ()  # references that were tried, the most promising first


Outcome = Localized | Rejected


def with_estimated_cameras(campaign: Campaign, outcomes: Iterable[Outcome]) -> Campaign:
    """The campaign with the cameras that localization has estimated; they still name what was not known of them."""
    cameras = {o.image_id: o.camera for o in outcomes if isinstance(o, Localized) and o.camera is not None}
    if not cameras:
        return campaign
    images = (replace(i, camera=cameras[i.image_id]) if i.image_id in cameras else i for i in campaign.images)
    return replace(campaign, images=tuple(images))


@dataclass(frozen=True)
class ReferenceNoise:
    """How well the reference and its keypoints are known, each relative to the reference as a whole."""

    keypoint_sigma: float  # 1-sigma of a keypoint coordinate, in units of its scale
    position_sigma_m: tuple[float, float, float]  # of a reference position, east, north, up
    rotation_sigma_rad: tuple[float, float, float]  # about the camera axes
    source: str  # "declared" or "estimated"
    widening_angle_rad: float = np.inf  # a match across it has twice the variance of one across no angle

    def widening(self, angle_rad: Array) -> Array:
        """Factors (n,) on the sigmas of keypoints that were matched across angles (n,) between their rays.

        Seen from another side, a keypoint sits on a slightly different spot of the same thing.
        """
        return np.sqrt(1.0 + angle_rad / self.widening_angle_rad)

    def pose_cov(self, world_from_cam: Rigid3) -> Array:
        """Covariance (6, 6) of a reference pose."""
        return pose_cov_from_parts(
            world_from_cam,
            np.diag(np.square(self.position_sigma_m)),
            np.diag(np.square(self.rotation_sigma_rad)),
        )
