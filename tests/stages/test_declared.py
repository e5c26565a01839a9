"""What an epoch declares beside its images, from project.toml to the report: it acts, and what is wrong is named."""

from __future__ import annotations

import json
import re
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from georef.cli import app
from georef.geometry.angles import yaw_pitch_roll_from_rotation
from georef.geometry.camera import project
from georef.geometry.panorama import RIG_FROM_PANO
from georef.geometry.rigid import Array, Rigid3
from georef.terminal import exit_code
from tests.worlds.tiny import CAMERA, EPOCH, TinyWorld, write_tiny_world

ARM, STATED = np.array([0.2, -1.1, 0.3]), [0.35, -1.0, 0.1]
OFFSET = np.array([0.35, -0.25, 0.5])
ENDS = {"bar-a": np.array([9.99, 6.0, 3.0]), "bar-b": np.array([9.99, 4.0, 3.0])}
SECTION = f"""
antenna = {{ lever_arm_m = {STATED}, sigma_m = 0.3 }}
gnss_offset = {{ sigma_m = [1.0, 1.0, 1.0] }}
motions = "motions.csv"
distances = {{ file = "distances.csv", marks = "bar_marks.csv" }}
calibration = {{ "*" = {{ focal = 5.0, cx = 3.0 }} }}
"""


def declared(world: TinyWorld) -> None:
    """Precise fixes of an antenna with an offset, motions between images, and a scale bar."""
    rng = np.random.default_rng(3)
    folder, truth = world.data, world.truth
    rows = ["image,x,y,z,sigma_x,sigma_y,sigma_z,time_s"]
    for k, (name, pose) in enumerate(truth.items()):
        fix = pose.apply(ARM) + OFFSET + 0.01 * rng.normal(size=3)
        rows.append(",".join([name, *(f"{v:.4f}" for v in fix), "0.01,0.01,0.01", str(10 * k)]))
    (folder / f"{EPOCH}_gnss.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")
    rows = ["from,to,x,y,z,yaw,pitch,roll,sigma_m,sigma_deg"]
    for (a, first), (b, second) in pairwise(truth.items()):
        rows.append(f"{a},{b},{_motion(first.inverse() @ second)},0.002,0.01")
    (folder / "motions.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")
    (folder / "distances.csv").write_text("from,to,distance_m,sigma_m\nbar-a,bar-b,2.0,0.001\n", encoding="utf-8")
    marks = ["point,image,x,y,sigma_px"]
    for point, place in ENDS.items():
        for name, pose in truth.items():
            pixel = project(CAMERA, pose.inverse().apply(place[None]))[0]
            if np.isfinite(pixel).all() and (pixel > 2).all() and (pixel < (638, 478)).all():
                x, y = pixel + 0.2 * rng.normal(size=2)
                marks.append(f"{point},{name},{x:.3f},{y:.3f},0.2")
    (folder / "bar_marks.csv").write_text("\n".join(marks) + "\n", encoding="utf-8")
    toml = folder / "project.toml"
    text = toml.read_text(encoding="utf-8").replace(f'gnss = "{EPOCH}_gnss.csv"', f'gnss = "{EPOCH}_gnss.csv"{SECTION}')
    toml.write_text(text, encoding="utf-8")


def _motion(pose: Rigid3) -> str:
    angles = np.degrees(yaw_pitch_roll_from_rotation(RIG_FROM_PANO @ pose.rotation))
    return ",".join(f"{v:.6f}" for v in [*pose.translation, *angles])


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> TinyWorld:
    made = write_tiny_world(tmp_path_factory.mktemp("declared"), more=5, local=True)
    declared(made)
    return made


@pytest.fixture(scope="module")
def kept(world: TinyWorld, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The results of a run with everything declared, control included: one horizontally, one by its height."""
    output = tmp_path_factory.mktemp("output")
    lines = (world.data / "points.csv").read_text(encoding="utf-8").splitlines()
    control = [i for i, line in enumerate(lines) if ",control," in line]
    for i, blank in zip(control[1:3], ((7,), (5, 6)), strict=True):
        cells = lines[i].split(",")
        lines[i] = ",".join("" if k in blank else cell for k, cell in enumerate(cells))
        coordinate = 4 if blank == (7,) else 2
        cells = lines[i].split(",")
        cells[coordinate] = f"{float(cells[coordinate]) + 0.4:.4f}"  # approximate: wrong, and no observation
        lines[i] = ",".join(cells)
    (world.data / "points.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    assert exit_code(app, ["run", str(world.data), "-o", str(output), "--set", "adjust.surveyed_control=true"]) == 0
    return output


@pytest.fixture(scope="module")
def report(kept: Path) -> dict:
    return json.loads((kept / "epochs" / EPOCH / "report.json").read_text(encoding="utf-8"))


def _unknowns(report: dict, name: str) -> tuple[Array, Array]:
    """Values and sigmas of the shared unknowns whose names begin so."""
    found = [u for u in report["reliability"]["shared_unknowns"] if u["name"].startswith(name)]
    return np.array([u["value"] for u in found]), np.array([u["sigma"] for u in found])


@pytest.mark.parametrize(("name", "truth"), [("lever arm", ARM), ("GNSS offset", OFFSET)])
def test_antenna_and_offset_are_estimated_back(report: dict, name: str, truth: Array) -> None:
    value, sigma = _unknowns(report, name)
    assert (sigma > 0.001).all()
    assert (sigma < [0.06, 0.3, 0.06] if name == "lever arm" else sigma < [0.06, 0.06, 0.3]).all()
    assert (np.abs(value - truth) < 4.5 * sigma).all(), (value, sigma)


def test_level_images_cannot_tell_the_height_of_the_antenna_from_an_offset(report: dict) -> None:
    pairs = {frozenset((c["first"], c["second"])): c["value"] for c in report["reliability"]["correlations"]}
    assert abs(pairs[frozenset(("lever arm of antenna y", "GNSS offset up"))]) > 0.95


def test_the_camera_is_estimated_near_its_truth(report: dict) -> None:
    value, sigma = _unknowns(report, "focal")
    assert value[0] == pytest.approx(CAMERA.fx, abs=max(4.5 * sigma[0], 0.2))
    assert 0.005 < sigma[0] < 2.0


def test_motions_and_distances_take_part(report: dict) -> None:
    gates = report["gates"]
    assert gates["relative_poses"]["tested"] == 7
    assert gates["relative_poses"]["rejected"] == 0
    assert gates["distances"]["tested"] == 1
    assert report["variance_components"]["relative_poses"]["factor"] < 2.0


def test_partial_control_has_residuals_of_what_is_known(report: dict) -> None:
    points = {p["point"]: p for p in report["control_points"]["points"]}
    level = next(p for p in points.values() if p["sigma_m"][2] is None)
    height = next(p for p in points.values() if p["sigma_m"][0] is None)
    assert level["residual_m"][2] is None
    assert height["residual_m"][:2] == [None, None]
    assert abs(height["residual_m"][2]) < 0.03
    assert level["dof"] == 2
    assert height["dof"] == 1


_WRONG = {
    "motion": ("motions.csv", "n0.jpg,n1.jpg", "n0.jpg,nobody", r"names 'nobody', which is no station.*row 2 of"),
    "no sigma": ("motions.csv", ",0.002,0.01", ",0,0.01", r"sigma_m = 0.0, which would fix it exactly.*row 2 of"),
    "length": ("distances.csv", ",2.0,", ",-2.0,", r"is -2.0 m.*positive length.*row 2 of"),
    "end": ("distances.csv", "bar-b", "bar-c", r"ends at 'bar-c', which is neither marked nor.*row 2 of"),
    "camera": ("project.toml", '"*" = { focal', '"left" = { focal', r"names the camera 'left', which took no image"),
    "parameter": ("project.toml", "cx = 3.0", "k9 = 3.0", r"has 'k9' of camera 'cam'.*Expected some of: focal"),
    "times": ("project.toml", "sigma_m = [1.0, 1.0, 1.0]", "sigma_m = 1.0, every_s = 0", r"every_s.*greater than 0"),
    "no gnss": ("project.toml", f'gnss = "{EPOCH}_gnss.csv"', "", r"name their table with gnss"),
}


@pytest.mark.parametrize("fault", list(_WRONG))
def test_what_is_wrong_is_named_before_any_work(
    fault: str, world: TinyWorld, kept: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file, old, new, words = _WRONG[fault]
    data = tmp_path / "data"
    data.mkdir()
    for path in world.data.iterdir():
        if path.name == file:
            text = path.read_text(encoding="utf-8")
            assert old in text
            (data / file).write_text(text.replace(old, new, 1), encoding="utf-8")
        else:
            (data / path.name).symlink_to(path)
    assert exit_code(app, ["run", str(data), "-o", str(tmp_path / "out")]) == 1
    said = " ".join(capsys.readouterr().err.split())
    assert re.search(words, said), said
    assert not (tmp_path / "out" / "work" / EPOCH / "localize").exists()
