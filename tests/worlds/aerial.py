"""A small flight with exact truth, written as the project of a block: measurements, RTK positions, surveyed points."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from georef.geometry.camera import Camera, project
from georef.geometry.poses import Poses, exp_so3
from georef.geometry.rigid import Array
from georef.io.bingo import BingoTable, mm_from_pixels, write_bingo

CAMERA = Camera("c", 4000, 3000, 4100.0, 4100.0, 2010.0, 1490.0, (-0.05, 0.02, 0.0005, -0.0003, 0.0))
SENSOR_MM = (20.0, 15.0)
RTK_M, SURVEYED_M, TIE_PX, MARK_PX = np.array([0.02, 0.02, 0.03]), np.array([0.01, 0.01, 0.02]), 0.7, 0.3

_PROJECT = """name = "flight"
[crs]
horizontal = "local"
[blocks.flight]
cameras = "camera.csv"
control = {control}
{more}
[blocks.flight.observations]
format = "bingo"
file = "points.txt"
sensor_mm = [20.0, 15.0]
sigma_px = 1.0
mark_prefix = "GCP_"
mark_sigma_px = 0.3
[blocks.flight.gnss]
file = "rtk.csv"
{gnss}
[points]
coordinates = "surveyed.csv"
check_kind = "absolute"
"""


@dataclass(frozen=True, eq=False)
class Flight:
    """world_from_cam of M images, P tie points, K surveyed points, and the offset of the RTK positions."""

    world_from_cam: Poses
    points: Array
    surveyed: Array
    offset_m: Array


def flight(seed: int = 0, *, offset_m: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Flight:
    """Four strips of seven photographs, 60 to 75 m above hilly ground, tilted by two degrees, each strip turned."""
    rng = np.random.default_rng(seed)
    rows = [(12.0 * i, 18.0 * k, 60.0 + 5.0 * k) for k in range(4) for i in range(7)]
    positions = np.array(rows) + rng.normal(size=(len(rows), 3))
    heading = np.radians([25.0 + 180.0 * (k % 2) for k in range(4) for _ in range(7)])
    right = np.stack([np.cos(heading), np.sin(heading), np.zeros(len(rows))], axis=1)
    forward = np.tile([0.0, 0.0, -1.0], (len(rows), 1))
    level = np.stack([right, np.cross(forward, right), forward], axis=2)
    rotations = level @ exp_so3(np.radians(2.0) * rng.normal(size=(len(rows), 3)))
    return Flight(Poses(rotations, positions), _ground(rng, 400), _ground(rng, 8), np.array(offset_m, dtype=np.float64))


def write_flight(
    made: Flight, folder: Path, *, seed: int = 1, control: str = '"all"', more: str = "", gnss: str = ""
) -> Path:
    """The project with noise; control, more, gnss: what project.toml says of them."""
    rng = np.random.default_rng(seed)
    folder.mkdir(parents=True, exist_ok=True)
    _write_measurements(made, folder / "points.txt", rng)
    antenna = made.world_from_cam.translation + made.offset_m + RTK_M * rng.normal(size=(len(made.world_from_cam), 3))
    _write_table(folder / "rtk.csv", "image", [f"i{k}.JPG" for k in range(len(antenna))], antenna, RTK_M)
    surveyed = made.surveyed + SURVEYED_M * rng.normal(size=made.surveyed.shape)
    _write_table(folder / "surveyed.csv", "point", [f"P{k}" for k in range(len(surveyed))], surveyed, SURVEYED_M)
    (folder / "camera.csv").write_text(
        "camera,width,height,fx,fy,cx,cy,estimate\nc,4000,3000,4000,4000,2000,1500,focal cx cy k1 k2 p1 p2\n",
        encoding="utf-8",
    )
    (folder / "project.toml").write_text(_PROJECT.format(control=control, more=more, gnss=gnss), encoding="utf-8")
    return folder


def _ground(rng: np.random.Generator, count: int) -> Array:
    plan = rng.uniform([-5.0, -5.0], [77.0, 59.0], (count, 2))
    return np.column_stack([plan, 4.0 * np.sin(plan[:, 0] / 9.0) + 3.0 * np.cos(plan[:, 1] / 7.0)])


def _write_measurements(made: Flight, path: Path, rng: np.random.Generator) -> None:
    names = [str(k) for k in range(len(made.points))] + [f"GCP_P{k}" for k in range(len(made.surveyed))]
    everything = np.concatenate([made.points, made.surveyed])
    sigma = np.where(np.arange(len(everything)) < len(made.points), TIE_PX, MARK_PX)
    image, point, pixels = [], [], []
    for k, pose in enumerate(made.world_from_cam.to_list()):
        px = project(CAMERA, pose.inverse().apply(everything)) + sigma[:, None] * rng.normal(size=(len(everything), 2))
        seen = np.flatnonzero(((px > 0) & (px < [CAMERA.width, CAMERA.height])).all(axis=1))
        image.append(np.full(len(seen), k))
        point.append(seen)
        pixels.append(px[seen])
    xy = mm_from_pixels(np.concatenate(pixels), (CAMERA.width, CAMERA.height), SENSOR_MM)
    count = len(made.world_from_cam)
    ids, rows = tuple(f"i{k}" for k in range(count)), np.zeros(0, np.int64)
    table = BingoTable(
        path, ids, ("c",) * count, rows, tuple(names), np.concatenate(image), np.concatenate(point), xy, rows
    )
    write_bingo(table, path)


def _write_table(path: Path, key: str, names: list[str], positions: Array, sigmas: Array) -> None:
    lines = [f"{key},x,y,z,sigma_x,sigma_y,sigma_z"]
    for name, position in zip(names, positions, strict=True):
        lines.append(",".join([name, *(f"{v:.4f}" for v in position), *map(str, sigmas)]))
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
