"""poses.csv: what is written is what is read, and its numbers mean what its comments say."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from georef.errors import InputError
from georef.geometry.angles import omega_phi_kappa_from_rotation, rotation_from_omega_phi_kappa
from georef.geometry.rigid import Array, Rigid3, exp_so3
from georef.io.columns import POSITION_COLUMNS, SIGMA_COLUMNS, CrsKind
from georef.io.declarations import check_declared_crs, check_declared_height
from georef.io.poses import PoseRecord, PosesFrame, read_poses, sigmas_from_cov, write_poses

FRAME = PosesFrame("projected", "EPSG:25832", "ellipsoidal", "longitude 8.4, latitude 48.94, 170.0 m (EPSG:4937)")


def known(value: Array | None) -> Array:
    assert value is not None
    return value


def random_cov(rng: np.random.Generator) -> Array:
    root = rng.normal(size=(6, 6)) * np.array([1e-4, 1e-4, 1e-4, 1e-2, 1e-2, 1e-2])[:, None]
    return root @ root.T + np.diag([1e-10] * 3 + [1e-6] * 3)


def record_of(rng: np.random.Generator, image_id: str, phi_deg: float | None = None) -> PoseRecord:
    angles = np.deg2rad(rng.uniform([-180, -80, -180], [180, 80, 180]))
    if phi_deg is not None:
        angles[1] = np.deg2rad(phi_deg)
    position = np.round(rng.normal([456583.1, 5421034.7, 178.1], 1.0), 4)
    return PoseRecord(image_id, "localized", position, rotation_from_omega_phi_kappa(angles), random_cov(rng))


def test_round_trip(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    ids = ['a, "b".jpg', "#1.jpg", "Straße 3.jpg", *(f"{k}.jpg" for k in range(10))]
    records = [record_of(rng, image_id) for image_id in ids]
    records.insert(2, PoseRecord("x.jpg", "rejected: few_inliers, 9 of 12\nsecond line"))
    path = tmp_path / "epochs" / "new" / "poses.csv"
    write_poses(records, path, FRAME)
    table = read_poses(path)
    assert table.crs_kind == "projected"
    assert [r.image_id for r in table.records] == [r.image_id for r in records]
    assert table.records[2].status == "rejected: few_inliers, 9 of 12 second line"
    assert not table.records[2].has_pose
    for read, written in zip(table.records, records, strict=True):
        if not written.has_pose:
            continue
        axes, cov = known(written.axes_from_cam), known(written.cov)
        position_sigmas, angle_sigmas = sigmas_from_cov(axes, cov)
        np.testing.assert_array_equal(known(read.position_in_crs), known(written.position_in_crs))
        np.testing.assert_allclose(known(read.axes_from_cam), axes, atol=2.5e-8)
        np.testing.assert_allclose(known(read.cov), cov, rtol=1e-8, atol=0)
        np.testing.assert_allclose(known(read.position_sigmas_m), position_sigmas, rtol=1e-5)
        np.testing.assert_allclose(known(read.angle_sigmas_deg), known(angle_sigmas), rtol=1e-5)
    check_declared_crs(table, "EPSG:25832")
    check_declared_height(table, "ellipsoidal")
    assert list(path.parent.iterdir()) == [path]


def test_what_is_read_is_written_the_same(tmp_path: Path) -> None:
    rng = np.random.default_rng(6)
    records = [record_of(rng, "a.jpg"), PoseRecord("b.jpg", "rejected: no_prior"), record_of(rng, "c.jpg", 88.0)]
    write_poses(records, tmp_path / "1.csv", FRAME)
    write_poses(read_poses(tmp_path / "1.csv").records, tmp_path / "2.csv", FRAME)
    assert (tmp_path / "1.csv").read_bytes() == (tmp_path / "2.csv").read_bytes()


@pytest.mark.parametrize("kind", ["projected", "geographic", "geocentric", "local"])
def test_header_and_comments(tmp_path: Path, kind: CrsKind) -> None:
    horizontal = "local" if kind == "local" else "EPSG:4937"
    record = PoseRecord("a.jpg", "adjusted", np.array([-8.12345678912, 0.0, -0.0]), np.diag([1.0, -1.0, -1.0]))
    write_poses([record], tmp_path / "poses.csv", PosesFrame(kind, horizontal, None, "0, 0, 0"))
    lines = (tmp_path / "poses.csv").read_text().splitlines()
    assert "Angles: degrees, R = Rx(omega) Ry(phi) Rz(kappa), image (right, top, back) to" in lines[0]
    assert "T Exp(xi)" in lines[1]
    assert "camera axes x right, y down, z forward" in lines[1]
    assert lines[1].endswith("origin at 0, 0, 0.")
    names = lines[2].split(",")
    assert names[:8] == ["image", *POSITION_COLUMNS[kind], "omega", "phi", "kappa", "status"]
    assert names[8:29] == [f"cov_{i}{j}" for i in range(6) for j in range(i, 6)]
    assert names[29:] == [*SIGMA_COLUMNS[kind], "sigma_omega", "sigma_phi", "sigma_kappa", "angles_singular"]
    assert "-0.0000," not in lines[3]
    table = read_poses(tmp_path / "poses.csv", crs_kind=kind)
    assert table.declared_crs == horizontal
    position = table.records[0].position_in_crs
    assert position is not None
    assert abs(position[0] + 8.12345678912) < (1e-9 if kind == "geographic" else 6e-5)
    assert table.records[0].cov is None
    assert read_poses(tmp_path / "poses.csv").crs_kind == ("local" if kind == "geocentric" else kind)


@pytest.mark.parametrize(("phi_deg", "singular"), [(84.9, False), (85.1, True), (-89.0, True), (90.0, True)])
def test_singular_angles_have_no_sigmas(tmp_path: Path, phi_deg: float, singular: bool) -> None:
    record = record_of(np.random.default_rng(7), "a.jpg", phi_deg)
    write_poses([record], tmp_path / "poses.csv", FRAME)
    assert (tmp_path / "poses.csv").read_text().splitlines()[-1].split(",")[-4:-1].count("") == 3 * singular
    read = read_poses(tmp_path / "poses.csv").records[0]
    assert read.angles_singular == singular
    assert (read.angle_sigmas_deg is None) == singular
    assert read.position_sigmas_m is not None
    np.testing.assert_allclose(known(read.axes_from_cam), known(record.axes_from_cam), atol=1e-7)


def test_sigmas_against_monte_carlo() -> None:
    rng = np.random.default_rng(8)
    record = record_of(rng, "a.jpg", 40.0)
    axes, cov = known(record.axes_from_cam), known(record.cov)
    draws = rng.multivariate_normal(np.zeros(6), cov, size=4000)
    pose = Rigid3(axes, np.zeros(3))
    poses = [pose @ Rigid3.exp(xi) for xi in draws]
    angles = np.array([omega_phi_kappa_from_rotation(p.rotation) for p in poses])
    position_sigmas, angle_sigmas = sigmas_from_cov(axes, cov)
    np.testing.assert_allclose(np.std([p.translation for p in poses], axis=0), position_sigmas, rtol=0.05)
    np.testing.assert_allclose(np.rad2deg(np.std(angles, axis=0)), known(angle_sigmas), rtol=0.05)


def test_sigmas_that_are_passed_in_win(tmp_path: Path) -> None:
    base = record_of(np.random.default_rng(9), "a.jpg", 10.0)
    given = np.array([0.01, 0.02, 0.03])
    record = PoseRecord("a.jpg", "localized", base.position_in_crs, base.axes_from_cam, base.cov, given, given / 10)
    write_poses([record], tmp_path / "poses.csv", FRAME)
    read = read_poses(tmp_path / "poses.csv").records[0]
    np.testing.assert_allclose(known(read.position_sigmas_m), given)
    np.testing.assert_allclose(known(read.angle_sigmas_deg), given / 10)


def test_no_images(tmp_path: Path) -> None:
    write_poses([], tmp_path / "poses.csv", FRAME)
    assert read_poses(tmp_path / "poses.csv").records == ()


def test_only_rejected_images(tmp_path: Path) -> None:
    write_poses([PoseRecord("a.jpg", "rejected: unreadable")], tmp_path / "poses.csv", FRAME)
    assert not read_poses(tmp_path / "poses.csv").records[0].has_pose


def test_records_that_contradict_themselves() -> None:
    with pytest.raises(ValueError, match="does not go with its pose"):
        PoseRecord("a.jpg", "localized")
    with pytest.raises(ValueError, match="does not go with its pose"):
        PoseRecord("a.jpg", "rejected: few_matches", np.zeros(3), exp_so3([0, 0, 0]))
    with pytest.raises(ValueError, match="positive definite"):
        PoseRecord("a.jpg", "localized", np.zeros(3), np.eye(3), np.zeros((6, 6)))


def test_a_failed_write_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "poses.csv"
    write_poses([], path, FRAME)
    before = path.read_bytes()
    twice = [PoseRecord("a.jpg", "rejected: no_prior")] * 2
    with pytest.raises(ValueError, match="two poses"):
        write_poses(twice, path, FRAME)
    assert path.read_bytes() == before
    with pytest.raises(UnicodeEncodeError):
        write_poses([PoseRecord("\ud800.jpg", "rejected: no_prior")], path, FRAME)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_broken_covariance(tmp_path: Path) -> None:
    path = tmp_path / "poses.csv"
    write_poses([record_of(np.random.default_rng(3), "a.jpg")], path, FRAME)
    lines = path.read_text().splitlines()
    cells = lines[-1].split(",")
    cells[8] = "-1e-8"
    path.write_text("\n".join([*lines[:-1], ",".join(cells)]))
    with pytest.raises(InputError, match=r"The covariance of image 'a.jpg' is not one[\s\S]*In row 4 of"):
        read_poses(path)
    cells[8] = ""
    path.write_text("\n".join([*lines[:-1], ",".join(cells)]))
    with pytest.raises(InputError, match="all or none"):
        read_poses(path)


@pytest.mark.parametrize(
    ("name", "kind", "count"),
    [
        ("castle/reference_eo.csv", "projected", 30),
        ("castle/truth_new_epoch_eo.csv", "projected", 9),
        ("phone/truth_capture_eo.csv", "local", 31),
    ],
)
def test_plain_exterior_orientation(name: str, kind: str, count: int) -> None:
    root = os.environ.get("GEOREF_DATA")
    if not root:
        pytest.skip("GEOREF_DATA is not set: the folder with castle/ and phone/")
    folder = Path(root)
    path = (folder.parent if folder.name == "castle" else folder) / name
    if not path.is_file():
        pytest.skip(f"there is no {path}")
    table = read_poses(path)
    assert table.crs_kind == kind
    assert len(table.records) == count
    assert {record.status for record in table.records} == {"given"}
    assert all(record.has_pose and record.cov is None for record in table.records)


def test_what_was_estimated_of_a_camera_has_columns_at_the_end(tmp_path: Path) -> None:
    rng = np.random.default_rng(8)
    calibrated, unknown = record_of(rng, "a.jpg"), record_of(rng, "b.jpg")
    unknown = replace(unknown, intrinsics={"focal": (2761.25, 1.5), "k1": (-0.1, 2e-3)})
    write_poses([calibrated, unknown, PoseRecord("c.jpg", "rejected: unreadable")], tmp_path / "poses.csv", FRAME)
    header, *rows = [line.split(",") for line in (tmp_path / "poses.csv").read_text().splitlines() if line[0] != "#"]
    assert header[-5:] == ["angles_singular", "focal", "sigma_focal", "k1", "sigma_k1"]
    assert [row[-4:] for row in rows] == [[""] * 4, ["2761.25", "1.5", "-0.1", "0.002"], [""] * 4]
    assert len(read_poses(tmp_path / "poses.csv").records) == 3
