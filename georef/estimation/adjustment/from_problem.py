"""A problem of images as a block of stations: images that a calibrated rig exposed together hang off one pose."""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from georef.estimation.adjustment.block import (
    KINDS_OF_POINT,
    KINDS_OF_POSE,
    Antenna,
    Block,
    Calibration,
    Indices,
    PointPriors,
    PosePriors,
    PositionPriors,
    ReferenceRays,
    RigCamera,
)
from georef.estimation.adjustment.problem import AutomaticGcps, Problem, control_observations, control_start
from georef.geometry.poses import Poses
from georef.geometry.rigid import Rigid3
from georef.types.campaign import Mounting
from georef.types.scene import Observations

Named = TypeVar("Named", bound=Hashable)
ALONE = "alone"  # the name of the mounting of images that belong to no rig


@dataclass(frozen=True)
class Exposure:
    """The station that an image was exposed at, and where its camera sits on the rig."""

    station: str
    mounting: Mounting


def block_of(problem: Problem, exposures: Sequence[Exposure | None]) -> Block:
    """The block of a problem; exposures: of each image, None for one that is a station by itself.

    Points of the problem come first, then its control points.
    """
    pairs = list(zip(problem.image_ids, exposures, strict=True))
    names = [f"image {image}" if e is None else f"station {e.station}" for image, e in pairs]
    station, station_ids = _numbered(names)
    mounting, mountings = _mountings(exposures)
    calibration, cameras = _numbered(problem.cameras)
    return Block(
        station_ids=tuple(station_ids),
        image_ids=problem.image_ids,
        station=station,
        mounting=mounting,
        calibration=calibration,
        mountings=mountings,
        calibrations=tuple(Calibration.held(camera) for camera in cameras),
        world_from_rig=_stations(problem, station, [mountings[i].rig_from_cam for i in mounting]),
        points=np.concatenate([problem.points, control_start(problem)]),
        observations=_observations(problem),
        pose_priors=_pose_priors(problem),
        position_priors=_position_priors(problem, station, mounting),
        point_priors=_point_priors(problem),
        antennas=tuple(Antenna(m.name, m.rig_from_cam.translation) for m in mountings),
        reference_rays=_reference_rays(problem.gcps),
    )


def _numbered(values: Iterable[Named]) -> tuple[Indices, list[Named]]:
    """The number of each value among the different ones, and these."""
    numbers: dict[Named, int] = {}
    found = [numbers.setdefault(value, len(numbers)) for value in values]
    return np.array(found, dtype=np.int64), list(numbers)


def _mountings(exposures: Sequence[Exposure | None]) -> tuple[Indices, tuple[RigCamera, ...]]:
    """The mounting of each image, and those in use; that of an image by itself stands at its camera, held."""
    index, names = _numbered(ALONE if e is None else e.mounting.camera for e in exposures)
    known = {e.mounting.camera: e.mounting for e in exposures if e is not None}
    return index, tuple(_rig_camera(name, known.get(name)) for name in names)


def _rig_camera(name: str, mounting: Mounting | None) -> RigCamera:
    return RigCamera(name, Rigid3.identity()) if mounting is None else RigCamera.of(mounting)


def _stations(problem: Problem, station: Indices, rig_from_cam: Sequence[Rigid3]) -> Poses:
    """Approximate stations: where the first image of each puts them."""
    first = np.unique(station, return_index=True)[1]
    return Poses.of(problem.world_from_cams[i] @ rig_from_cam[i].inverse() for i in first)


def _observations(problem: Problem) -> Observations:
    marks = control_observations(problem)
    return Observations.joined([problem.observations, marks.with_points(marks.point + len(problem.points))])


def _pose_priors(problem: Problem) -> PosePriors:
    """Localized poses of images."""
    given = [(i, p.world_from_cam, p.cov, KINDS_OF_POSE.index("localized")) for i, p in problem.pose_priors.items()]
    return PosePriors(
        np.array([row[0] for row in given], dtype=np.int64),
        Poses.of(row[1] for row in given),
        np.array([row[2] for row in given], dtype=np.float64).reshape(-1, 6, 6),
        np.array([row[3] for row in given], dtype=np.int64),
    )


def _position_priors(problem: Problem, station: Indices, mounting: Indices) -> PositionPriors:
    """Measured positions of projection centres: the camera's place on its rig is the lever arm."""
    images = np.array(list(problem.position_priors), dtype=np.int64)
    priors = list(problem.position_priors.values())
    return PositionPriors(
        station[images],
        np.array([p.position_in_world for p in priors], dtype=np.float64).reshape(-1, 3),
        np.array([p.cov for p in priors], dtype=np.float64).reshape(-1, 3, 3),
        mounting[images],
        np.full((len(images), 2), -1),
        np.zeros((len(images), 2)),
    )


def _reference_rays(gcps: AutomaticGcps) -> ReferenceRays | None:
    if not len(gcps):
        return None
    return ReferenceRays(gcps.point[gcps.ray_gcp], gcps.ray_reference, gcps.by_reference_pose, gcps.reference_errors)


def _point_priors(problem: Problem) -> PointPriors:
    gcps, control = problem.gcps, problem.control
    surveyed = np.arange(len(problem.points), len(problem.points) + len(control))
    of_control = np.array([c.information for c in control], dtype=np.float64).reshape(-1, 3, 3)
    kinds = [KINDS_OF_POINT.index("automatic")] * len(gcps) + [KINDS_OF_POINT.index("control")] * len(control)
    return PointPriors(
        np.concatenate([gcps.point, surveyed]),
        np.concatenate([gcps.position, np.array([c.point_in_world for c in control]).reshape(-1, 3)]),
        np.concatenate([np.asarray(np.linalg.inv(gcps.cov), dtype=np.float64).reshape(-1, 3, 3), of_control]),
        np.array(kinds, dtype=np.int64),
        (*(f"gcp {i}" for i in range(len(gcps))), *(c.point_id for c in control)),
    )
