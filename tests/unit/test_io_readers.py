"""Readers of exterior orientation, GNSS, points, cameras and marks, on small tables and on the real ones."""

from __future__ import annotations

import logging
import os
from pathlib import Path

import numpy as np
import pytest

from georef.errors import InputError
from georef.geometry.angles import (
    omega_phi_kappa_from_rotation,
    rotation_from_omega_phi_kappa,
    rotation_from_yaw_pitch_roll,
)
from georef.geometry.camera import Camera
from georef.io.camera_table import read_cameras
from georef.io.declarations import check_declared_crs, check_declared_height
from georef.io.exterior_orientation import read_exterior_orientation
from georef.io.gnss import read_gnss
from georef.io.marks import check_marks, read_marks
from georef.io.points import read_points
from georef.types.constraints import CheckKind


@pytest.fixture
def data() -> Path:
    folder = os.environ.get("GEOREF_DATA")
    if not folder:
        pytest.skip("GEOREF_DATA is not set: the folder with castle/ and phone/")
    root = Path(folder)
    root = root.parent if root.name == "castle" else root
    if not (root / "castle" / "points.csv").is_file():
        pytest.skip(f"there is no castle/points.csv in {root}")
    return root


def written(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "table.csv"
    path.write_text(text, encoding="utf-8")
    return path


def test_gon_and_semicolons(tmp_path: Path) -> None:
    path = written(
        tmp_path, "Bild;easting;northing;height;omega;phi;kappa\nä.jpg;456583,1692;5421034,7;178,1;100;-50;385,5\n"
    )
    table = read_exterior_orientation(
        path, crs_kind="projected", angles="omega-phi-kappa", angle_unit="gon", columns={"image": "Bild"}
    )
    assert table.image_ids == ("ä.jpg",)
    np.testing.assert_array_equal(table.positions_in_crs, [[456583.1692, 5421034.7, 178.1]])
    expected = rotation_from_omega_phi_kappa(np.deg2rad([90.0, -45.0, 346.95]))
    np.testing.assert_allclose(table.axes_from_cam[0], expected, atol=1e-14)
    assert table.intrinsics is None
    assert table.position_sigmas_m is None
    assert table.angle_sigmas_rad is None


def test_yaw_pitch_roll_in_radians_with_sigmas(tmp_path: Path) -> None:
    path = written(
        tmp_path,
        "image,x,y,z,yaw,pitch,roll,sigma_x,sigma_y,sigma_z,sigma_yaw,sigma_pitch,sigma_roll,fx,fy,cx,cy\n"
        "a,1,2,3,0.5,-0.1,0.02,0.01,0.02,0.03,0.001,0.002,0.003,800,801,320,240\n"
        "b,1,2,3,0.5,-0.1,0.02,,,,,,,800,801,320,240\n",
    )
    table = read_exterior_orientation(path, crs_kind="geocentric", angles="yaw-pitch-roll", angle_unit="rad")
    np.testing.assert_allclose(table.axes_from_cam[0], rotation_from_yaw_pitch_roll([0.5, -0.1, 0.02]))
    assert table.position_sigmas_m is not None
    assert table.angle_sigmas_rad is not None
    assert table.intrinsics is not None
    np.testing.assert_array_equal(table.position_sigmas_m, [[0.01, 0.02, 0.03], [np.nan] * 3])
    np.testing.assert_allclose(table.angle_sigmas_rad, [[0.001, 0.002, 0.003], [np.nan] * 3])
    np.testing.assert_array_equal(table.intrinsics, [[800, 801, 320, 240]] * 2)


def test_angle_sigmas_are_converted(tmp_path: Path) -> None:
    header = "image,x,y,z,omega,phi,kappa,sigma_omega,sigma_phi,sigma_kappa\n"
    path = written(tmp_path, header + "a,1,2,3,0,0,0,200,20,2\n")
    table = read_exterior_orientation(path, crs_kind="local", angles="omega-phi-kappa", angle_unit="gon")
    assert table.angle_sigmas_rad is not None
    np.testing.assert_allclose(table.angle_sigmas_rad, [[np.pi, np.pi / 10, np.pi / 100]])


def test_angles_that_look_like_radians_are_logged(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    lines = "".join(f"i{k},1,2,3,{k / 10},0.5,-1\n" for k in range(12))
    path = written(tmp_path, "image,x,y,z,omega,phi,kappa\n" + lines)
    with caplog.at_level(logging.WARNING):
        read_exterior_orientation(path, crs_kind="local", angles="omega-phi-kappa", angle_unit="deg")
    assert "are they radians?" in caplog.text


def test_gnss_with_headings(tmp_path: Path) -> None:
    header = "image,longitude,latitude,height,sigma_e,sigma_n,sigma_h,heading_deg\n"
    table = read_gnss(
        written(tmp_path, header + "a,8.4,48.9,170,1,1,2,\nb,8.4,48.9,170,1,1,2,271.5\n"), crs_kind="geographic"
    )
    np.testing.assert_array_equal(table.heading_deg, [np.nan, 271.5])
    np.testing.assert_array_equal(table.sigmas_m, [[1, 1, 2]] * 2)
    assert len(table) == 2
    assert table.declared_crs is None


def test_point_kinds(tmp_path: Path) -> None:
    header = "point,role,x,y,z,sigma_x,sigma_y,sigma_z,kind\n"
    path = written(tmp_path, header + "A,Control,1,2,3,1,1,1,\nB,check,1,2,3,1,1,1,Relative\n")
    table = read_points(path, crs_kind="local")
    assert table.roles == ("control", "check")
    assert table.kinds == (None, CheckKind.RELATIVE)


def test_camera_models(tmp_path: Path) -> None:
    path = written(
        tmp_path,
        "camera,width,height,fx,fy,cx,cy,k1,k2,k3,p1,p2\nplain,80,60,70,71,41,31,0,0,0,0,0\n"
        "brown,80.0,60,70,71,41,31,-0.1,0.01,,0.001,0\n",
    )
    cameras = read_cameras(path)
    assert cameras["plain"] == Camera("plain", 80, 60, 70.0, 71.0, 41.0, 31.0)
    assert cameras["brown"].distortion == (-0.1, 0.01, 0.001, 0.0)
    assert cameras["brown"].model == "brown"
    partial = read_cameras(written(tmp_path, "camera,width,height,fx,fy,cx,cy,k1\nc,80,60,70,71,41,31,-0.1\n"))
    assert partial["c"].distortion == (-0.1, 0.0, 0.0, 0.0)


def test_named_camera_models(tmp_path: Path) -> None:
    header = "camera,model,width,height,fx,fy,cx,cy,k1,k2,k3,k4,p1,p2\n"
    rows = (
        "pin,pinhole,80,60,70,71,41,31,,,,,,\n"
        "brown,Brown,80,60,70,71,41,31,-0.1,0.01,0.002,,1e-3,2e-3\n"
        "fish,fisheye,80,60,30,30,41,31,-0.01,1e-3,1e-4,1e-5,,\n"
        "ideal,fisheye,80,60,30,30,41,31,,,,,,\n"
    )
    cameras = read_cameras(written(tmp_path, header + rows))
    assert [c.model for c in cameras.values()] == ["pinhole", "brown", "fisheye", "fisheye"]
    assert cameras["pin"].distortion == ()
    assert cameras["brown"].distortion == (-0.1, 0.01, 1e-3, 2e-3, 0.002)
    assert cameras["fish"].distortion == (-0.01, 1e-3, 1e-4, 1e-5)
    assert cameras["ideal"] == Camera("ideal", 80, 60, 30.0, 30.0, 41.0, 31.0, (0.0,) * 4, "fisheye")


def test_a_rational_camera_and_unknown_coefficients(tmp_path: Path) -> None:
    header = "camera,model,width,height,fx,fy,cx,cy,k1,k2,k3,k4,k5,k6,p1,p2,estimate\n"
    rows = (
        "r,rational,80,60,70,71,41,31,0.1,0.2,0.3,0.4,0.5,0.6,1e-3,2e-3,focal k6 p1\n"
        "b,,80,60,70,71,41,31,,,,,,,,,k3 p2\nf,fisheye,80,60,70,71,41,31,,,,,,,,,k4\n"
    )
    cameras = read_cameras(written(tmp_path, header + rows))
    assert cameras["r"].distortion == (0.1, 0.2, 1e-3, 2e-3, 0.3, 0.4, 0.5, 0.6)
    assert [(c.model, c.estimate) for c in cameras.values()] == [
        ("rational", ("focal", "k6", "p1")),
        ("brown", ("k3", "p2")),
        ("fisheye", ("k4",)),
    ]


def test_cameras_that_are_not_known(tmp_path: Path) -> None:
    rows = "a,80,60,,,,,focal\nb,80,60,90,91,41,31,focal+k1\nc,80,60,70,71,41,31,\n"
    cameras = read_cameras(written(tmp_path, "camera,width,height,fx,fy,cx,cy,estimate\n" + rows))
    assert cameras["a"] == Camera("a", 80, 60, 96.0, 96.0, 40.0, 30.0, estimate=("focal", "cx", "cy", "aspect"))
    assert cameras["b"] == Camera("b", 80, 60, 90.0, 91.0, 41.0, 31.0, (0.0,) * 4, "brown", ("focal", "k1"))
    assert cameras["c"].estimate == ()
    only = read_cameras(written(tmp_path, "camera,width,height,estimate\na,60,80,focal\n"))
    assert (only["a"].fx, only["a"].cx, only["a"].cy) == (96.0, 30.0, 40.0)


def test_castle(data: Path) -> None:
    castle = data / "castle"
    reference = read_exterior_orientation(
        castle / "reference_eo.csv", crs_kind="projected", angles="omega-phi-kappa", angle_unit="deg"
    )
    assert len(reference) == 30
    assert reference.declared_crs == "EPSG:25832"
    assert reference.rows.tolist() == list(range(3, 33))
    np.testing.assert_array_equal(reference.positions_in_crs[0], [456583.1692, 5421034.7084, 178.1022])
    angles = np.rad2deg(omega_phi_kappa_from_rotation(reference.axes_from_cam[0]))
    np.testing.assert_allclose(angles, [-77.487748, -34.357561, 6.746322], atol=1e-9)
    gnss = read_gnss(castle / "new_epoch_gnss.csv", crs_kind="projected")
    points = read_points(castle / "points.csv", crs_kind="projected")
    for table in (reference, gnss, points):
        check_declared_crs(table, "EPSG:25832")
        check_declared_height(table, "ellipsoidal")
    assert len(gnss) == 9
    assert gnss.sigmas_m[0].tolist() == [1.5, 1.5, 3.0]
    assert [points.roles.count(role) for role in ("control", "check")] == [4, 40]


def test_castle_marks_fit_their_camera(data: Path) -> None:
    castle = data / "castle"
    camera = read_cameras(castle / "camera.csv")["cam"]
    assert camera == Camera("cam", 3072, 2048, 2759.48, 2764.16, 1521.19, 1007.31)
    marks = read_marks(castle / "marks_new_epoch.csv", repeats="mean")
    points = read_points(castle / "points.csv", crs_kind="projected")
    gnss = read_gnss(castle / "new_epoch_gnss.csv", crs_kind="projected")
    check_marks(marks, points.point_ids, dict.fromkeys(gnss.image_ids, (camera.width, camera.height)))
    assert len(marks) == 151 - 6  # six points are marked twice in an image
    assert marks.pixels[0].tolist() == [1654.282, 1576.584]
    assert set(marks.sigmas_px) == {0.5}


def test_repeated_marks_become_their_mean(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = written(tmp_path, "point,image,x,y,sigma_px\nP,a,10,20,0.5\nP,b,1,2,0.5\nP,a,11,20.5,0.7\n")
    with caplog.at_level(logging.WARNING):
        marks = read_marks(path, repeats="mean")
    assert list(zip(marks.point_ids, marks.image_ids, strict=True)) == [("P", "a"), ("P", "b")]
    np.testing.assert_array_equal(marks.pixels, [[10.5, 20.25], [1, 2]])
    np.testing.assert_array_equal(marks.sigmas_px, [0.7, 0.5])
    assert marks.rows.tolist() == [2, 3]
    assert "1 repeated marks" in caplog.text


def test_phone(data: Path) -> None:
    table = read_exterior_orientation(
        data / "phone" / "reference_eo.csv", crs_kind="local", angles="omega-phi-kappa", angle_unit="deg"
    )
    assert table.declared_crs == "local"
    assert table.intrinsics is not None
    assert table.intrinsics.shape == (27, 4)
    check_declared_crs(table, "local")


def test_surveyed_points_of_another_program(data: Path) -> None:
    path = data / "cu_sbr" / "GCP_CU_SBR_Ellipsoidal_h.csv"
    if not path.is_file():
        pytest.skip(f"there is no {path}")
    columns = {"image": "Name", "height": "Ellipsoidal Height"}
    columns |= {"sigma_e": "AccHor", "sigma_n": "AccHor", "sigma_h": "AccVer"}
    table = read_gnss(path, crs_kind="projected", columns=columns)
    first = table.image_ids.index("GCP02")
    np.testing.assert_array_equal(table.positions_in_crs[first], [717429.126, 1606454.237, 3.4845])
    np.testing.assert_array_equal(table.sigmas_m[first], [0.02, 0.02, 0.05])


def test_gnss_without_any_sigma_has_none(tmp_path: Path) -> None:
    table = read_gnss(written(tmp_path, "image,x,y,z\na,1,2,3\nb,4,5,6\n"), crs_kind="local")
    assert table.unstated
    assert np.isnan(table.sigmas_m).all()


@pytest.mark.parametrize("header", ["image,x,y,z,sigma_x", "image,x,y,z,Sigma_East"])
def test_some_sigmas_alone_are_refused(tmp_path: Path, header: str) -> None:
    with pytest.raises(InputError, match=r"has no column 'sigma_[xy]'"):
        read_gnss(written(tmp_path, f"{header}\na,1,2,3,0.1\n"), crs_kind="local")
