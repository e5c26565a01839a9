"""Broken projects through the command line: exit code 1, no traceback, and a message that names what, where and why."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from georef.cli import app
from georef.project import open_project
from georef.stages.survey import Survey, load_survey
from georef.terminal import exit_code
from tests.worlds.tiny import EPOCH

Break = Callable[[Path], object]
GNSS, EO, POINTS, MARKS = f"{EPOCH}_gnss.csv", "reference_eo.csv", "points.csv", f"marks_{EPOCH}.csv"


def change(name: str, pattern: str, new: str, count: int = 1) -> Break:
    """Replaces what a regular expression finds in a file, which must be there."""

    def apply(folder: Path) -> None:
        text = (folder / name).read_text(encoding="utf-8")
        changed, found = re.subn(pattern, new, text, count=count, flags=re.MULTILINE)
        assert found, (name, pattern)
        (folder / name).write_text(changed, encoding="utf-8")

    return apply


def every(*breaks: Break) -> Break:
    def apply(folder: Path) -> None:
        for one in breaks:
            one(folder)

    return apply


def swap_easting_and_northing(folder: Path) -> None:
    change(EO, r"^(\w+\.jpg),([\d.]+),([\d.]+)", r"\1,\3,\2", count=0)(folder)


CASES: dict[str, tuple[Break, list[str]]] = {
    "missing column": (
        change(GNSS, "sigma_n", "sigma_nn"),
        ["no column 'sigma_n'", "Did you mean 'sigma_nn'?", "map it in project.toml", f"row 2 of *{GNSS}"],
    ),
    "text for a number": (
        change(GNSS, r"^(n1\.jpg,)[\d.]+", r"\1about"),
        ["Column 'easting' has 'about', which is not a number.", "Correct the value.", f"row 4 of *{GNSS}"],
    ),
    "NaN": (
        change(EO, r"^(r2\.jpg,[\d.]+,)[\d.]+", r"\1nan"),
        ["Column 'northing' has 'nan', which is not a finite number.", f"row 5 of *{EO}"],
    ),
    "sigma 0": (
        change(POINTS, r"^(P\d+,control,.*),0\.003$", r"\1,0.0"),
        [
            "Control point 'P",
            "has sigma_h = 0.0, which would fix it exactly.",
            "Expected a positive",
            f"row 3 of *{POINTS}",
        ],
    ),
    "duplicate image": (
        change(EO, r"^(r3\.jpg,.*)$", r"\1\n\1"),
        ["'r3.jpg' is listed twice, in rows 6 and 7.", "Delete one of the two rows.", f"row 7 of *{EO}"],
    ),
    "reference image without a pose": (
        change(EO, r"^r4\.jpg,.*\n", ""),
        ["have no exterior orientation, the first is 'r4.jpg'", 'unmatched = "skip"', f"In *{EO}"],
    ),
    "pose without an image": (
        lambda folder: (folder / "reference" / "r5.jpg").unlink(),
        ["'r5.jpg' has an exterior orientation but no file", 'unmatched = "skip"', f"row 8 of *{EO}"],
    ),
    "unknown EPSG code": (
        change("project.toml", "EPSG:25832", "EPSG:99999"),
        ["CRS 'EPSG:99999' is not known to PROJ", "https://epsg.org"],
    ),
    "another zone declared": (
        change("project.toml", "EPSG:25832", "EPSG:25833"),
        [
            "The file declares the CRS EPSG:25832, the project has EPSG:25833.",
            "Correct [crs] horizontal",
            f"row 1 of *{EO}",
        ],
    ),
    "swapped axes": (
        swap_easting_and_northing,
        ["outside the area of use", "easting and northing are probably swapped", f"In *{EO}"],
    ),
    "heights of a geoid without its grid": (
        every(
            *(change(name, "height: ellipsoidal", "height: EPSG:7837") for name in (EO, GNSS, POINTS)),
            change("project.toml", '"ellipsoidal"', '"EPSG:7837"'),
        ),
        ["cannot be converted without the grid", "pyproj sync --file", "height = 'ellipsoidal'"],
    ),
    "other angles declared": (
        change(EO, r"Rx\(omega\) Ry\(phi\)", "Ry(phi) Rx(omega)"),
        ["The file declares the angles", "the project reads them as omega-phi-kappa", f"row 1 of *{EO}"],
    ),
    "mark outside its image": (
        change(MARKS, r"^(P\d+,n\d\.jpg,)[\d.]+", r"\g<1>900.0"),
        ["lies outside image", "640 x 480", "swapped x and y", f"row 2 of *{MARKS}"],
    ),
    "mark in an unknown image": (
        change(MARKS, r"^(P\d+),n\d\.jpg", r"\1,n9.jpg"),
        ["Image 'n9.jpg' has a mark and is not in the epoch.", f"row 2 of *{MARKS}"],
    ),
    "unknown role": (
        change(POINTS, ",control,", ",contrl,"),
        ["Column 'role' has 'contrl'.", "Did you mean 'control'?", f"of *{POINTS}"],
    ),
    "two cameras": (
        change("camera.csv", r"\Z", "cam2,640,480,560,560,322,238\n"),
        ["which of 2 cameras took image 'r0.jpg': cam, cam2", "Add the column to *reference_eo.csv", "In *camera.csv"],
    ),
    "focal length in millimetres": (
        change("camera.csv", "560.0,560.0", "24.0,24.0"),
        ["Camera 'cam' has fx = 24.0", "millimetres", "row 2 of *camera.csv"],
    ),
    "no table": (
        lambda folder: (folder / GNSS).rename(folder / "second_gnns.csv"),
        ["The file does not exist.", "Did you mean 'second_gnns.csv'?", f"In *{GNSS}"],
    ),
    "no folder of images": (
        lambda folder: (folder / EPOCH).rename(folder / "third"),
        ["The folder of images does not exist.", f"In *{EPOCH}"],
    ),
    "no images in the folder": (
        lambda folder: [p.unlink() for p in (folder / EPOCH).iterdir()],
        ["The folder holds no images.", "JPEG, PNG or TIFF"],
    ),
    "a spreadsheet for a table": (
        lambda folder: (folder / GNSS).write_bytes(b"PK\x03\x04\x00\x00\x00\x00"),
        ["zero bytes, as spreadsheets", "Export the table as CSV", f"In *{GNSS}"],
    ),
    "unknown key": (
        change("project.toml", "angle_unit", "angle_units"),
        [
            "Unknown key 'reference.angle_units'. Did you mean 'angle_unit'?",
            "The key 'reference.angle_unit' is missing.",
        ],
    ),
    "unknown key of the configuration": (
        change("project.toml", r"recording = false", "recordings = false"),
        ["Unknown key 'report.recordings'. Did you mean 'recording'?", "[config] of project.toml"],
    ),
    "not TOML": (change("project.toml", r"\[crs\]", "[crs"), ["Not valid TOML", "line 4", "project.toml"]),
}


def complaint(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    """What the command line says of a mistake of the user."""
    assert exit_code(app, list(arguments)) == 1
    captured = capsys.readouterr()
    assert "Traceback" not in captured.err + captured.out
    assert re.match(r"(WARNING: .*\n)*\w+Error: ", captured.err)
    return captured.err


def contains(message: str, text: str) -> bool:
    """Whether the text is there; '*' stands for a folder."""
    pattern = re.escape(text).replace(r"\*", r"\S*?")
    return re.search(pattern, message) is not None


@pytest.mark.parametrize("name", CASES)
def test_the_message_names_what_where_and_what_to_do(
    name: str, tiny_tables: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    breaks, texts = CASES[name]
    breaks(tiny_tables)
    message = complaint(capsys, "run", str(tiny_tables))
    for text in texts:
        assert contains(message, text), message
    assert not (tiny_tables / "work").exists()  # nothing was computed


def test_other_verbs_say_the_same(tiny_tables: Path, capsys: pytest.CaptureFixture[str]) -> None:
    CASES["sigma 0"][0](tiny_tables)
    assert complaint(capsys, "status", str(tiny_tables)) == complaint(capsys, "run", str(tiny_tables))


@pytest.mark.parametrize(
    ("arguments", "texts"),
    [
        (["--set", "adjust.gns=true"], ["Unknown key 'adjust.gns'. Did you mean 'gnss'?"]),
        (["--set", "adjust.gnss"], ["--set 'adjust.gnss' cannot be read.", "section.key=value"]),
        (["--set", 'adjust.constraints=["auto-gcps", "pose-priors"]'], ["choose one of", "count them twice"]),
        (["--set", "features.extractor=shift"], ["There is no extractor 'shift'.", "Did you mean 'sift'?"]),
        (["--set", "matching.options.ration=0.5"], ["cannot be made with these options", "Expected options: ratio"]),
        (["--preset", "sfit"], ["There is no preset 'sfit'. Did you mean 'sift'?"]),
        (["--epoch", "third"], ["There is no epoch 'third'.", "--epoch: second"]),
        (["--data", "nowhere"], ["were not found", "reference_eo.csv in nowhere", "--data DIR"]),
    ],
)
def test_wrong_options_are_explained(
    arguments: list[str], texts: list[str], tiny_tables: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    message = complaint(capsys, "run", str(tiny_tables), *arguments)
    for text in texts:
        assert text in message, message


def semicolons_and_decimal_commas(folder: Path) -> None:
    for name in (EO, GNSS, POINTS, MARKS):
        lines = (folder / name).read_text(encoding="utf-8").splitlines()
        changed = [line if line.startswith("#") else line.replace(",", ";").replace(".", ",") for line in lines]
        text = "\n".join(changed).replace(",jpg", ".jpg")
        (folder / name).write_text(text + "\n", encoding="utf-8")


def encoded(encoding: str, note: str = "") -> Break:
    def apply(folder: Path) -> None:
        for name in (EO, GNSS, POINTS, MARKS):
            text = (folder / name).read_text(encoding="utf-8")
            (folder / name).write_bytes((note + text).replace("\n", "\r\n").encode(encoding))

    return apply


@pytest.mark.parametrize(
    "rewrite",
    [semicolons_and_decimal_commas, encoded("utf-8-sig"), encoded("latin-1", "# Aufnahme Süd\n"), encoded("utf-16")],
    ids=["semicolons and decimal commas", "byte order mark", "Latin-1", "UTF-16"],
)
def test_tables_of_spreadsheets_read_the_same(
    rewrite: Break, tiny_tables: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plain = survey(tiny_tables)
    rewrite(tiny_tables)
    assert exit_code(app, ["status", str(tiny_tables)]) == 0
    assert "features  new" in capsys.readouterr().out
    again = survey(tiny_tables)
    assert [i.image_id for i in again.epoch.images] == [i.image_id for i in plain.epoch.images]
    for numbers in (_reference, _gnss, _points):
        assert np.array_equal(numbers(again), numbers(plain))


def survey(folder: Path) -> Survey:
    return load_survey(open_project(folder), EPOCH)


def _reference(found: Survey) -> np.ndarray:
    return np.array([i.world_from_cam.matrix() for i in found.reference.images if i.world_from_cam is not None])


def _gnss(found: Survey) -> np.ndarray:
    return np.array([i.gnss.position_in_world for i in found.epoch.images if i.gnss is not None])


def _points(found: Survey) -> np.ndarray:
    return np.array([[*p.point_in_world, *np.sqrt(np.diag(p.cov)), *p.marks[0].pixel] for p in found.check])
