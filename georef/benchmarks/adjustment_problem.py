"""The problem that adjustments are compared on: a simulated drive with poses and points free and a datum both know.

Every fiftieth station is held where it truly is, which fixes the datum; mountings are held, calibrations held or free.
All observations count alike, because pycolmap knows no sigmas of its own. Arrays lie in a file, so that a process that
adjusts is not charged for the simulation.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from georef.estimation.adjustment.block import Block, Calibration, Indices, PosePriors, RigCamera, State
from georef.geometry.camera import Camera
from georef.geometry.poses import Poses
from georef.geometry.rigid import Array
from georef.simulate.drive import DriveDesign, simulate_drive
from georef.simulate.drive_priors import DrivePriors
from georef.simulate.drive_rigs import ESTIMATED, Cameras, cameras_of, mountings, rig_heads
from georef.types.scene import Observations

HELD_EACH = 50
_HELD_SIGMA = np.repeat([1e-8, 1e-6], 3)  # rad, m: against millimetres that the images want to move them by
_START_M, _START_DEG = 0.1, 0.1
_NO_PRIORS = DrivePriors(gnss=False, poses=0.0, points=0.0, control=0)
_FILE, TRUTH_FILE = "problem.npz", "truth.npy"  # the latter: positions of stations (S, 3)


@dataclass(frozen=True)
class Size:
    """What is adjusted."""

    stations: int
    cameras: Cameras
    observations: int
    free_calibrations: bool = False
    seed: int = 0

    @property
    def held(self) -> Indices:
        """Stations whose poses are known."""
        return np.unique(np.r_[np.arange(0, self.stations, HELD_EACH), self.stations - 1])


def write_problem(folder: Path, size: Size) -> None:
    """Simulates the drive and leaves its arrays in the folder."""
    design = DriveDesign(
        *(size.stations, size.cameras, size.observations),
        sigmas_px=(1.0,),
        calibrations="weighted" if size.free_calibrations else "held",
        mountings="held",
        lever_arm="held",
        start_m=_START_M,
        start_deg=_START_DEG,
        priors=_NO_PRIORS,
        seed=size.seed,
    )
    drive = simulate_drive(design)
    block, true = drive.block, drive.truth.world_from_rig
    rotation, translation = block.world_from_rig.rotation.copy(), block.world_from_rig.translation.copy()
    np.save(folder / TRUTH_FILE, true.translation)
    rotation[size.held], translation[size.held] = true.rotation[size.held], true.translation[size.held]
    np.savez(
        folder / _FILE,
        rotation=rotation,
        translation=translation,
        points=block.points,
        point=block.observations.point,
        view=block.observations.view,
        pixel=block.observations.pixel,
        cameras=np.array([c.camera.parameters for c in block.calibrations]),
    )


def read_problem(folder: Path, size: Size) -> Block:
    """The block of a folder."""
    with np.load(folder / _FILE, allow_pickle=False) as arrays:
        held = {name: arrays[name] for name in arrays.files}
    heads, images = rig_heads(size.cameras), np.arange(size.stations * size.cameras)
    rig_from_cam, station = mountings(heads), images // size.cameras
    start = Poses(held["rotation"], held["translation"])
    n = len(held["point"])
    return Block(
        station_ids=tuple(f"s{i:05d}" for i in range(size.stations)),
        image_ids=tuple(f"s{i:05d}/{head.name}" for i in range(size.stations) for head in heads),
        station=station,
        mounting=images % size.cameras,
        calibration=images % size.cameras,
        mountings=tuple(RigCamera(h.name, p) for h, p in zip(heads, rig_from_cam.to_list(), strict=True)),
        calibrations=tuple(
            _calibration(camera, row, size.free_calibrations)
            for camera, row in zip(cameras_of(heads), held["cameras"], strict=True)
        ),
        world_from_rig=start,
        points=held["points"],
        observations=Observations(held["point"], held["view"], held["pixel"], np.ones(n), np.full(n, -1)),
        pose_priors=_datum(start, rig_from_cam, size),
    )


def _calibration(camera: Camera, row: Array, free: bool) -> Calibration:
    fx, fy, cx, cy = row[:4]
    changed = replace(camera, fx=fx, fy=fy, cx=cx, cy=cy, distortion=tuple(float(v) for v in row[4:8]))
    if not free:
        return Calibration.held(changed)
    return Calibration(replace(changed, estimate=ESTIMATED), np.zeros((len(ESTIMATED), len(ESTIMATED))))


def _datum(start: Poses, rig_from_cam: Poses, size: Size) -> PosePriors:
    poses = start.take(size.held) @ rig_from_cam.take(np.zeros(len(size.held), np.int64))
    cov = np.tile(np.diag(_HELD_SIGMA**2), (len(size.held), 1, 1))
    return PosePriors(size.held * size.cameras, poses, cov, np.zeros(len(size.held), np.int64))


def image_cost(block: Block, state: State, chunk: int = 500_000) -> float:
    """Half the sum of squared image residuals over their sigmas, in chunks."""
    views, seen, total = block.views(state), block.observations, 0.0
    for begin in range(0, len(seen), chunk):
        part = slice(begin, begin + chunk)
        pixel = views.project(seen.view[part], state.points[seen.point[part]])
        total += 0.5 * float(np.square((pixel - seen.pixel[part]) / seen.sigma_px[part, None]).sum())
    return total
