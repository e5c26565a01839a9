"""What a user reads when a table is broken: the fault with its value, what was expected, what to do, row and file."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from georef.errors import InputError
from georef.io.camera_table import read_cameras
from georef.io.declarations import AngleUnit, check_declared_crs, check_declared_height
from georef.io.exterior_orientation import read_exterior_orientation
from georef.io.gnss import read_gnss
from georef.io.marks import check_marks, read_marks
from georef.io.points import read_points
from georef.io.poses import read_poses
from georef.io.tables import TableFormat, read_table

EO_HEADER = "image,easting,northing,height,omega,phi,kappa\n"
GNSS_HEADER = "image,easting,northing,height,sigma_e,sigma_n,sigma_h\n"
POINT_HEADER = "point,role,easting,northing,height,sigma_e,sigma_n,sigma_h\n"
CAMERA_HEADER = "camera,width,height,fx,fy,cx,cy\n"
MARK_HEADER = "point,image,x,y,sigma_px\n"


def eo(path: Path, unit: AngleUnit = "deg"):
    return read_exterior_orientation(path, crs_kind="projected", angles="omega-phi-kappa", angle_unit=unit)


def gnss(path: Path):
    return read_gnss(path, crs_kind="projected")


def points(path: Path):
    return read_points(path, crs_kind="projected")


CASES: dict[str, tuple[Callable, str, list[str], int | None]] = {
    "missing column": (
        gnss,
        "image,easting,northing,height,sigma_e,sigma_nn,sigma_h\na.jpg,1,2,3,1,1,1\n",
        ["no column 'sigma_n'", "sigma_e, sigma_nn, sigma_h", "Did you mean 'sigma_nn'?", "table.columns = {"],
        1,
    ),
    "x and y for a projected CRS": (
        eo,
        "image,X,Y,Z,omega,phi,kappa\na.jpg,1,2,3,0,0,0\n",
        ["'easting'", 'columns = { easting = "x", northing = "y", height = "z" }', "never guessed"],
        1,
    ),
    "text for a number": (
        gnss,
        f"# a comment\n\n{GNSS_HEADER}a.jpg,1,2,3,1,1,1\nb.jpg,1,about 2,3,1,1,1\n",
        ["Column 'northing' has 'about 2', which is not a number.", "a decimal point", "Correct the value"],
        5,
    ),
    "underscore in a number": (gnss, f"{GNSS_HEADER}a.jpg,1_0,2,3,1,1,1\n", ["'easting' has '1_0'"], 2),
    "NaN": (gnss, f"{GNSS_HEADER}a.jpg,1,2,NaN,1,1,1\n", ["'height' has 'NaN', which is not a finite number"], 2),
    "infinity": (gnss, f"{GNSS_HEADER}a.jpg,1,2,3,inf,1,1\n", ["'sigma_e' has 'inf', which is not a finite"], 2),
    "empty number": (gnss, f"{GNSS_HEADER}a.jpg,1,,3,1,1,1\n", ["Column 'northing' is empty.", "Fill it in"], 2),
    "empty id": (gnss, f"{GNSS_HEADER},1,2,3,1,1,1\n", ["Column 'image' is empty."], 2),
    "GNSS sigma 0": (
        gnss,
        f"{GNSS_HEADER}a.jpg,1,2,3,1.5,1.5,0\n",
        ["The position of image 'a.jpg' has sigma_h = 0.0, which would fix it exactly.", "delete the row"],
        2,
    ),
    "negative sigma": (gnss, f"{GNSS_HEADER}a.jpg,1,2,3,-1,1,1\n", ["sigma_e = -1.0", "never negative"], 2),
    "control sigma 0": (
        points,
        f"{POINT_HEADER}P16,control,1,2,3,1,1,1\nP17,control,1,2,3,0.01,0.01,0.0\n",
        [
            "Control point 'P17' has sigma_h = 0.0, which would fix it exactly.\n"
            "Expected a positive standard deviation in metres (surveyed points: 0.01 to 0.05).\n"
            "Correct the value, or list the point as a check point.\n"
        ],
        3,
    ),
    "wrong role": (
        points,
        f"{POINT_HEADER}P1,contrl,1,2,3,1,1,1\n",
        ["Column 'role' has 'contrl'.", "control, check", "Did you mean 'control'?"],
        2,
    ),
    "duplicate image": (
        eo,
        f"{EO_HEADER}a.jpg,1,2,3,0,0,0\nb.jpg,1,2,3,0,0,0\n# note\na.jpg,1,2,3,0,0,0\n",
        ["Image 'a.jpg' is listed twice, in rows 2 and 5.", "Delete one"],
        5,
    ),
    "duplicate mark": (
        read_marks,
        f"{MARK_HEADER}P1,a.jpg,1,2,1\nP1,b.jpg,1,2,1\nP1,a.jpg,1,2,1\n",
        ["The mark of point 'P1' in image 'a.jpg' is listed twice, in rows 2 and 4."],
        4,
    ),
    "repeated marks that do not agree": (
        lambda path: read_marks(path, repeats="mean"),
        f"{MARK_HEADER}P1,a.jpg,1,2,0.5\nP1,b.jpg,1,2,0.5\nP1,a.jpg,1,5.5,0.5\n",
        [
            "Point 'P1' is marked more than once in image 'a.jpg', 1.75 px from the mean.",
            "1 more: rows 4",
            "Delete the",
        ],
        2,
    ),
    "ragged row": (
        eo,
        f"{EO_HEADER}a.jpg,1,2,3,0,0,0\nb.jpg,1,2,3,0,0\n",
        ["The row has 6 values, the header has 7 names (delimited by commas).", "Correct the row."],
        3,
    ),
    "decimal commas between commas": (
        gnss,
        f"{GNSS_HEADER}a.jpg,1,5,2,5,3,5,1,1,1\n",
        ["The row has 10 values", "decimal commas", "semicolons"],
        2,
    ),
    "mixed decimals": (
        gnss,
        GNSS_HEADER.replace(",", ";") + "a.jpg;1.5;2.5;3.5;1;1;1\nb.jpg;1,5;2;3;1;1;1\n",
        ["'1,5'", "'1.5'", 'decimal = ","'],
        3,
    ),
    "thousands or decimals": (
        gnss,
        GNSS_HEADER.replace(",", ";") + "a.jpg;456,583;421,034;178;1;1;1\n",
        ["The comma of '456,583' may be", "thousands separator", 'decimal = ","'],
        2,
    ),
    "two delimiters": (
        gnss,
        "image;easting,northing;height,sigma\n",
        ["delimited by commas or by semicolons", "delimiter ="],
        1,
    ),
    "no header": (gnss, "a.jpg,1,2.5,3\n", ["The first row holds values", "Add a header row"], 1),
    "column twice": (gnss, "image,Easting,easting\n", ["column 'Easting' twice"], 1),
    "column without a name": (gnss, "image,easting,\na,1,2\n", ["a column without a name"], 1),
    "open quote": (gnss, f'{GNSS_HEADER}"a.jpg,1,2,3,1,1,1\nb.jpg,1,2,3,1,1,1\n', ["a quote is not closed"], 2),
    "quote at the end": (gnss, f'{GNSS_HEADER}a.jpg,1,2,3,1,1,"1\n', ["a quote is not closed"], 2),
    "no rows": (gnss, GNSS_HEADER, ["a header and no rows"], None),
    "empty file": (gnss, "", ["The file is empty.", "a header row"], None),
    "only comments": (gnss, "# CRS: EPSG:25832\n\n", ["only comments"], None),
    "zero bytes": (gnss, "PK\0\0", ["not text", "Export the table as CSV"], None),
    "gon read as degrees": (
        eo,
        f"{EO_HEADER}a.jpg,1,2,3,0,0,10\nb.jpg,1,2,3,0,0,385.5\n",
        ["Column 'kappa' has 385.5, more than a full turn in degrees.", 'angle_unit = "gon"'],
        3,
    ),
    "degrees read as radians": (
        lambda path: eo(path, "rad"),
        f"{EO_HEADER}a.jpg,1,2,3,0,0,90\n",
        ["more than a full turn in radians", 'angle_unit = "deg"'],
        2,
    ),
    "beyond gon": (lambda path: eo(path, "gon"), f"{EO_HEADER}a.jpg,1,2,3,0,0,401\n", ["\nCorrect the value."], 2),
    "declared gon": (
        eo,
        f"# Angles: gon\n{EO_HEADER}a.jpg,1,2,3,0,0,1\n",
        ["declares its angles in gon, the project reads degrees", 'angle_unit = "gon"'],
        1,
    ),
    "declared other rotation": (
        eo,
        f"# CRS: EPSG:25832\n# R = Rz(kappa) Ry(phi) Rx(omega)\n{EO_HEADER}a.jpg,1,2,3,0,0,1\n",
        ["'Rz(kappa) Ry(phi) Rx(omega)'", "R = Rx(omega) Ry(phi) Rz(kappa)"],
        2,
    ),
    "declared other image axes": (
        eo,
        f"# R = Rx(omega) Ry(phi) Rz(kappa), image (right, down, front) to grid\n{EO_HEADER}a.jpg,1,2,3,0,0,1\n",
        ["image (right, down, front)", "image (right, top, back)"],
        1,
    ),
    "declared yaw, pitch, roll": (
        eo,
        f"# Angles: yaw-pitch-roll, degrees\n{EO_HEADER}a.jpg,1,2,3,0,0,1\n",
        ["'yaw-pitch-roll'", "omega-phi-kappa"],
        1,
    ),
    "declared twice": (
        gnss,
        f"# CRS: EPSG:25832\n# CRS: EPSG:25833\n{GNSS_HEADER}a,1,2,3,1,1,1\n",
        ["two values of crs"],
        2,
    ),
    "half of the intrinsics": (
        eo,
        EO_HEADER.strip() + ",fx,fy,cx\na.jpg,1,2,3,0,0,0,1,1,1\n",
        ["no column 'cy'"],
        1,
    ),
    "focal length 0 in a row": (
        eo,
        EO_HEADER.strip() + ",fx,fy,cx,cy\na.jpg,1,2,3,0,0,0,1,0,1,1\n",
        ["'fy' has 0.0", "positive focal length in pixels"],
        2,
    ),
    "some sigmas": (
        eo,
        EO_HEADER.strip() + ",sigma_e,sigma_n,sigma_h\na.jpg,1,2,3,0,0,0,1,,1\n",
        ["Image 'a.jpg' has some of sigma_e, sigma_n, sigma_h", "empty them all"],
        2,
    ),
    "k4 of a brown camera": (
        read_cameras,
        CAMERA_HEADER.strip() + ",k1,k2,p1,p2,k4\ncam,3000,2000,2800,2800,1500,1000,-0.1,0,0,0,0.01\n",
        ["Column 'k4' has 0.01", "'brown' does not have", "brown: k1, k2, p1, p2, k3", "k4 fixed at 0"],
        2,
    ),
    "p1 of a fisheye": (
        read_cameras,
        CAMERA_HEADER.strip() + ",model,k1,p1\ncam,3000,2000,900,900,1500,1000,fisheye,-0.01,0.001\n",
        ["Column 'p1' has 0.001", "'fisheye' does not have", "fisheye: k1, k2, k3, k4"],
        2,
    ),
    "k1 of a pinhole": (
        read_cameras,
        CAMERA_HEADER.strip() + ",model,k1\ncam,3000,2000,2800,2800,1500,1000,pinhole,-0.1\n",
        ["Column 'k1' has -0.1", "'pinhole' does not have", "name the right model"],
        2,
    ),
    "skewed pixels": (
        read_cameras,
        CAMERA_HEADER.strip() + ",skew\ncam,3000,2000,2800,2800,1500,1000,0.5\n",
        ["Column 'skew' has 0.5", "'pinhole' does not have"],
        2,
    ),
    "a model that is not there": (
        read_cameras,
        CAMERA_HEADER.strip() + ",model\ncam,3000,2000,2800,2800,1500,1000,fish-eye\n",
        ["Column 'model' has 'fish-eye'", "pinhole, brown, fisheye", "Did you mean 'fisheye'"],
        2,
    ),
    "an unknown that cannot be estimated": (
        read_cameras,
        CAMERA_HEADER.strip() + ",estimate\ncam,3000,2000,2800,2800,1500,1000,focal skew\n",
        ["Column 'estimate' has 'focal skew'", '"focal k1"', "leave it empty"],
        2,
    ),
    "an unknown that the model does not have": (
        read_cameras,
        CAMERA_HEADER.strip() + ",model,estimate\ncam,3000,2000,2800,2800,1500,1000,brown,focal k4\n",
        ["Column 'estimate' has 'k4'", "'brown' does not have", "rational: k1 to k6", "name the right model"],
        2,
    ),
    "no focal length, and not declared unknown": (
        read_cameras,
        CAMERA_HEADER.strip() + ",estimate\na,3000,2000,,,,,focal\nb,3000,2000,,2800,1500,1000,\n",
        ["Column 'fx' is empty"],
        3,
    ),
    "focal length in millimetres": (
        read_cameras,
        f"{CAMERA_HEADER}cam,8192,5460,35,35,4096,2730\n",
        ["Camera 'cam' has fx = 35.0 for an image of 8192 x 5460.", "at least 819.2", "millimetres"],
        2,
    ),
    "negative focal length": (read_cameras, f"{CAMERA_HEADER}cam,80,60,70,-70,40,30\n", ["fy = -70.0"], 2),
    "principal point from the centre": (
        read_cameras,
        f"{CAMERA_HEADER}cam,80,60,70,70,-1.5,0.5\n",
        ["cx = -1.5, outside its image of 80 x 60", "Add half the size"],
        2,
    ),
    "half a pixel": (read_cameras, f"{CAMERA_HEADER}cam,80.5,60,70,70,40,30\n", ["80.5", "a whole number"], 2),
    "no width": (read_cameras, f"{CAMERA_HEADER}cam,0,60,70,70,40,30\n", ["width = 0"], 2),
    "heading": (gnss, f"{GNSS_HEADER.strip()},heading_deg\na.jpg,1,2,3,1,1,1,700\n", ["'heading_deg' has 700.0"], 2),
    "latitude": (
        lambda path: read_gnss(path, crs_kind="geographic"),
        "image,longitude,latitude,height,sigma_e,sigma_n,sigma_h\na.jpg,48,98,3,1,1,1\n",
        ["'latitude' has 98.0", "swapped"],
        2,
    ),
    "rejected with numbers": (
        read_poses,
        EO_HEADER.strip() + ",status\na.jpg,1,2,3,0,0,0,rejected: few_inliers\n",
        ["Image 'a.jpg' is rejected and has easting = 1.", "correct the status"],
        2,
    ),
    "localized without numbers": (
        read_poses,
        EO_HEADER.strip() + ",status\na.jpg,,,,,,,localized\n",
        ["'omega' is empty"],
        2,
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_message(case: str, tmp_path: Path) -> None:
    read, text, parts, row = CASES[case]
    path = tmp_path / "table.csv"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(InputError) as caught:
        read(path)
    message = str(caught.value)
    for part in parts:
        assert part in message
    assert message.endswith(f"In row {row} of {path}." if row else f"In {path}.")


def test_missing_file_names_the_nearest(tmp_path: Path) -> None:
    (tmp_path / "gnss.csv").write_text(GNSS_HEADER)
    with pytest.raises(InputError, match=r"does not exist.\nDid you mean 'gnss.csv'\?") as caught:
        gnss(tmp_path / "gns.csv")
    assert str(caught.value).endswith(f"In {tmp_path / 'gns.csv'}.")


def test_missing_folder(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="GEOREF_DATA"):
        gnss(tmp_path / "nowhere" / "gnss.csv")


def test_directory_instead_of_file(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="is a directory") as caught:
        gnss(tmp_path)
    assert str(tmp_path) in str(caught.value)


def test_declared_crs_of_another_project(tmp_path: Path) -> None:
    path = tmp_path / "gnss.csv"
    path.write_text(f"# CRS: EPSG:25832, height: ellipsoidal GRS80, metres.\n{GNSS_HEADER}a.jpg,1,2,3,1,1,1\n")
    table = gnss(path)
    check_declared_crs(table, "epsg:25832")
    check_declared_height(table, "ellipsoidal")
    with pytest.raises(InputError) as caught:
        check_declared_crs(table, "EPSG:25833")
    message = str(caught.value)
    assert "declares the CRS EPSG:25832, the project has EPSG:25833" in message
    assert "Correct [crs] horizontal in project.toml (or --set crs.horizontal=EPSG:25832)" in message
    assert message.endswith(f"In row 1 of {path}.")
    with pytest.raises(InputError, match=r"declares heights 'ellipsoidal', the project has 'EPSG:7837'"):
        check_declared_height(table, "EPSG:7837")


def test_marks_that_do_not_fit(tmp_path: Path) -> None:
    path = tmp_path / "marks.csv"
    path.write_text(f"{MARK_HEADER}P1,a.jpg,10,20,0.5\nP2,a.jpg,10,61,0.5\nP2,b.jpg,-1,2,0.5\n")
    marks = read_marks(path)
    sizes = {"a.jpg": (80, 60), "b.jpg": (80, 60)}
    with pytest.raises(InputError) as caught:
        check_marks(marks, ["P1", "P2"], sizes)
    message = str(caught.value)
    assert "The mark of point 'P2' at (10.0, 61.0) lies outside image 'a.jpg', which has 80 x 60 pixels." in message
    assert "The same is wrong in 1 more: rows 4." in message
    assert "resized" in message
    assert message.endswith(f"In row 3 of {path}.")
    with pytest.raises(InputError, match="Point 'P2' is marked and has no coordinates"):
        check_marks(marks, ["P1"], sizes)
    with pytest.raises(InputError, match=r"Image 'b.jpg' has a mark and is not in the epoch[\s\S]*row 4 of"):
        check_marks(marks, ["P1", "P2"], {"a.jpg": (80, 60)})


@pytest.mark.parametrize(
    ("stated", "part"),
    [
        (TableFormat(encoding="utf-9"), "unknown encoding"),
        (TableFormat(encoding="ascii"), "can't decode"),
        (TableFormat(delimiter="::"), "The delimiter '::' cannot be one"),
    ],
)
def test_stated_format_that_cannot_be(stated: TableFormat, part: str, tmp_path: Path) -> None:
    path = tmp_path / "table.csv"
    path.write_text("image\nStraße\n", encoding="utf-8")
    with pytest.raises(InputError, match=part) as caught:
        read_table(path, table_format=stated)
    assert "project.toml" in str(caught.value)
