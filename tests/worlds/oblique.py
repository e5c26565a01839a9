"""A small flight with a rig of five cameras, one down and four at 45 degrees, with exact truth, written as a project.

40 exposures in four strips at 80 m above hilly ground. The tables are those of a survey: measurements in the BINGO
format or Pix4D's own, positions of the antenna, a table of mountings as the maker states them, attitudes to start from.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from georef.geometry.angles import omega_phi_kappa_from_rotation
from georef.geometry.camera import Camera, project
from georef.geometry.poses import Poses
from georef.geometry.poses import exp_so3 as exp_many
from georef.geometry.rigid import Array, Rigid3, exp_so3
from georef.io.bingo import BingoTable, mm_from_pixels, write_bingo
from georef.io.pix4d_ties import write_pix4d_ties

NAMES = ("N", "F", "B", "L", "R")  # down, forward, back, left, right
SENSOR_MM = (15.0, 10.0)
LEVER_M = np.array([0.05, -0.10, -0.30])
GNSS_M, SURVEYED_M = np.array([0.02, 0.02, 0.03]), np.array([0.01, 0.01, 0.015])
TIE_PX, MARK_PX = 0.6, 0.3
_TILT = np.radians(45.0)
_NOMINAL = {  # turns of the camera from looking down: about its x axis, then its y axis
    "N": (0.0, 0.0),
    "F": (_TILT, 0.0),
    "B": (-_TILT, 0.0),
    "L": (0.0, -_TILT),
    "R": (0.0, _TILT),
}
_PROJECT = """name = "oblique"
[crs]
horizontal = "local"
[blocks.flight]
cameras = "camera.csv"
camera_pattern = '^([A-Z])_'
control = {control}
{attitude}
{more}
[blocks.flight.observations]
format = "{form}"
file = "points.txt"
sigma_px = 0.6
mark_prefix = "GCP_"
mark_sigma_px = 0.3
{rig}
[blocks.flight.gnss]
file = "gnss.csv"
{gnss}
[points]
coordinates = "surveyed.csv"
check_kind = "absolute"
"""


@dataclass(frozen=True, eq=False)
class Oblique:
    """world_from_rig of S stations, mountings and cameras of five, P tie points, K surveyed points."""

    world_from_rig: Poses
    rig_from_cam: dict[str, Rigid3]
    cameras: dict[str, Camera]
    points: Array
    surveyed: Array

    @property
    def image_ids(self) -> tuple[str, ...]:
        return tuple(f"{name}_{s:03d}" for s in range(len(self.world_from_rig)) for name in NAMES)

    def world_from_cam(self, image_id: str) -> Rigid3:
        return self.world_from_rig[int(image_id[2:])] @ self.rig_from_cam[image_id[0]]


def nominal(name: str) -> Rigid3:
    """The mounting as the maker of the rig states it."""
    about_x, about_y = _NOMINAL[name]
    place = {"N": (0.0, 0.0), "F": (0.0, -0.15), "B": (0.0, 0.15), "L": (-0.15, 0.0), "R": (0.15, 0.0)}[name]
    return Rigid3(exp_so3(np.array([about_x, about_y, 0.0])), np.array([*place, 0.02]))


def oblique(seed: int = 0, strips: int = 4, along: int = 10) -> Oblique:
    """The truth of a seed: mountings 0.3 deg and 1 cm off the maker's, lenses of their own."""
    rng = np.random.default_rng(seed)
    count = strips * along
    strip, place = np.divmod(np.arange(count), along)
    places = np.stack([25.0 * place, 35.0 * strip, np.full(count, 80.0)], axis=1) + rng.normal(size=(count, 3))
    turn = np.pi * (strip % 2) + np.radians(10.0)
    right = np.stack([np.sin(turn), -np.cos(turn), np.zeros(count)], axis=1)
    down = np.tile([0.0, 0.0, -1.0], (count, 1))
    level = np.stack([right, np.cross(down, right), down], axis=2)
    rotation = level @ exp_many(np.radians(1.5) * rng.normal(size=(count, 3)))
    sigma = np.array([*[np.radians(0.3)] * 3, *[0.01] * 3])
    mountings = {name: nominal(name).retract(sigma * rng.normal(size=6) * (name != "N")) for name in NAMES}
    size = np.array([25.0 * (along - 1), 35.0 * (strips - 1)])
    mountings["N"] = Rigid3.identity()
    cameras = {name: _camera(name, rng) for name in NAMES}
    return Oblique(Poses(rotation, places), mountings, cameras, _ground(rng, 700, size), _ground(rng, 9, size, 0.0))


def _camera(name: str, rng: np.random.Generator) -> Camera:
    focal = 2500.0 + 12.0 * rng.normal()
    cx, cy = np.array([1500.0, 1000.0]) + 6.0 * rng.normal(size=2)
    return Camera(name, 3000, 2000, focal, focal, cx, cy, (-0.05 + 0.005 * rng.normal(), 0.01, 3e-4, -2e-4, 0.0))


def _ground(rng: np.random.Generator, count: int, size: Array, beyond: float = 70.0) -> Array:
    plan = rng.uniform(-beyond, size + beyond, (count, 2))
    return np.column_stack([plan, 5.0 * np.sin(plan[:, 0] / 19.0) + 4.0 * np.cos(plan[:, 1] / 15.0)])


@dataclass(frozen=True)
class Wrong:
    """Blunders: a share of image observations by 15 to 60 px, one GNSS position and one control point (m, east)."""

    observations: float = 0.0
    gnss_m: float = 0.0  # of exposure 17
    control_m: float = 0.0  # of P2


def write_oblique(
    made: Oblique,
    folder: Path,
    *,
    seed: int = 1,
    form: str = "bingo",
    rig: str = "",
    gnss: str = "",
    control: str = '"all"',
    attitudes: str | None = None,
    more: str = "",
    by_image: bool = False,
    free: bool = False,
    wrong: Wrong = Wrong(),
) -> Path:
    """attitudes: "N" those of the camera that looks down, "all" of all images, 0.5 deg and 1 m off; by_image: positions
    by image, not by exposure; free: the table of mountings states no sigmas but those of N."""
    rng = np.random.default_rng(seed)
    folder.mkdir(parents=True, exist_ok=True)
    _write_measurements(made, folder / "points.txt", form, rng, wrong.observations)
    _write_gnss(made, folder / "gnss.csv", rng, by_image, wrong.gnss_m)
    surveyed = made.surveyed + SURVEYED_M * rng.normal(size=made.surveyed.shape)
    surveyed[2, 0] += wrong.control_m
    names = [f"P{k}" for k in range(len(surveyed))]
    _write_rows(folder / "surveyed.csv", "point,x,y,z,sigma_x,sigma_y,sigma_z", names, surveyed, SURVEYED_M)
    _write_cameras(folder / "camera.csv")
    _write_rig(folder / "rig.csv", free)
    if attitudes is not None:
        _write_attitudes(made, folder / "eo.csv", rng, [i for i in made.image_ids if attitudes == "all" or i[0] == "N"])
    attitude = "" if attitudes is None else _ATTITUDE
    text = _PROJECT.format(form=form, rig=rig, gnss=gnss, control=control, more=more, attitude=attitude)
    (folder / "project.toml").write_text(text, encoding="utf-8")
    return folder


_ATTITUDE = 'attitude = { file = "eo.csv", angles = "omega-phi-kappa", angle_unit = "deg" }'


def _write_measurements(made: Oblique, path: Path, form: str, rng: np.random.Generator, wrong: float) -> None:
    everything = np.concatenate([made.points, made.surveyed])
    sigma = np.where(np.arange(len(everything)) < len(made.points), TIE_PX, MARK_PX)
    image, point, pixels = [], [], []
    for k, name in enumerate(made.image_ids):
        camera, pose = made.cameras[name[0]], made.world_from_cam(name)
        px = project(camera, pose.inverse().apply(everything)) + sigma[:, None] * rng.normal(size=(len(everything), 2))
        seen = np.flatnonzero(((px > 0) & (px < [camera.width, camera.height])).all(axis=1))
        image.append(np.full(len(seen), k))
        point.append(seen)
        pixels.append(px[seen])
    xy, points = np.concatenate(pixels), np.concatenate(point)
    bad = (rng.uniform(size=len(xy)) < wrong) & (points < len(made.points))
    angle = rng.uniform(0, 2 * np.pi, len(xy))
    off = rng.uniform(15.0, 60.0, len(xy))[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    xy = np.clip(np.where(bad[:, None], xy + off, xy), 0.0, [3000.0, 2000.0])
    ids = [str(k) for k in range(len(made.points))] + [f"GCP_P{k}" for k in range(len(made.surveyed))]
    rows, headers = np.zeros(0, np.int64), (f"H_{SENSOR_MM[0]:.5f}_{SENSOR_MM[1]:.5f}",) * len(made.image_ids)
    table = BingoTable(path, made.image_ids, headers, rows, tuple(ids), np.concatenate(image), points, xy, rows)
    if form == "pix4d":
        write_pix4d_ties(replace(table, in_pixels=True), path)
    else:
        write_bingo(replace(table, xy_mm=mm_from_pixels(xy, (3000, 2000), SENSOR_MM)), path)


def _write_gnss(made: Oblique, path: Path, rng: np.random.Generator, by_image: bool, wrong_m: float) -> None:
    stations = made.world_from_rig
    antenna = stations.translation + stations.rotation @ LEVER_M + GNSS_M * rng.normal(size=(len(stations), 3))
    antenna[min(17, len(antenna) - 1), 0] += wrong_m
    lines = ["image,station,time,x,y,z,sigma_x,sigma_y,sigma_z"]
    for s, place in enumerate(antenna):
        for k, name in enumerate(NAMES if by_image else ("N",)):
            cells = [f"{name}_{s:03d}", f"e{s}", f"{2.5 * s + 0.001 * k:.3f}"]
            lines.append(",".join([*cells, *(f"{v:.4f}" for v in place), *map(str, GNSS_M)]))
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _write_rows(path: Path, header: str, names: list[str], positions: Array, sigmas: Array) -> None:
    rows = [",".join([n, *(f"{v:.4f}" for v in p), *map(str, sigmas)]) for n, p in zip(names, positions, strict=True)]
    path.write_text("\n".join([header, *rows]) + "\n", encoding="utf-8")


def _write_cameras(path: Path) -> None:
    rows = [f"{name},3000,2000,2500,2500,1500,1000,focal cx cy k1 k2 p1 p2" for name in NAMES]
    path.write_text("\n".join(["camera,width,height,fx,fy,cx,cy,estimate", *rows]) + "\n", encoding="utf-8")


def _write_rig(path: Path, free: bool) -> None:
    lines = ["camera,x,y,z,omega,phi,kappa,sigma_m,sigma_deg"]
    for name in NAMES:
        pose = Rigid3.identity() if name == "N" else nominal(name)
        angles = np.degrees(omega_phi_kappa_from_rotation(np.diag([1.0, -1.0, -1.0]) @ pose.rotation))
        sigmas = "0,0" if name == "N" else "," if free else "0.01,0.3"
        lines.append(",".join([name, *(f"{v:.6f}" for v in (*pose.translation, *angles)), sigmas]))
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _write_attitudes(made: Oblique, path: Path, rng: np.random.Generator, ids: list[str]) -> None:
    lines = ["image,x,y,z,omega,phi,kappa"]
    for name in ids:
        off = np.array([*[np.radians(0.5)] * 3, *[1.0] * 3]) * rng.normal(size=6)
        pose = made.world_from_cam(name).retract(off)
        angles = np.degrees(omega_phi_kappa_from_rotation(pose.rotation))
        lines.append(",".join([f"{name}.JPG", *(f"{v:.5f}" for v in (*pose.translation, *angles))]))
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
