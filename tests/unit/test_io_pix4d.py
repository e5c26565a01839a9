"""Parameters as Pix4D exports them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from georef.errors import InputError
from georef.geometry.angles import rotation_from_omega_phi_kappa
from georef.geometry.camera import project
from georef.io.pix4d import (
    read_pix4d_adjusted,
    read_pix4d_camera,
    read_pix4d_correlations,
    read_pix4d_gcps,
    read_pix4d_given,
    read_pix4d_offset,
    read_pix4d_poses,
)

_HEAD = """fileName imageWidth imageHeight
camera matrix K [3x3]
radial distortion [3x1]
tangential distortion [2x1]
camera position t [3x1]
camera rotation R [3x3]
camera model m = K [R|-Rt] X

"""
_ANGLES_DEG = (1.5, -2.0, 25.0)


def _image(name: str, position: tuple[float, float, float]) -> str:
    cam_from_grid = rotation_from_omega_phi_kappa(np.radians(_ANGLES_DEG)).T
    rows = "\n".join(" ".join(f"{v:.17f}" for v in row) for row in cam_from_grid)
    k = "800.0 0 410.0\n0 800.0 295.0\n0 0 1\n-0.05 0.02 -0.09\n0.0009 -0.001\n"
    return f"{name} 820 600\n{k}{' '.join(map(str, position))}\n{rows}\n"


def _poses(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "calibrated_camera_parameters.txt"
    path.write_text(text, encoding="utf-8")
    return path


def test_a_camera_projects_as_the_file_defines_it(tmp_path: Path) -> None:
    text = _HEAD + _image("a 1.JPG", (10.0, 20.0, 100.0)) + _image("b.JPG", (30.0, 20.0, 100.0))
    poses = read_pix4d_poses(_poses(tmp_path, text))
    assert poses.image_ids == ("a 1.JPG", "b.JPG")
    assert poses.cameras[0] is poses.cameras[1]
    assert poses.positions.tolist() == [[10.0, 20.0, 100.0], [30.0, 20.0, 100.0]]
    ground = np.array([20.0, 30.0, 2.0])
    in_cam = poses.cam_from_grid[0] @ (ground - poses.positions[0])
    assert in_cam[2] > 90  # looks down
    x, y = in_cam[:2] / in_cam[2]
    r2 = x * x + y * y
    radial = 1 - 0.05 * r2 + 0.02 * r2**2 - 0.09 * r2**3
    t1, t2 = 0.0009, -0.001
    wanted = (
        410.0 + 800.0 * (x * radial + 2 * t1 * x * y + t2 * (r2 + 2 * x * x)),
        295.0 + 800.0 * (y * radial + 2 * t2 * x * y + t1 * (r2 + 2 * y * y)),
    )
    assert project(poses.cameras[0], in_cam[None])[0] == pytest.approx(wanted, abs=1e-9)


@pytest.mark.parametrize(
    ("old", "new", "said", "row"),
    [
        ("820 600", "820", "Expected the name of an image", 9),
        ("0.0009 -0.001", "0.0009", "has 1 values where 2 belong", 14),
        ("0 0 1", "0 0 one", "'one' is not a finite number", 12),
        ("radial distortion [3x1]", "fisheye distortion", "does not begin as Pix4D's", None),
    ],
)
def test_what_cannot_be_is_refused_with_its_row(tmp_path: Path, old: str, new: str, said: str, row: int | None) -> None:
    path = _poses(tmp_path, (_HEAD + _image("a.JPG", (0, 0, 0))).replace(old, new, 1))
    with pytest.raises(InputError, match=said) as caught:
        read_pix4d_poses(path)
    assert caught.value.row == row


def test_a_file_that_is_cut_off_is_refused(tmp_path: Path) -> None:
    text = _HEAD + _image("a.JPG", (0, 0, 0)).rsplit("\n", 2)[0]
    with pytest.raises(InputError, match="has 0 values where 3 belong"):
        read_pix4d_poses(_poses(tmp_path, text))


_EXTERNAL = (
    "imageName, cameraIndex, cameraName, X_opt, Y_opt, Z_opt, X_gps, Y_gps, Z_gps, X_acc, Y_acc, Z_acc, Omega, Phi, "
    "Kappa, X_uncertainty, Y_uncertainty, Z_uncertainty, Omega_uncertainty, Phi_uncertainty, Kappa_uncertainty, "
    "inlierProb\n"
    "a.JPG, 0, P1 (RGB)(1), 500.1, 600.2, 70.3, 500.0, 600.0, 70.0, 0.02, 0.03, 0.05, 1.5, -2.0, 25.0, 0.006, 0.007, "
    "0.08, 0.003, 0.004, 0.005, 1.0\n"
)


def test_adjusted_poses_and_measured_positions_stand_in_one_table(tmp_path: Path) -> None:
    path = tmp_path / "error.txt"
    path.write_text(_EXTERNAL, encoding="utf-8")
    adjusted, given = read_pix4d_adjusted(path), read_pix4d_given(path)
    assert adjusted.image_ids == given.image_ids == ("a.JPG",)
    assert adjusted.cameras == ("P1 (RGB)(1)",)
    assert adjusted.positions_in_crs.tolist() == [[500.1, 600.2, 70.3]]
    assert given.positions_in_crs.tolist() == [[500.0, 600.0, 70.0]]
    assert given.sigmas_m.tolist() == [[0.02, 0.03, 0.05]]
    assert adjusted.axes_from_cam[0] == pytest.approx(rotation_from_omega_phi_kappa(np.radians(_ANGLES_DEG)))
    assert adjusted.position_sigmas_m is not None
    assert adjusted.angle_sigmas_rad is not None
    assert adjusted.position_sigmas_m.tolist() == [[0.006, 0.007, 0.08]]
    assert np.degrees(adjusted.angle_sigmas_rad[0]) == pytest.approx([0.003, 0.004, 0.005])


def test_the_internal_camera_is_turned_into_pixels(tmp_path: Path) -> None:
    path = tmp_path / "internal.cam"
    lines = ["#Focal Length mm assuming a sensor width of 35.0x23.4mm", "F 35.1", "Px 17.4", "Py 11.7"]
    values = {"K1": -0.05, "K2": 0.02, "K3": -0.09, "T1": 0.001, "T2": -0.002}
    path.write_text("\n".join([*lines, *(f"{k} {v}" for k, v in values.items())]), encoding="utf-8")
    camera = read_pix4d_camera(path, (7000, 4680))
    assert (camera.fx, camera.cx, camera.cy) == pytest.approx((7020.0, 3480.0, 2340.0))
    assert camera.distortion == (-0.05, 0.02, 0.001, -0.002, -0.09)
    assert camera.model == "brown"
    path.write_text("\n".join(lines), encoding="utf-8")
    with pytest.raises(InputError, match="no value of K1"):
        read_pix4d_camera(path, (7000, 4680))


def test_ground_control_without_coordinates_is_not_a_number(tmp_path: Path) -> None:
    path = tmp_path / "gcps.txt"
    names = [f"GCP {what} {axis}" for what in ("measured", "estimated") for axis in "XYZ"]
    path.write_text(
        f"GCP label, {', '.join(names)}, GCP weight, GCP visible in # images\n"
        "P1, 1.0, 2.0, 3.0, 1.1, 2.1, 3.1, 1.0, 9\nP2, 0.0, 0.0, 0.0, 5.0, 6.0, 7.0, 1.0, 8\n",
        encoding="utf-8",
    )
    gcps = read_pix4d_gcps(path)
    assert gcps.point_ids == ("P1", "P2")
    assert gcps.images.tolist() == [9, 8]
    assert gcps.measured[0].tolist() == [1.0, 2.0, 3.0]
    assert np.isnan(gcps.measured[1]).all()
    assert gcps.estimated[1].tolist() == [5.0, 6.0, 7.0]


def test_offset_and_correlations(tmp_path: Path) -> None:
    path = tmp_path / "small.txt"
    path.write_text("717541.000 1606017.000 4.000", encoding="utf-8")
    assert read_pix4d_offset(path).tolist() == [717541.0, 1606017.0, 4.0]
    path.write_text("P1 (RGB)\r\nPerspectiveCamera5\r\nF,C0_x\r\n1, -0.12\r\n-0.12, 1\r\n", encoding="utf-8")
    names, matrix = read_pix4d_correlations(path)
    assert names == ("F", "C0_x")
    assert matrix.tolist() == [[1.0, -0.12], [-0.12, 1.0]]
    path.write_text("P1 (RGB)\nPerspectiveCamera5\nF,C0_x\n1, -0.12\n", encoding="utf-8")
    with pytest.raises(InputError, match="1 rows for 2 parameters"):
        read_pix4d_correlations(path)
