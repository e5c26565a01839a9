"""Writes the evaluation's street as an ordinary project, and its truth in a folder that no project names."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np

from georef.geometry.angles import yaw_pitch_roll_from_rotation
from georef.geometry.panorama import RIG_FROM_PANO, PanoramaHead
from georef.geometry.rigid import Rigid3
from georef.io.files import write_text_atomically
from georef.simulate import tables
from georef.simulate.evaluation import (
    PANORAMA_REFERENCE,
    PANORAMAS,
    REFERENCES,
    SECOND_REFERENCE,
    STITCHING_RADIUS_M,
    EvaluationWorld,
    PositionSystem,
    declared_heads,
    drawn_positions,
)
from georef.simulate.evaluation_images import PHONES, UNDISTORTED, Product, ProductTask, pinhole_of, products
from georef.simulate.lenses import Lens
from georef.simulate.project_files import PROJECT, TRUTH, InOrder, Runner, claim

PRIORS = {"": PositionSystem(15.0, 10.0, 5.0), "_100m": PositionSystem(100.0, 40.0, 10.0)}
"""By the ending of the table's name: the priors that project.toml names, and much weaker ones."""

HEADS, RIG = "heads.csv", "rig.csv"
RIG_SIGMA_M, RIG_SIGMA_DEG = 0.001, 0.01
"""How well a rig is calibrated, each coordinate and the rotation about each axis."""
_ON_RIG = ("vehicle", UNDISTORTED)
_TABLES_VERSION = 2  # rises when the same world is declared by other tables
_CAMERA_HEADER = "camera,model,width,height,fx,fy,cx,cy,k1,k2,p1,p2,k3,k4"
_HEAD_HEADER = "head,width,height,fx,fy,cx,cy,x,y,z,yaw,pitch,roll"
_RIG_HEADER = "camera,x,y,z,yaw,pitch,roll,sigma_m,sigma_deg"
_RIG_COMMENT = (
    "# Cameras of the vehicle, as calibrated. x right, y down, z forward in metres, yaw (clockwise), pitch (up), roll "
    "in degrees; 1-sigma of each coordinate and of the rotation about each axis."
)
_HEAD_COMMENT = (
    "# Heads of the panorama. Pixels; the top-left pixel's centre is (0.5, 0.5). x right, y down, z forward in metres, "
    "yaw (clockwise), pitch (up), roll in degrees, all against the middle of the panorama."
)


def write_evaluation(world: EvaluationWorld, folder: Path, runner: Runner | None = None) -> list[str]:
    """Writes everything: project.toml, tables, truth, images. Returns the files rendered now.

    Raises InputError where the folder holds another world.
    """
    write_evaluation_tables(world, folder)
    return write_evaluation_images(world, folder, runner)


def write_evaluation_tables(world: EvaluationWorld, folder: Path) -> None:
    """All files but the images; nothing is computed where they are there already."""
    claim(world, folder)
    done = folder / TRUTH / "complete.json"
    stated = json.dumps({"fingerprint": world.options.fingerprint, "tables": _TABLES_VERSION}) + "\n"
    if done.is_file() and done.read_text(encoding="utf-8") == stated:
        return
    delivered = _by_epoch(products(world))
    heads = declared_heads(world.rigs[PANORAMA_REFERENCE])
    write_text_atomically(_head_table(heads), folder / HEADS)
    write_text_atomically(rig_table(world), folder / RIG)
    for epoch, files in delivered.items():
        if epoch not in PANORAMAS and epoch not in PHONES:
            write_text_atomically(camera_table(_lenses(world, files)), folder / f"cameras_{epoch}.csv")
        if epoch in REFERENCES:
            _write_reference(world, epoch, files, folder)
        else:
            _write_positions(world, epoch, files, folder)
            _write_truth(world, epoch, files, folder / TRUTH)
    write_text_atomically(camera_table({"phone": world.rigs["phone"].lenses["phone"]}), folder / TRUTH / "cameras.csv")
    write_text_atomically(project_toml(world), folder / PROJECT)
    write_text_atomically(stated, done)


def write_evaluation_images(world: EvaluationWorld, folder: Path, runner: Runner | None = None) -> list[str]:
    """Makes the images that are not there yet; returns their names in the folder."""
    claim(world, folder)
    missing = [p for p in products(world) if not (folder / p.file).is_file()]
    task, made = ProductTask(world.evaluation, folder), []
    for late in (False, True):  # undistorted images are made from others
        names = [p.file for p in missing if (p.epoch == UNDISTORTED) == late]
        if names:
            made += list((runner or InOrder()).map_items(task, names, "images"))
    return made


def camera_table(lenses: Mapping[str, Lens]) -> str:
    """Cameras of all models by their ids."""
    rows = [(name, *_camera_row(lens)) for name, lens in lenses.items()]
    return tables.table(tables.PIXELS, _CAMERA_HEADER, rows)


def _camera_row(lens: Lens) -> list[object]:
    k: dict[str, float] = {}
    if lens.fisheye is not None:
        f = lens.fisheye
        model, interior = "fisheye", (f.focal_px, f.focal_px, f.cx, f.cy)
        k = {f"k{i}": value for i, value in enumerate(f.coefficients, start=1)}
    else:
        c = lens.camera
        assert c is not None
        model, interior = ("brown" if c.distortion else "pinhole"), (c.fx, c.fy, c.cx, c.cy)
        k = dict(zip(("k1", "k2", "p1", "p2"), c.distortion, strict=False))
    coefficients = [k.get(name, 0.0) for name in _CAMERA_HEADER.split(",")[8:]]
    return [model, lens.width, lens.height, *(f"{v:.4f}" for v in interior), *coefficients]


def _lenses(world: EvaluationWorld, files: Iterable[Product]) -> dict[str, Lens]:
    out = {}
    for product in files:
        lens = world.images[Path(product.image_id).name].lens
        if product.epoch == UNDISTORTED:
            lens = Lens(lens.name, lens.width, lens.height, pinhole_of(lens))
        out[product.camera] = lens
    return out


def _by_epoch(delivered: Iterable[Product]) -> dict[str, list[Product]]:
    out: dict[str, list[Product]] = {}
    for product in delivered:
        out.setdefault(product.epoch, []).append(product)
    return out


def _exact(world: EvaluationWorld, files: Sequence[Product]) -> dict[str, Rigid3]:
    """Exact poses by the ids of the files."""
    if files[0].epoch in PANORAMAS:
        poses = world.pano_poses(files[0].epoch)
        return {product.image_id: poses[product.image_id] for product in files}
    return {p.image_id: world.images[Path(p.image_id).name].world_from_cam for p in files}


def _write_reference(world: EvaluationWorld, epoch: str, files: Sequence[Product], folder: Path) -> None:
    """The published orientation; that of "2025" names the camera of each image, "2023" has a folder for each."""
    given = world.published_orientation(epoch)
    poses = {product.image_id: given[Path(product.image_id).name] for product in files}
    cameras = {p.image_id: p.camera for p in files} if epoch == SECOND_REFERENCE else {}
    text = tables.orientation_table(poses, {}, world.frame, cameras)
    write_text_atomically(text, folder / f"{epoch}_eo.csv")


def _write_positions(world: EvaluationWorld, epoch: str, files: Sequence[Product], folder: Path) -> None:
    poses = _exact(world, files)
    cameras = {p.image_id: p.camera for p in files} if len({p.camera for p in files}) > 1 else {}
    stations = {p.image_id: str(p.station) for p in files} if epoch in _ON_RIG else None
    source = "vehicle" if epoch == UNDISTORTED else epoch  # the same photographs have the same positions
    for ending, system in PRIORS.items():
        positions, headings = drawn_positions(world, list(poses.values()), system, source + ending)
        placed = dict(zip(poses, positions, strict=True))
        text = tables.position_table(placed, system.sigmas_m, headings, cameras, world.frame, stations)
        write_text_atomically(text, folder / f"{epoch}_gnss{ending}.csv")


def _write_truth(world: EvaluationWorld, epoch: str, files: Sequence[Product], truth: Path) -> None:
    """Exact poses, and as the reference would have them; of panoramas those of their heads, as results have them."""
    exact = _exact(world, files)
    if epoch in PANORAMAS:
        heads = declared_heads(world.rigs[epoch])
        exact = {f"{name}/{h.name}": pose @ h.pano_from_head for name, pose in exact.items() for h in heads}
    write_text_atomically(tables.orientation_table(exact, {}, world.frame), truth / f"{epoch}_eo.csv")
    moved = {name: world.deformation.moved_pose(pose) for name, pose in exact.items()}
    write_text_atomically(tables.orientation_table(moved, {}, world.frame), truth / f"{epoch}_eo_relative.csv")


def _head_table(heads: Sequence[PanoramaHead]) -> str:
    rows = []
    for head in heads:
        c, pose = head.camera, head.pano_from_head
        angles = np.degrees(yaw_pitch_roll_from_rotation(RIG_FROM_PANO @ pose.rotation))
        interior = (f"{v:.4f}" for v in (c.fx, c.fy, c.cx, c.cy))
        placed = (f"{v + 0.0:.6f}" for v in (*pose.translation, *angles))
        rows.append((head.name, c.width, c.height, *interior, *placed))
    return tables.table(_HEAD_COMMENT, _HEAD_HEADER, rows)


def rig_table(world: EvaluationWorld) -> str:
    """The vehicle's cameras as their calibration has them: off by what it states."""
    rig, rng = world.rigs["vehicle"], world.rng("calibration", "vehicle")
    sigmas = np.array([np.radians(RIG_SIGMA_DEG)] * 3 + [RIG_SIGMA_M] * 3)
    rows = []
    for head in rig.heads:
        found = head.rig_from_cam.retract(sigmas * rng.normal(size=6))
        angles = np.degrees(yaw_pitch_roll_from_rotation(found.rotation))
        placed = (f"{v + 0.0:.6f}" for v in (*(RIG_FROM_PANO.T @ found.translation), *angles))
        rows.append((rig.lenses[head.name].name, *placed, RIG_SIGMA_M, RIG_SIGMA_DEG))
    return tables.table(_RIG_COMMENT, _RIG_HEADER, rows)


def project_toml(world: EvaluationWorld, ending: str = "") -> str:
    """The declarations of an ordinary project of this world's files."""
    quality = world.options.reference
    sigma = f"sigma = {{ position_m = {[quality.relative_m] * 3}, rotation_deg = {[quality.relative_deg] * 3} }}\n"
    sections = [_HEADER]
    for epoch in REFERENCES:
        pano = epoch in PANORAMAS
        sections.append(
            f'[references.{epoch}]\nimages = "{epoch}"\nexterior_orientation = "{epoch}_eo.csv"\n'
            'angles = "omega-phi-kappa"\nangle_unit = "deg"\n'
            + (_PANORAMA.format(projection="cube-map") if pano else f'cameras = "cameras_{epoch}.csv"\n')
            + sigma
        )
    for epoch in _by_epoch(p for p in products(world) if p.epoch not in REFERENCES):
        pano, phone = epoch in PANORAMAS, epoch in PHONES
        camera = _PANORAMA.format(projection="equirectangular") if pano else f'cameras = "cameras_{epoch}.csv"\n'
        camera = _UNKNOWN if phone else camera
        camera += f'rig = "{RIG}"\n' if epoch in _ON_RIG else ""
        sections.append(f'[epochs.{epoch}]\nimages = "{epoch}"\ngnss = "{epoch}_gnss{ending}.csv"\n{camera}')
    return "\n".join(sections)


_PANORAMA = (
    f'panorama = {{{{ projection = "{{projection}}", heads = "{HEADS}", '
    f"stitching_radius_m = {STITCHING_RADIUS_M} }}}}\n"
)
_UNKNOWN = 'intrinsics = "estimate"        # unknown: focal length (starts from EXIF), principal point and k1\n'
_HEADER = """\
# A simulated street for evaluations: two reference epochs, mapped by three cameras and by panoramas, and new images of
# many kinds. Positions are good to 15 m; tables that end in _100m.csv hold weaker ones:
# --set epochs.vehicle.gnss=vehicle_gnss_100m.csv
# File names are relative to the data root: --data DIR or GEOREF_DATA.
name = "evaluation"

[crs]
horizontal = "EPSG:25832"      # ETRS89 / UTM zone 32N
height = "ellipsoidal"
"""
