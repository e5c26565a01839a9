"""Paired positions for the datum sentinel: of a new epoch by its localization and by GNSS, or of surveyed control.

The map says where images are (localized poses), and where points are that are marked in them (forward intersection).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag

from georef.estimation.datum.types import Paired
from georef.evaluation.forward_intersection import PosedImages, intersect, points_cov_from_poses
from georef.geometry.covariance import position_cov_in_world
from georef.geometry.rigid import Array
from georef.types.campaign import Image
from georef.types.constraints import CheckKind, CheckPoint, ControlPoint
from georef.types.results import Localized

MAP, GNSS, CONTROL = "the map", "GNSS", "surveyed control"
_NEIGHBOURS = 25.0  # positions over which errors of GNSS go together
_LEVEL = 0.3  # level part of an optical axis below which it has no heading


@dataclass(frozen=True)
class Origin:
    """What is known of the world frame: easting and northing of its origin where they are metres, and its latitude."""

    in_crs_m: tuple[float, float] | None = None
    latitude_rad: float | None = None


def gnss_pairs(
    images: Sequence[Image],
    localized: Sequence[Localized],
    lever_arms_m: Sequence[Array],
    extra_sigma_m: float,
    origin: Origin,
) -> Paired | None:
    """Antennas by localization and by GNSS, one pair a station; None where no localized image has a position.

    lever_arms_m: (3,) of each image, antenna in the frame of its camera. extra_sigma_m: of an offset that GNSS is
    declared to have.
    """
    first, second, sigma, heading = [], [], [], []
    seen: set[str] = set()
    for image, found, arm in zip(images, localized, lever_arms_m, strict=True):
        if image.gnss is None or image.station in seen:
            continue
        if image.station is not None:
            seen.add(image.station)
        first.append(found.world_from_cam.apply(arm))
        second.append(image.gnss.position_in_world)
        cov = image.gnss.cov + position_cov_in_world(found.world_from_cam, found.world_from_cam_cov)
        sigma.append(np.sqrt(np.diag(cov)))
        heading.append(found.world_from_cam.rotation[:, 2])
    if not first:
        return None
    sigmas, ahead = np.array(sigma), np.array(heading)
    headed = np.hypot(ahead[:, 0], ahead[:, 1]) > _LEVEL
    return Paired(
        *(MAP, GNSS, np.array(first), np.array(second), sigmas),
        shared_m=float(np.hypot(np.sqrt(np.mean(np.square(np.median(sigmas, axis=0)))), extra_sigma_m)),
        shared_over=_NEIGHBOURS,
        heading_rad=np.arctan2(ahead[:, 0], ahead[:, 1]) if headed.all() else None,
        crs_origin_m=origin.in_crs_m,
        latitude_rad=origin.latitude_rad,
    )


def control_pairs(
    control: Sequence[ControlPoint], images: Sequence[Image], localized: Sequence[Localized], origin: Origin
) -> Paired | None:
    """Control points of which all coordinates are known, by forward intersection from localized poses and by survey;
    None where there are none."""
    covs = [found.world_from_cam_cov for found in localized]
    posed = PosedImages(
        tuple(found.image_id for found in localized),
        tuple(image.camera for image in images),
        tuple(found.world_from_cam for found in localized),
        lambda indices: np.asarray(block_diag(*(covs[i] for i in indices)), dtype=np.float64),
    )
    first, second, sigma = [], [], []
    for point in (p for p in control if p.partial is None):
        given = CheckPoint(point.point_id, CheckKind.ABSOLUTE, point.point_in_world, point.cov, point.marks)
        found = intersect(given, posed)
        if isinstance(found, str) or posed.joint_cov is None:
            continue
        cov = found.mark_cov + points_cov_from_poses([found], posed.joint_cov) + point.cov
        first.append(found.point)
        second.append(point.point_in_world)
        sigma.append(np.sqrt(np.diag(cov)))
    if not first:
        return None
    sigmas = np.array(sigma)
    return Paired(
        *(MAP, CONTROL, np.array(first), np.array(second), sigmas),
        shared_m=float(np.sqrt(np.mean(np.square(np.median(sigmas, axis=0))))),
        shared_over=0.25 * len(first),
        crs_origin_m=origin.in_crs_m,
        latitude_rad=origin.latitude_rad,
    )


def contradiction(paired: Paired) -> tuple[float, float]:
    """How far the pairs lie from each other in their stated sigmas, the median: level and height."""
    apart = np.abs(paired.second - paired.first)
    sigma = np.sqrt(np.square(paired.sigma_m) + paired.shared_m**2)
    level = np.linalg.norm(apart[:, :2], axis=1) / np.sqrt(np.mean(np.square(sigma[:, :2]), axis=1))
    return float(np.median(level)), float(np.median(apart[:, 2] / sigma[:, 2]))
