"""A small block with every kind of constraint: six stations of a two-camera rig drive through a street.

Two rows of points on facades to the left and right, control of three kinds, GNSS with a lever arm and drift, localized
poses, measured motions, a scale bar, and unknown boresight, focal length and k1. The truth is exact; what is observed
and given carries noise of the stated size.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from georef.estimation.adjustment.block import (
    Antenna,
    Block,
    Calibration,
    Distances,
    Indices,
    PointPriors,
    PosePriors,
    PositionPriors,
    RelativePoses,
    RigCamera,
    State,
)
from georef.estimation.adjustment.equations.block_equations import moved_state
from georef.estimation.adjustment.equations.reduced import Layout
from georef.geometry.camera import Camera
from georef.geometry.poses import Poses
from georef.geometry.projection import Views
from georef.geometry.rigid import Array, Rigid3, exp_so3
from georef.types.scene import Observations

STATIONS, POINTS = 6, 60
SIGMA_PX, SIGMA_GNSS_M, SIGMA_CONTROL_M = 0.5, 0.02, 0.005
SIGMA_POSE = np.array([0.002] * 3 + [0.03] * 3)
SIGMA_MOTION = np.array([0.0005] * 3 + [0.005] * 3)
SIGMA_MOUNTING = np.array([0.005] * 3 + [0.01] * 3)
SIGMA_CAMERA = np.array([0.01, 0.01])
LEFT = Camera("left", 3000, 2000, 1500.0, 1504.0, 1490.0, 1010.0, (-0.05, 0.01, 2e-4, -1e-4), estimate=("focal", "k1"))
RIGHT = Camera("right", 2400, 2400, 700.0, 702.0, 1204.0, 1195.0, (0.01, -2e-3), "fisheye", ("focal", "k1"))
_FORWARD_NORTH = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])


@dataclass(frozen=True, eq=False)
class RigBlock:
    block: Block  # as it is given, at disturbed approximate values
    truth: State


def rig_block(seed: int = 0, cameras: tuple[Camera, Camera] = (LEFT, RIGHT), disturbed: float = 1.0) -> RigBlock:
    """The block with noise of a seed; `cameras` are the given ones, wrong by their sigma; disturbed: how far the
    approximate values are from the truth, 1: 0.02 rad, 0.2 m, points 0.1 m."""
    rng = np.random.default_rng(seed)
    given = _mountings()
    truth = State(
        world_from_rig=_stations(rng),
        rig_from_cam=Poses.of(
            [given[0].rig_from_cam, given[1].rig_from_cam.retract(SIGMA_MOUNTING * rng.normal(size=6))]
        ),
        cameras=tuple(_true_camera(c, rng) for c in cameras),
        lever_arms_m=np.array([[0.1, -1.5, 0.2], [0.3, -1.2, -0.4] + 0.02 * rng.normal(size=3)]),
        drift_m=0.03 * rng.normal(size=(2, 3)),
        points=np.zeros((0, 3)),
    )
    truth = replace(truth, points=_points(truth, rng))
    start = 0.02 * disturbed * np.array([1.0, 1.0, 1.0, 10.0, 10.0, 10.0])
    block = Block(
        station_ids=tuple(f"s{i}" for i in range(STATIONS)),
        image_ids=tuple(f"s{i}/{camera.camera_id}" for i in range(STATIONS) for camera in cameras),
        station=np.repeat(np.arange(STATIONS), 2),
        mounting=np.tile([0, 1], STATIONS),
        calibration=np.tile([0, 1], STATIONS),
        mountings=given,
        calibrations=tuple(_calibration(c) for c in cameras),
        world_from_rig=truth.world_from_rig.retract(start * rng.normal(size=(STATIONS, 6))),
        points=truth.points + 0.1 * disturbed * rng.normal(size=(POINTS, 3)),
        observations=Observations.joined([]),
        antennas=(
            Antenna("roof", truth.lever_arms_m[0]),
            Antenna("mast", np.array([0.3, -1.2, -0.4]), np.eye(3) / 4e-4),
        ),
        drift_information=np.stack([np.eye(3) / 0.03**2, np.zeros((3, 3))]),
    )
    return RigBlock(_constrained(_observed(block, truth, rng), truth, rng), truth)


def _mountings() -> tuple[RigCamera, RigCamera]:
    """Left camera held, looking forward and to the left; the right one to the right, beyond its neighbour."""
    left, right = exp_so3([0.0, -0.9, 0.0]), exp_so3([0.1, 0.9, 0.0])
    information = np.diag(1.0 / SIGMA_MOUNTING**2)
    return (
        RigCamera("left", Rigid3(left, np.array([-0.4, 0.1, 0.2]))),
        RigCamera("right", Rigid3(right, np.array([0.5, -0.1, 0.3])), information),
    )


def _calibration(camera: Camera) -> Calibration:
    sigma = np.resize(SIGMA_CAMERA, len(camera.estimate))
    return Calibration(camera, np.diag(1.0 / sigma**2))


def _true_camera(given: Camera, rng: np.random.Generator) -> Camera:
    return given.changed(
        given.estimate, np.resize(SIGMA_CAMERA, len(given.estimate)) * rng.normal(size=len(given.estimate))
    )


def _stations(rng: np.random.Generator) -> Poses:
    along = 2.0 * np.arange(STATIONS)
    centres = np.array([0.3 * np.sin(along), along, 2.0 + 0.1 * np.cos(along)], dtype=np.float64).T
    turned = Poses.exp(np.concatenate([0.1 * rng.normal(size=(STATIONS, 3)), np.zeros((STATIONS, 3))], axis=1))
    return Poses(_FORWARD_NORTH @ turned.rotation, centres)


def _points(truth: State, rng: np.random.Generator) -> Array:
    """Points of facades to the left and right by turns, each in sight of two stations at least."""
    side = np.where(np.arange(10 * POINTS) % 2 == 0, -1.0, 1.0)
    across, along, up = (
        side * rng.uniform(5.0, 9.0, len(side)),
        rng.uniform(1.0, 18.0, len(side)),
        rng.uniform(0.0, 8.0, len(side)),
    )
    points = np.stack([across, along, up], axis=1)
    view, point, _ = _seen(truth, points)
    seen = np.zeros((len(points), STATIONS), bool)
    seen[point, view // 2] = True
    often = seen.sum(axis=1) >= 2
    chosen = [np.flatnonzero(often & (side == s))[: POINTS // 2] for s in (-1.0, 1.0)]
    return points[np.stack(chosen, axis=1).ravel()]


def _seen(truth: State, points: Array) -> tuple[Indices, Indices, Array]:
    """Views (n,), points (n,) and exact pixels (n, 2) of all that images show; two images a station."""
    images = np.arange(2 * STATIONS)
    poses = truth.world_from_rig.take(images // 2) @ truth.rig_from_cam.take(images % 2)
    views = Views.of(poses.to_list(), [truth.cameras[i % 2] for i in images])
    view, point = (a.ravel() for a in np.meshgrid(images, np.arange(len(points)), indexing="ij"))
    pixel = views.project(view, points[point])
    size = np.array([[c.width, c.height] for c in truth.cameras])[view % 2]
    with np.errstate(invalid="ignore"):
        shown = ((pixel > 0) & (pixel < size)).all(axis=1)
    return view[shown], point[shown], pixel[shown]


def _observed(block: Block, truth: State, rng: np.random.Generator) -> Block:
    view, point, pixel = _seen(truth, truth.points)
    pixel = pixel + SIGMA_PX * rng.normal(size=pixel.shape)
    observations = Observations(point, view, pixel, np.full(len(view), SIGMA_PX), np.arange(len(view)))
    return replace(block, observations=observations)


def _constrained(block: Block, truth: State, rng: np.random.Generator) -> Block:
    return replace(
        block,
        pose_priors=_pose_priors(block, truth, rng),
        position_priors=_positions(truth, rng),
        relative_poses=_motions(truth, rng),
        point_priors=_control(truth, rng),
        distances=Distances(
            np.array([0, 7]),
            np.array([3, 0]),
            np.linalg.norm(truth.points[[0, 7]] - truth.points[[3, 0]], axis=1) + 0.002 * rng.normal(size=2),
            np.full(2, 0.002),
        ),
    )


def _pose_priors(block: Block, truth: State, rng: np.random.Generator) -> PosePriors:
    image = np.array([1, 4, 9])
    shape = np.eye(6) + 0.2 * np.tri(6)  # correlated
    root = SIGMA_POSE[:, None] * shape
    given = block.world_from_cam(truth).take(image).retract(rng.normal(size=(3, 6)) @ root.T)
    return PosePriors(image, given, np.tile(root @ root.T, (3, 1, 1)), np.array([0, 1, 0]))


def _positions(truth: State, rng: np.random.Generator) -> PositionPriors:
    """Both antennas at every station: the roof one drifts linearly between two nodes, the mast one not at all."""
    station = np.repeat(np.arange(STATIONS), 2)
    antenna = np.tile([0, 1], STATIONS)
    late = station / (STATIONS - 1.0)
    node = np.where(antenna[:, None] == 0, [0, 1], [-1, -1])
    weight = np.where(antenna[:, None] == 0, np.stack([1.0 - late, late], axis=1), 0.0)
    drift = np.einsum("kn,kni->ki", weight, truth.drift_m[np.maximum(node, 0)])
    exact = truth.world_from_rig.take(station).apply(truth.lever_arms_m[antenna]) + drift
    root = SIGMA_GNSS_M * (np.eye(3) + 0.3 * np.tri(3))
    position = exact + rng.normal(size=exact.shape) @ root.T
    return PositionPriors(station, position, np.tile(root @ root.T, (len(station), 1, 1)), antenna, node, weight)


def _motions(truth: State, rng: np.random.Generator) -> RelativePoses:
    a, b = np.array([0, 3]), np.array([1, 5])
    exact = truth.world_from_rig.take(a).inverse() @ truth.world_from_rig.take(b)
    root = SIGMA_MOTION[:, None] * (np.eye(6) + 0.1 * np.tri(6))
    return RelativePoses(a, b, exact.retract(rng.normal(size=(2, 6)) @ root.T), np.tile(root @ root.T, (2, 1, 1)))


def _control(truth: State, rng: np.random.Generator) -> PointPriors:
    """Two full points, two horizontal ones and two heights."""
    point = np.array([0, 11, 22, 33, 44, 55])
    axes = np.array([[1, 1, 1], [1, 1, 1], [1, 1, 0], [1, 1, 0], [0, 0, 1], [0, 0, 1]], dtype=np.float64)
    position = truth.points[point] + SIGMA_CONTROL_M * rng.normal(size=(6, 3))
    information = axes[:, :, None] * np.eye(3) / SIGMA_CONTROL_M**2
    return PointPriors(point, position, information, np.zeros(6, np.int64), tuple(f"GCP{i}" for i in range(6)))


def moved(block: Block, state: State, step: Array, points: Array | None = None) -> State:
    """The state after a step (6 S + border,) of the reduced unknowns, and steps (P, 3) of the points."""
    after = moved_state(Layout.of(block), state, step)
    return after if points is None else replace(after, points=after.points + points)
