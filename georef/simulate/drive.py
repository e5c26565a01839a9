"""A simulated drive of any size as a block of the adjustment, with exact truth and no images rendered.

Stations stand 3 to 5 m apart along a grid of streets with loops and streets driven again; points on facades, on the
road and on poles are seen in 3 to 8 images of 2 to 8 stations; see `drive_city`, `drive_tracks`, `drive_priors` and
`drive_blunders` for what is drawn. Everything follows from the seed; what is wrong can be changed without changing
anything else, so that a block and the one that lacks its blunders can be compared.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from georef.estimation.adjustment.block import Antenna, Block, Calibration, RigCamera, State
from georef.geometry.camera import Camera
from georef.geometry.poses import Poses
from georef.simulate.drive_blunders import DriveBlunders, Wrong, with_blunders, without
from georef.simulate.drive_city import Route, draw_route
from georef.simulate.drive_priors import DrivePriors, Given, draw_given
from georef.simulate.drive_rigs import ANTENNA_M, ESTIMATED, Cameras, cameras_of, mountings, rig_heads
from georef.simulate.drive_tracks import Tracks, draw_tracks
from georef.simulate.trajectory import SmoothProcess
from georef.types.scene import Observations

Treatment = Literal["held", "weighted"]
_SIGMA_OF_STEP = {"focal": 3e-4, "cx": 3e-4, "cy": 3e-4, "k1": 5e-4, "k2": 5e-4}
_MOUNTING_SIGMA = np.repeat([np.radians(0.02), 0.002], 3)
_LEVER_ARM_M = 0.01
_START_LENGTH_M, _START_WHITE = 40.0, 0.1  # correlation of the errors of approximate poses; white part of them


@dataclass(frozen=True)
class DriveDesign:
    """How large a drive is, and what is known of it.

    What is held is given without error, what is weighted with an error of the stated sigma. sigmas_px: of image
    coordinates, by level, as often one as the other.
    """

    stations: int = 1000
    cameras: Cameras = 5
    observations: int = 1_000_000
    sigmas_px: tuple[float, ...] = (0.5, 0.7, 1.0)
    calibrations: Treatment = "weighted"
    mountings: Treatment = "weighted"
    lever_arm: Treatment = "weighted"
    start_m: float = 0.3  # errors of approximate poses, smooth along the drive
    start_deg: float = 0.2
    priors: DrivePriors = field(default_factory=DrivePriors)
    seed: int = 0


@dataclass(frozen=True, eq=False)
class Drive:
    """A block, its exact values, and which of its rows are wrong.

    street (S,): passage of a street of each station. pose_reference, point_reference (K,): the group of reference
    images whose error localized poses and automatic control points share, -1 for surveyed points.
    """

    block: Block
    truth: State
    wrong: Wrong
    street: NDArray[np.int64]
    pose_reference: NDArray[np.int64]
    point_reference: NDArray[np.int64]

    def oracle(self) -> Block:
        """The block without its blunders."""
        return without(self.block, self.wrong)


def simulate_drive(design: DriveDesign, blunders: DriveBlunders | None = None) -> Drive:
    """The drive of a design, the same each time; 1 million observations take 6 CPU-seconds."""
    heads = rig_heads(design.cameras)
    route = draw_route(design.stations, _stream(design, "route"))
    rig_from_cam, cameras = mountings(heads), cameras_of(heads)
    tracks = draw_tracks(route, rig_from_cam, cameras, design.observations, _stream(design, "tracks"))
    images = np.arange(design.stations * design.cameras)
    world_from_cam = route.world_from_rig.take(images // design.cameras) @ rig_from_cam.take(images % design.cameras)
    given = draw_given(design.priors, route, world_from_cam, tracks.points, tracks.anchor, design.seed)
    lever_arms = np.array([ANTENNA_M])
    truth = State(route.world_from_rig, rig_from_cam, cameras, lever_arms, given.drift_m, tracks.points)
    block = _block(design, route, tracks, given, truth, tuple(head.name for head in heads))
    street_of_point = route.street[tracks.anchor[given.points.point]]
    block, wrong = with_blunders(block, street_of_point, route.street, blunders or DriveBlunders(), design.seed)
    return Drive(block, truth, wrong, route.street, given.pose_reference, given.point_reference)


def _stream(design: DriveDesign, name: str) -> np.random.Generator:
    return np.random.default_rng([design.seed, *b"drive", *name.encode()])


def _block(
    design: DriveDesign, route: Route, tracks: Tracks, given: Given, truth: State, names: tuple[str, ...]
) -> Block:
    stations = tuple(f"s{i:05d}" for i in range(design.stations))
    start = _approximate(design, route, _stream(design, "start"))
    moved = start.take(tracks.anchor) @ truth.world_from_rig.take(tracks.anchor).inverse()
    arm = route.world_from_rig.rotation[given.positions.station] @ np.array(ANTENNA_M)
    return Block(
        station_ids=stations,
        image_ids=tuple(f"{station}/{name}" for station in stations for name in names),
        station=np.repeat(np.arange(design.stations), design.cameras),
        mounting=np.tile(np.arange(design.cameras), design.stations),
        calibration=np.tile(np.arange(design.cameras), design.stations),
        mountings=_mountings(design, truth.rig_from_cam, names, _stream(design, "mountings")),
        calibrations=_calibrations(design, truth.cameras, _stream(design, "calibrations")),
        world_from_rig=start,
        points=moved.apply(tracks.points),
        observations=_observations(design, tracks, _stream(design, "noise")),
        pose_priors=given.poses,
        position_priors=replace(given.positions, position=given.positions.position + arm),
        relative_poses=given.motions,
        point_priors=given.points,
        antennas=(_antenna(design, _stream(design, "antenna")),) if design.priors.gnss else (),
        drift_information=np.tile(np.eye(3) / max(design.priors.drift_m, 1e-9) ** 2, (len(given.drift_m), 1, 1)),
    )


def _observations(design: DriveDesign, tracks: Tracks, rng: np.random.Generator) -> Observations:
    sigma = rng.choice(np.array(design.sigmas_px, dtype=np.float64), len(tracks.point))
    pixel = tracks.pixel + sigma[:, None] * rng.normal(size=tracks.pixel.shape)
    images = design.stations * design.cameras
    return Observations(tracks.point, tracks.image, pixel, sigma, _keypoints(tracks.image, images))


def _keypoints(image: NDArray[np.int64], images: int) -> NDArray[np.int64]:
    """A number (n,) of each observation in its image."""
    order = np.argsort(image, kind="stable")
    starts = np.concatenate([[0], np.cumsum(np.bincount(image, minlength=images))])[:-1]
    out = np.empty(len(image), np.int64)
    out[order] = np.arange(len(image)) - starts[image[order]]
    return out


def _approximate(design: DriveDesign, route: Route, rng: np.random.Generator) -> Poses:
    """Poses with smooth errors, and white ones a tenth as large."""
    sigma = np.repeat([np.radians(design.start_deg), design.start_m], 3)
    smooth = SmoothProcess.draw(rng, sigma, _START_LENGTH_M).at(route.s_m)
    return route.world_from_rig.retract(smooth + _START_WHITE * sigma * rng.normal(size=smooth.shape))


def _mountings(
    design: DriveDesign, rig_from_cam: Poses, names: tuple[str, ...], rng: np.random.Generator
) -> tuple[RigCamera, ...]:
    """The first is held in any case."""
    information = np.diag(1.0 / _MOUNTING_SIGMA**2)
    given = rig_from_cam.retract(_MOUNTING_SIGMA * rng.normal(size=(len(names), 6)))
    return tuple(
        RigCamera(name, rig_from_cam[i])
        if i == 0 or design.mountings == "held"
        else RigCamera(name, given[i], information)
        for i, name in enumerate(names)
    )


def _calibrations(
    design: DriveDesign, cameras: tuple[Camera, ...], rng: np.random.Generator
) -> tuple[Calibration, ...]:
    if design.calibrations == "held":
        return tuple(Calibration.held(camera) for camera in cameras)
    sigma = np.array([_SIGMA_OF_STEP[name] for name in ESTIMATED])
    information = np.diag(1.0 / sigma**2)
    return tuple(
        Calibration(
            replace(camera.changed(ESTIMATED, -sigma * rng.normal(size=len(sigma))), estimate=ESTIMATED), information
        )
        for camera in cameras
    )


def _antenna(design: DriveDesign, rng: np.random.Generator) -> Antenna:
    lever_arm = np.array(ANTENNA_M)
    if design.lever_arm == "held":
        return Antenna("roof", lever_arm)
    return Antenna("roof", lever_arm + _LEVER_ARM_M * rng.normal(size=3), np.eye(3) / _LEVER_ARM_M**2)
