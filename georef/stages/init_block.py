"""Verb `init` for what Pix4D exports of a block: tie points, poses, positions as measured, calibrations, control.

    *_tp_bingo.txt or *_tp_pix4d.txt   *_calibrated_external_camera_parameters_error.txt
    *_calibrated_camera_parameters.txt   points.csv

Cameras start from Pix4D's calibrations and rotations from its poses; neither is an observation.
"""

from __future__ import annotations

import json
import tomllib
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

from georef.config import validated
from georef.crs import CrsDefinition, crs_kind
from georef.errors import ConfigError
from georef.geometry.camera import Camera
from georef.io.camera_table import CAMERA_COLUMNS
from georef.io.files import write_text_atomically
from georef.io.pix4d import GIVEN_COLUMNS, read_pix4d_adjusted, read_pix4d_poses
from georef.project import ProjectFile

TIES = {"pix4d": "_tp_pix4d.txt", "bingo": "_tp_bingo.txt"}
POSES, PARAMETERS, POINTS = (
    "_calibrated_external_camera_parameters_error.txt",
    "_calibrated_camera_parameters.txt",
    "points.csv",
)
_ESTIMATED = ("focal", "cx", "cy", "k1", "k2", "k3", "p1", "p2")
_COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3")


@dataclass(frozen=True)
class Pix4dFolder:
    """The files of a folder of exports, by what they hold."""

    data: Path
    ties: Path
    form: str
    poses: Path
    parameters: Path


def find_pix4d(data: Path) -> Pix4dFolder | None:
    """The exports in a folder, BINGO before Pix4D's own tie points; None where there are none. Raises ConfigError where
    there are those of several blocks."""
    found = {form: sorted(data.glob(f"*{end}")) for form, end in TIES.items()}
    poses, parameters = (sorted(data.glob(f"*{end}")) for end in (POSES, PARAMETERS))
    form = "bingo" if found["bingo"] else "pix4d"
    if not (found[form] and poses and parameters):
        return None
    several = next((files for files in (found[form], poses, parameters) if len(files) > 1), None)
    if several is not None:
        raise ConfigError(
            f"The folder holds exports of several blocks: {', '.join(path.name for path in several[:3])}.",
            "Expected one file of each kind: move the others, or write project.toml by hand.",
            f"In {data}.",
        )
    return Pix4dFolder(data, found[form][0], form, poses[0], parameters[0])


def init_block(
    path: Path, found: Pix4dFolder, crs: str | None, height: str | None, name: str | None
) -> tuple[str, ...]:
    """Writes project.toml of what Pix4D exported, and the table of its cameras; what was taken from where. Raises
    ConfigError, InputError, CrsError."""
    if crs is None:
        raise ConfigError(
            "Nothing says the coordinate reference system of the positions.",
            "State it: --crs EPSG:32647 --height ellipsoidal, as Pix4D's output coordinate system is.",
            f"In {found.data}.",
        )
    crs_kind(CrsDefinition(crs, height))
    text, cameras, said = block_text(found, name or found.data.name, crs, height)
    validated(ProjectFile, tomllib.loads(text), str(path))
    write_cameras(cameras, path.parent)
    write_text_atomically(text, path)
    return said


def block_text(found: Pix4dFolder, name: str, horizontal: str, height: str | None) -> tuple[str, str, tuple[str, ...]]:
    """project.toml and camera.csv of a block, and what was taken from where. Raises InputError."""
    poses, table = read_pix4d_poses(found.parameters), read_pix4d_adjusted(found.poses)
    names = dict(zip(table.image_ids, table.cameras, strict=True))
    cameras: dict[str, Camera] = {}
    for image, camera in zip(poses.image_ids, poses.cameras, strict=True):
        cameras.setdefault(names.get(image) or "camera", camera)
    counts = Counter(names.values())
    said = (
        f"measurements  {found.ties.name}",
        f"positions     {found.poses.name}, as measured",
        f"rotations     {found.poses.name}, to start from",
        *(f"camera        {key}: {counts[key]} images, calibration of {found.parameters.name}" for key in cameras),
    )
    several = "" if len(cameras) < 2 else _RIG.format(reference=_text(next(iter(cameras))))
    points = _POINTS if (found.data / POINTS).is_file() else _NO_POINTS
    text = _PROJECT.format(
        name=_text(name),
        horizontal=_text(horizontal),
        height="" if height is None else f"\nheight = {_text(height)}",
        form=_text(found.form),
        ties=_text(found.ties.name),
        poses=_text(found.poses.name),
        parameters=_text(found.parameters.name),
        given=_columns(GIVEN_COLUMNS),
        rig=several,
        points=points,
    )
    return text, _camera_table(cameras), said


def write_cameras(text: str, folder: Path) -> None:
    """camera.csv beside project.toml. Raises ConfigError where there is one already."""
    path = folder / "camera.csv"
    if path.exists():
        raise ConfigError("There is a table of cameras already; it stays as it is.", "Move it.", f"In {path}.")
    write_text_atomically(text, path)


def _camera_table(cameras: dict[str, Camera]) -> str:
    lines = [",".join([*CAMERA_COLUMNS, *_COEFFICIENTS, "estimate"])]
    for key, camera in cameras.items():
        values = (camera.fx, camera.fy, camera.cx, camera.cy, *camera.coefficients[: len(_COEFFICIENTS)])
        cells = [key, camera.width, camera.height, *(f"{v:.10g}" for v in values), " ".join(_ESTIMATED)]
        lines.append(",".join(map(str, cells)))
    return "\n".join(lines) + "\n"


def _columns(columns: dict[str, str]) -> str:
    kept = {ours: theirs for ours, theirs in columns.items() if ours not in ("omega", "phi", "kappa")}
    return ", ".join(f"{ours} = {_text(theirs)}" for ours, theirs in kept.items())


def _text(value: str) -> str:
    return json.dumps(value, ensure_ascii=False)


_PROJECT = """# A block that was measured elsewhere: georef adjust PROJECT --data DIR
name = {name}

[crs]
horizontal = {horizontal}{height}

[blocks.flight]
cameras = "camera.csv"
control = "none"               # ids of points that take part, "all" or "none"; the others are check points
compare = {{ format = "pix4d", parameters = {parameters} }}

[blocks.flight.observations]
format = {form}
file = {ties}
sigma_px = 1.0
mark_prefix = "GCP_"           # GCP_P1 is a mark of the surveyed point P1

[blocks.flight.attitude]
file = {poses}
angles = "omega-phi-kappa"
angle_unit = "deg"
table.columns = {{ image = "imageName", camera = "cameraName", easting = "X_opt", northing = "Y_opt", \
height = "Z_opt", omega = "Omega", phi = "Phi", kappa = "Kappa" }}

[blocks.flight.gnss]
file = {poses}
# offset_sigma_m = [0.10, 0.10, 0.20]   # one offset of all positions; drift = {{ ... }} by flight or time
table.columns = {{ {given} }}
{rig}{points}"""
_RIG = """
# Several cameras: where they are one rig, say how its exposures are told; without it each image stands for itself.
# [blocks.flight.rig]
# reference = {reference}
# station_pattern = '(\\d+)'   # or station_within_s = 0.05, station = "position", or a column `station`
"""
_POINTS = """
[points]
coordinates = "points.csv"
check_kind = "absolute"
"""
_NO_POINTS = """
# [points]
# coordinates = "points.csv"    # point, easting, northing, height, sigma_e, sigma_n, sigma_h
# check_kind = "absolute"
"""
