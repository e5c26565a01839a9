"""A phone capture of the second epoch: pictures, depth with confidence, and a drifting visual-inertial trajectory.

The layout is that of LiDAR scanning apps: frame_*.json for every frame (pose row by row, camera to session, y up,
looking along -z; intrinsics of the full picture, centre of the top-left pixel at (0, 0)), depth_*.png in millimetres,
conf_*.png from 0 (guessed) to 2 (sure), pictures for some frames, info.json for the session.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from pyproj import Transformer

from georef.geometry.angles import IMAGE_FROM_CAM, rotation_z
from georef.geometry.rigid import Array, Rigid3, exp_so3
from georef.io.files import write_bytes_atomically, write_text_atomically
from georef.simulate import tables
from georef.simulate.photography import Photography
from georef.simulate.render import render
from georef.simulate.rigs import handheld_rigs
from georef.simulate.trajectory import Trajectory, drive, gauss_markov
from georef.simulate.world import CRS, StreetWorld

SESSION_FROM_ENU = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""Session axes (x east, y up, z south) of a session that was started looking north."""

_EPOCH = "second"
_JPEG_QUALITY = 92


@dataclass(frozen=True)
class Phone:
    """What a phone's sensors are worth."""

    depth_size: tuple[int, int] = (256, 192)  # width, height
    depth_noise_m: float = 0.004  # 1-sigma close by, and
    depth_noise_share: float = 0.008  # of the distance
    sure_m: float = 3.0  # depth is sure up to here,
    reach_m: float = 5.0  # and measured up to here
    yaw_drift_deg: float = 0.08  # 1-sigma of the walk of the heading, for the square root of a metre
    way_drift_m: float = 0.004  # 1-sigma of the walk of the position, for the square root of a metre
    scale_error: float = 0.004  # 1-sigma
    tilt_deg: float = 0.15  # gravity is known: no drift
    gps_sigma_m: float = 5.0
    spacing_m: float = 0.4
    pictures_every: int = 3
    frames: int = 40
    scale: float = 1.0  # of the pictures' resolution


@dataclass(frozen=True, eq=False)
class Session:
    """The frames of a capture: true poses, and those of the phone's own tracking."""

    trajectory: Trajectory
    world_from_cams: tuple[Rigid3, ...]
    session_from_cams: tuple[Rigid3, ...]


def session(world: StreetWorld, phone: Phone) -> Session:
    """A walk along the street, and what the phone believes of it."""
    rig = next(rig for rig in handheld_rigs(phone.scale) if rig.name == "phone")
    walked = drive(world.street.axis, replace(rig, spacing_m=phone.spacing_m), world.rng("capture"))
    some = slice(0, phone.frames)
    walked = replace(
        walked, s_m=walked.s_m[some], time_s=walked.time_s[some], world_from_rigs=walked.world_from_rigs[some]
    )
    truth = tuple(pose @ rig.heads[0].rig_from_cam for pose in walked.world_from_rigs)
    return Session(walked, truth, tracked(truth, phone, world.rng("tracking")))


def tracked(world_from_cams: tuple[Rigid3, ...], phone: Phone, rng: np.random.Generator) -> tuple[Rigid3, ...]:
    """session_from_cam by visual-inertial tracking: it starts at zero, and heading, position and scale drift."""
    positions = np.array([pose.translation for pose in world_from_cams])
    forward = world_from_cams[0].rotation[:, 2]
    session_from_world = SESSION_FROM_ENU @ rotation_z(float(np.arctan2(forward[0], forward[1])))
    steps = np.diff(positions, axis=0)
    lengths = np.sqrt(np.linalg.norm(steps, axis=1))
    yaw = np.radians(phone.yaw_drift_deg) * np.cumsum(np.append(0.0, lengths * rng.normal(size=len(steps))))
    way = phone.way_drift_m * lengths[:, None] * rng.normal(size=steps.shape)
    scale = 1.0 + phone.scale_error * rng.normal()
    walked = np.concatenate([np.zeros(1), np.cumsum(np.linalg.norm(steps, axis=1))])
    tilt = gauss_markov(walked, np.radians([phone.tilt_deg, phone.tilt_deg, 0.0]), 5.0, rng)
    out, position = [], np.zeros(3)
    for i, pose in enumerate(world_from_cams):
        if i:
            position = position + scale * rotation_z(yaw[i - 1]) @ steps[i - 1] + way[i - 1]
        rotation = exp_so3(tilt[i]) @ rotation_z(yaw[i]) @ pose.rotation
        out.append(Rigid3(session_from_world @ rotation, session_from_world @ position))
    return tuple(out)


def write_capture(world: StreetWorld, folder: Path, truth_folder: Path, phone: Phone | None = None) -> Session:
    """Writes a capture and, elsewhere, its exact exterior orientation; frames that are there are kept."""
    phone = phone or Phone()
    walk = session(world, phone)
    for index in range(len(walk.world_from_cams)):
        if not (folder / f"{_name(index)}.json").is_file():
            _write_frame(world, walk, index, phone, folder)
    write_text_atomically(json.dumps(_info(world, walk, phone), indent=1) + "\n", folder / "info.json")
    poses = {f"{_name(i)}.jpg": pose for i, pose in enumerate(walk.world_from_cams)}
    text = tables.orientation_table(poses, {}, world.frame)
    write_text_atomically(text, truth_folder / "capture_eo.csv")
    return walk


def _name(index: int) -> str:
    return f"frame_{index:05d}"


def _write_frame(world: StreetWorld, walk: Session, index: int, phone: Phone, folder: Path) -> None:
    """Depth, confidence, picture; the description last, which says that the frame is complete."""
    folder.mkdir(parents=True, exist_ok=True)
    depth_mm, confidence = depth(world, walk, index, phone)
    _write_png(depth_mm, folder / f"depth_{index:05d}.png")
    _write_png(confidence, folder / f"conf_{index:05d}.png")
    if index % phone.pictures_every == 0:
        lens = walk.trajectory.rig.lenses["phone"]
        seed = int(world.rng("capture", str(index)).integers(2**31))
        picture = render(world.scene(_EPOCH), lens, walk.world_from_cams[index], Photography(seed=seed))
        bgr = cv2.cvtColor(picture, cv2.COLOR_RGB2BGR)
        _write(cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])[1], folder / f"{_name(index)}.jpg")
    write_text_atomically(json.dumps(_frame(walk, index)) + "\n", folder / f"{_name(index)}.json")


def depth(world: StreetWorld, walk: Session, index: int, phone: Phone) -> tuple[NDArray[np.uint16], NDArray[np.uint8]]:
    """Depth along the optical axis in mm, 0 where there is none, and confidence 0 to 2, (height, width) each."""
    lens, pose = walk.trajectory.rig.lenses["phone"], walk.world_from_cams[index]
    width, height = phone.depth_size
    x, y = np.meshgrid((np.arange(width) + 0.5) / width * lens.width, (np.arange(height) + 0.5) / height * lens.height)
    rays = lens.rays(np.column_stack([x.ravel(), y.ravel()]))
    hits = world.scene(_EPOCH).cast(pose.translation, rays @ pose.rotation.T)
    exact = (hits.distance_m * rays[:, 2]).reshape(height, width)
    rng = world.rng("depth", str(index))
    there = exact < phone.reach_m
    near = np.where(there, exact, 0.0)
    measured = near + (phone.depth_noise_m + phone.depth_noise_share * near) * rng.normal(size=near.shape)
    slope = np.hypot(*np.gradient(near))
    confidence = np.where(there & (slope < 0.05 * near), 1, 0) + np.where(near < phone.sure_m, 1, 0)
    confidence[~there | (slope > 0.2 * near)] = 0  # nothing, or an edge
    return np.where(there, np.round(1000.0 * measured), 0).astype(np.uint16), confidence.astype(np.uint8)


def _frame(walk: Session, index: int) -> dict[str, Any]:
    camera = walk.trajectory.rig.lenses["phone"].camera
    assert camera is not None
    pose = walk.session_from_cams[index]
    matrix = Rigid3(pose.rotation @ IMAGE_FROM_CAM, pose.translation).matrix()
    intrinsics = [camera.fx, 0.0, camera.cx - 0.5, 0.0, camera.fy, camera.cy - 0.5, 0.0, 0.0, 1.0]
    return {
        "frame_index": index,
        "time": float(walk.trajectory.time_s[index]),
        "cameraPoseARFrame": matrix.ravel().tolist(),
        "intrinsics": intrinsics,
        "motionQuality": 1,
    }


def _info(world: StreetWorld, walk: Session, phone: Phone) -> dict[str, Any]:
    """The session, with a position of the start by the phone's GPS."""
    noise = phone.gps_sigma_m * world.rng("gps").normal(size=3)
    start = world.frame.crs_from_world((walk.world_from_cams[0].translation + noise)[None])[0]
    to_lonlat = Transformer.from_crs(CRS.horizontal, "EPSG:4258", always_xy=True)
    longitude, latitude = to_lonlat.transform(start[0], start[1])
    return {
        "title": "street",
        "numImages": len(walk.world_from_cams),
        "gpsLongitude": longitude,
        "gpsLatitude": latitude,
        "gpsAltitude": float(start[2]),
        "gpsHorizontalAccuracy": phone.gps_sigma_m,
    }


def _write_png(image: Array | NDArray[np.integer], path: Path) -> None:
    _write(cv2.imencode(".png", image)[1], path)


def _write(data: NDArray[np.uint8], path: Path) -> None:
    write_bytes_atomically(data.tobytes(), path)
