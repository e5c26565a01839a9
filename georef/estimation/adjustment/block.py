"""A photogrammetric block: stations, rigs, calibrations, points, image observations and weighted constraints.

Everything stands in arrays, so that a campaign of tens of thousands of images and millions of observations fits in
memory and is linearised by vectorised kernels. The pose of an image is
world_from_rig[station] @ rig_from_cam[mounting]. All sigmas are those that the user stated or localization predicted;
check points have no place in it.

Unknowns, all as right perturbations or additive steps: stations (6 each: rotation rad, translation m), mountings that
are not held (6), named parameters of calibrations (steps of `Camera.changed`), lever arms that are not held (3, m, rig
frame), drift nodes (3, m, world), points (3, m).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from georef.estimation.reference_errors import ReferenceErrors
from georef.geometry.camera import Camera
from georef.geometry.poses import Poses
from georef.geometry.projection import Views
from georef.geometry.rigid import Array, Rigid3
from georef.types.campaign import Mounting
from georef.types.scene import Observations

Indices = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class RigCamera:
    """Where a camera sits on its rig: held where `information` is None, else an unknown with that as its weight.

    information: (6, 6), inverse covariance of rig_from_cam as a right perturbation; zeros: estimated freely. One
    camera of each rig must be held, or boresight trades off with attitude.
    """

    name: str
    rig_from_cam: Rigid3
    information: Array | None = None

    @staticmethod
    def of(mounting: Mounting) -> RigCamera:
        """Held, weighted or free, as its sigmas were stated."""
        if mounting.free:
            return RigCamera(mounting.camera, mounting.rig_from_cam, np.zeros((6, 6)))
        information = None if mounting.cov is None else np.asarray(np.linalg.inv(mounting.cov), dtype=np.float64)
        return RigCamera(mounting.camera, mounting.rig_from_cam, information)


@dataclass(frozen=True, eq=False)
class Calibration:
    """Interior orientation shared by images: `camera.estimate` names what is unknown, all else is held.

    information: (q, q), inverse covariance of the steps of these parameters about their given values; zeros: free.
    """

    camera: Camera
    information: Array

    @staticmethod
    def held(camera: Camera) -> Calibration:
        return Calibration(replace(camera, estimate=()), np.zeros((0, 0)))


@dataclass(frozen=True, eq=False)
class Antenna:
    """A GNSS antenna on a rig: held where `information` (3, 3) is None, else an unknown with that as its weight."""

    name: str
    lever_arm_m: Array  # (3,) in the rig frame
    information: Array | None = None


@dataclass(frozen=True, eq=False)
class PosePriors:
    """K given poses of images with covariances as right perturbations (localized poses, given orientations)."""

    image: Indices  # (K,)
    world_from_cam: Poses  # K
    cov: Array  # (K, 6, 6)
    kind: NDArray[np.int64]  # (K,) index in KINDS_OF_POSE

    def __len__(self) -> int:
        return len(self.image)

    @staticmethod
    def none() -> PosePriors:
        return PosePriors(_no_index(), Poses.identity(0), np.zeros((0, 6, 6)), _no_index())

    def take(self, keep: NDArray[np.bool_]) -> PosePriors:
        return PosePriors(self.image[keep], self.world_from_cam.take(keep), self.cov[keep], self.kind[keep])


KINDS_OF_POSE = ("localized", "orientation")


@dataclass(frozen=True, eq=False)
class PositionPriors:
    """K positions by GNSS of an antenna: world_from_rig(lever arm) + drift + error.

    The drift at an observation is drift_weight[:, 0] of drift node drift_node[:, 0] plus the same of column 1: constant
    for an epoch with weights (1, 0), piecewise linear in time between two nodes. Node -1: no drift.
    """

    station: Indices  # (K,)
    position: Array  # (K, 3) in world
    cov: Array  # (K, 3, 3)
    antenna: Indices  # (K,)
    drift_node: Indices  # (K, 2)
    drift_weight: Array  # (K, 2)

    def __len__(self) -> int:
        return len(self.station)

    @staticmethod
    def none() -> PositionPriors:
        zero = np.zeros
        return PositionPriors(
            _no_index(), zero((0, 3)), zero((0, 3, 3)), _no_index(), zero((0, 2), np.int64), zero((0, 2))
        )

    def take(self, keep: NDArray[np.bool_]) -> PositionPriors:
        return PositionPriors(
            self.station[keep],
            self.position[keep],
            self.cov[keep],
            self.antenna[keep],
            self.drift_node[keep],
            self.drift_weight[keep],
        )


@dataclass(frozen=True, eq=False)
class RelativePoses:
    """K measured motions between stations (IMU, trajectory): second_from_first is a_from_b with a, b below."""

    a: Indices  # (K,) station
    b: Indices  # (K,) station
    a_from_b: Poses  # K
    cov: Array  # (K, 6, 6) right perturbation

    def __len__(self) -> int:
        return len(self.a)

    @staticmethod
    def none() -> RelativePoses:
        return RelativePoses(_no_index(), _no_index(), Poses.identity(0), np.zeros((0, 6, 6)))

    def take(self, keep: NDArray[np.bool_]) -> RelativePoses:
        return RelativePoses(self.a[keep], self.b[keep], self.a_from_b.take(keep), self.cov[keep])


KINDS_OF_POINT = ("control", "automatic")


@dataclass(frozen=True, eq=False)
class PointPriors:
    """K given coordinates of points: surveyed control and automatic GCPs.

    information: (K, 3, 3), rank 3 of a full point, 2 of a horizontal one, 1 of a height. A point has one row at most.
    """

    point: Indices  # (K,)
    position: Array  # (K, 3) in world
    information: Array  # (K, 3, 3)
    kind: NDArray[np.int64]  # (K,) index in KINDS_OF_POINT
    point_ids: tuple[str, ...]  # K

    def __len__(self) -> int:
        return len(self.point)

    @staticmethod
    def none() -> PointPriors:
        return PointPriors(_no_index(), np.zeros((0, 3)), np.zeros((0, 3, 3)), _no_index(), ())

    def take(self, keep: NDArray[np.bool_]) -> PointPriors:
        names = tuple(name for name, kept in zip(self.point_ids, keep, strict=True) if kept)
        return PointPriors(self.point[keep], self.position[keep], self.information[keep], self.kind[keep], names)


@dataclass(frozen=True, eq=False)
class Distances:
    """K measured distances between points (scale bars, taped lengths)."""

    a: Indices  # (K,) point
    b: Indices  # (K,) point
    distance_m: Array  # (K,)
    sigma_m: Array  # (K,)

    def __len__(self) -> int:
        return len(self.a)

    @staticmethod
    def none() -> Distances:
        return Distances(_no_index(), _no_index(), np.zeros(0), np.zeros(0))

    def take(self, keep: NDArray[np.bool_]) -> Distances:
        return Distances(self.a[keep], self.b[keep], self.distance_m[keep], self.sigma_m[keep])


@dataclass(frozen=True, eq=False)
class ReferenceRays:
    """What automatic GCPs owe to the poses of R reference images, in n rays.

    The information of an automatic GCP holds for references that stand still; their own errors, which the GCPs of a
    reference share, enter covariances and gates, not the weights: a block stays tied to the reference as published.
    """

    point: Indices  # (n,) of the block
    reference: Indices  # (n,)
    by_reference_pose: Array  # (n, 3, 6) derivative of the given coordinates by the error of the reference
    errors: ReferenceErrors  # of the R references
    image_ids: tuple[str, ...] = ()  # names of the R references; none: nobody asks


@dataclass(frozen=True, eq=False)
class State:
    """Values of all unknowns of a block."""

    world_from_rig: Poses  # S
    rig_from_cam: Poses  # of all mountings, held ones included
    cameras: tuple[Camera, ...]  # of all calibrations
    lever_arms_m: Array  # (A, 3) of all antennas
    drift_m: Array  # (D, 3) of all drift nodes
    points: Array  # (P, 3)


@dataclass(frozen=True, eq=False)
class Block:
    """What an adjustment is given. S stations, M images, P points; index arrays refer to these."""

    station_ids: tuple[str, ...]
    image_ids: tuple[str, ...]
    station: Indices  # (M,) of each image
    mounting: Indices  # (M,)
    calibration: Indices  # (M,)
    mountings: tuple[RigCamera, ...]
    calibrations: tuple[Calibration, ...]
    world_from_rig: Poses  # S, approximate
    points: Array  # (P, 3) approximate
    observations: Observations  # of points; view is the index of an image
    pose_priors: PosePriors = field(default_factory=PosePriors.none)
    position_priors: PositionPriors = field(default_factory=PositionPriors.none)
    relative_poses: RelativePoses = field(default_factory=RelativePoses.none)
    point_priors: PointPriors = field(default_factory=PointPriors.none)
    distances: Distances = field(default_factory=Distances.none)
    antennas: tuple[Antenna, ...] = ()
    drift_information: Array = field(default_factory=lambda: np.zeros((0, 3, 3)))  # (D, 3, 3) about no drift
    reference_rays: ReferenceRays | None = None

    def start(self) -> State:
        """The approximate values as a state."""
        return State(
            self.world_from_rig,
            Poses.of(m.rig_from_cam for m in self.mountings),
            tuple(c.camera for c in self.calibrations),
            np.array([a.lever_arm_m for a in self.antennas], dtype=np.float64).reshape(-1, 3),
            np.zeros((len(self.drift_information), 3)),
            self.points,
        )

    def started(self, state: State) -> Block:
        """The same block with other approximate values of stations and points; what is given of the rest stays."""
        return replace(self, world_from_rig=state.world_from_rig, points=state.points)

    def world_from_cam(self, state: State) -> Poses:
        """Poses of all images."""
        return state.world_from_rig.take(self.station) @ state.rig_from_cam.take(self.mounting)

    def views(self, state: State) -> Views:
        """All images as views, for projection."""
        cam_from_world = self.world_from_cam(state).inverse()
        views = Views.of([], state.cameras)
        return Views(
            cam_from_world.rotation,
            cam_from_world.translation,
            views.model[self.calibration],
            views.parameters[self.calibration],
        )


def _no_index() -> Indices:
    return np.zeros(0, np.int64)
