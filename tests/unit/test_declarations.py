"""What a project can declare: several cameras, several reference epochs, unknown intrinsics, panoramas."""

from __future__ import annotations

import io
import os
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image as PillowImage

from georef.doctor import check_project
from georef.errors import ConfigError, InputError
from georef.executor import Executor
from georef.features.images import read_image
from georef.io.exif import size_and_focal
from georef.io.head_table import read_heads
from georef.project import open_project
from georef.stages.base import feature_id
from georef.stages.init_project import Answers, init_project
from georef.stages.network import declared_noise
from georef.stages.panoramas import cut_missing
from georef.stages.survey import Survey, load_survey
from tests.worlds.tiny import EPOCH

SECOND_CAMERA = "wide,640,480,400,400,320,240\n"


def edited(folder: Path, name: str, old: str, new: str) -> None:
    path = folder / name
    text = path.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new), encoding="utf-8")


def with_column(folder: Path, name: str, column: str, values: dict[str, str]) -> None:
    """Adds a column to a table, empty where no value is given."""
    lines = (folder / name).read_text(encoding="utf-8").splitlines()
    out = []
    for line in lines:
        image = line.split(",")[0]
        out.append(line if line.startswith("#") else f"{line},{column if image == 'image' else values.get(image, '')}")
    (folder / name).write_text("\n".join(out) + "\n", encoding="utf-8")


def without_points(folder: Path) -> None:
    text = (folder / "project.toml").read_text(encoding="utf-8")
    start, end = text.index("[points]"), text.index("[config")
    (folder / "project.toml").write_text(text[:start] + text[end:], encoding="utf-8")


def survey(folder: Path) -> Survey:
    return load_survey(open_project(folder), EPOCH)


def cameras(folder: Path) -> dict[str, str]:
    found = survey(folder)
    return {i.image_id: i.camera.camera_id for i in (*found.reference.images, *found.epoch.images)}


@pytest.fixture
def two_cameras(tiny_tables: Path) -> Path:
    """All reference images say their camera; of the new ones n1 alone does not."""
    with (tiny_tables / "camera.csv").open("a", encoding="utf-8") as stream:
        stream.write(SECOND_CAMERA)
    with_column(tiny_tables, "reference_eo.csv", "camera", {f"r{i}.jpg": ("cam", "wide")[i % 2] for i in range(8)})
    with_column(tiny_tables, f"{EPOCH}_gnss.csv", "camera", {"n0.jpg": "wide", "n2.jpg": "cam"})
    return tiny_tables


def test_an_image_has_the_camera_that_its_row_or_its_folder_names(two_cameras: Path) -> None:
    without_points(two_cameras)
    images = two_cameras / EPOCH
    (images / "wide").mkdir()
    (images / "n1.jpg").rename(images / "wide" / "n1.jpg")
    edited(two_cameras, f"{EPOCH}_gnss.csv", "n1.jpg", "wide/n1.jpg")
    found = cameras(two_cameras)
    assert [found[f"r{i}.jpg"] for i in range(3)] == ["cam", "wide", "cam"]
    assert (found["n0.jpg"], found["wide/n1.jpg"], found["n2.jpg"]) == ("wide", "wide", "cam")


def test_an_image_without_a_camera_is_named_with_the_remedy(two_cameras: Path) -> None:
    with pytest.raises(InputError, match=r"(?s)which of 2 cameras took image 'n1\.jpg'.*column `camera`.*camera\.csv"):
        survey(two_cameras)


def test_a_camera_that_the_table_lacks_is_named_with_its_row(two_cameras: Path) -> None:
    edited(two_cameras, f"{EPOCH}_gnss.csv", ",wide", ",wied")
    with pytest.raises(InputError, match=r"(?s)'n0\.jpg' is said to be of camera 'wied'.*row 3 of .*second_gnss\.csv"):
        survey(two_cameras)


def test_a_reference_camera_cannot_be_unknown(tiny_tables: Path) -> None:
    (tiny_tables / "camera.csv").write_text("camera,width,height,estimate\ncam,640,480,focal\n", encoding="utf-8")
    expected = r"(?s)'cam' is to be estimated \(focal, cx, cy, aspect\), and reference.*camera\.csv"
    with pytest.raises(InputError, match=expected):
        survey(tiny_tables)


# --- several reference epochs ---------------------------------------------------------------------


def two_references(folder: Path, sigma: str = "[0.004, 0.004, 0.004]") -> Path:
    """The reference twice, as the epochs "old" and "2025.1", with images and ids of the same names."""
    text = (folder / "project.toml").read_text(encoding="utf-8")
    start, end = text.index("[reference]"), text.index("[epochs")
    section = text[start:end]
    own = section.replace("[reference]", '[references."2025.1"]').replace('"reference', '"new')
    own = own.replace("position_m = [0.002, 0.002, 0.002]", f"position_m = {sigma}")
    both = section.replace("[reference]", "[references.old]") + own
    (folder / "project.toml").write_text(text[:start] + both + text[end:], encoding="utf-8")
    shutil.copytree(folder / "reference", folder / "new")
    shutil.copy(folder / "reference_eo.csv", folder / "new_eo.csv")
    return folder


def test_images_of_two_references_are_told_apart(tiny_tables: Path) -> None:
    single = survey(tiny_tables)
    found = survey(two_references(tiny_tables))
    images = [*found.reference.images, *found.epoch.images]
    assert len({feature_id(image) for image in images}) == len(images) == 19
    assert len({image.image_id for image in images}) == 19
    assert [i.epoch for i in found.reference.images] == ["old"] * 8 + ["2025.1"] * 8
    assert found.reference.images[8].image_id == "2025.1/r0.jpg"
    assert found.reference.images[8].path == tiny_tables.resolve() / "new" / "r0.jpg"
    assert single.reference.images[0].image_id == "r0.jpg"  # a single reference stays as it is
    assert feature_id(single.reference.images[0]) == "reference/r0.jpg"


def test_each_reference_has_its_own_sigma(tiny_tables: Path) -> None:
    images = list(survey(two_references(tiny_tables)).reference.images)
    given = [image.given_sigma.position_m[0] for image in images if image.given_sigma is not None]
    assert given == [0.002] * 8 + [0.004] * 8
    noise = declared_noise(images)
    assert noise is not None
    assert noise.position_sigma_m[0] == pytest.approx(np.sqrt(0.5 * (0.002**2 + 0.004**2)))
    assert declared_noise(images[:8]) is not None
    assert declared_noise(images[:8]).position_sigma_m == (0.002, 0.002, 0.002)  # type: ignore[union-attr]


@pytest.mark.parametrize(
    ("old", "new", "text"),
    [
        (
            "[references.old]",
            "[references.second]",
            "a reference epoch and a new epoch or block have the same name: second",
        ),
        ("[references.old]", "[references.reference]", "and not 'reference'"),
        ("[references.old]", "[reference]", r"a section \[reference\], or one \[references.NAME\]"),
        ("[0.004, 0.004, 0.004]", "[0.004, -1.0, 0.004]", "must be positive"),
    ],
)
def test_references_that_cannot_be_are_refused(tiny_tables: Path, old: str, new: str, text: str) -> None:
    edited(two_references(tiny_tables), "project.toml", old, new)
    with pytest.raises(ConfigError, match=text):
        open_project(tiny_tables)


def test_given_and_estimated_sigmas_do_not_mix(tiny_tables: Path) -> None:
    path = two_references(tiny_tables) / "project.toml"
    text = path.read_text(encoding="utf-8")
    start = text.index("sigma = {")
    path.write_text(text[:start] + 'sigma = "estimate"' + text[text.index("\n", start) :], encoding="utf-8")
    with pytest.raises(ConfigError, match="sigma of old is to be estimated and that of others is given"):
        open_project(tiny_tables)


# --- unknown intrinsics ---------------------------------------------------------------------------


def photograph(path: Path, size: tuple[int, int], tags: dict[int, object]) -> None:
    exif = PillowImage.Exif()
    exif.get_ifd(0x8769).update(tags)
    buffer = io.BytesIO()
    PillowImage.new("RGB", size).save(buffer, "JPEG", exif=exif)
    path.write_bytes(buffer.getvalue())


@pytest.mark.parametrize(
    ("tags", "focal"),
    [
        ({0xA405: 26}, 26.0 / np.hypot(36.0, 24.0) * 1000.0),
        ({0x920A: 4.0, 0xA20E: 2540.0, 0xA210: 2}, 400.0),
        ({0x920A: 4.0, 0xA20E: 2000.0, 0xA210: 3, 0xA002: 1600}, 400.0),  # made half as large since
        ({0xA405: 0}, None),
        ({0xA405: 60000}, None),
        ({0x920A: 4.0}, None),
        ({}, None),
    ],
)
def test_the_focal_length_of_exif(tmp_path: Path, tags: dict[int, object], focal: float | None) -> None:
    photograph(tmp_path / "a.jpg", (800, 600), tags)
    size, found = size_and_focal(tmp_path / "a.jpg")
    assert size == (800, 600)
    assert found == (None if focal is None else pytest.approx(focal))


def test_an_unknown_camera_starts_from_exif_or_from_the_usual_view(tiny_tables: Path) -> None:
    edited(tiny_tables, "project.toml", 'cameras = "camera.csv"\ngnss', 'intrinsics = "estimate"\ngnss')
    photograph(tiny_tables / EPOCH / "n0.jpg", (640, 480), {0xA405: 26})
    photograph(tiny_tables / EPOCH / "n1.jpg", (600, 800), {})
    known, plain, broken = (image.camera for image in survey(tiny_tables).epoch.images)  # n2.jpg is an empty file
    assert known.estimate == plain.estimate == broken.estimate == ("focal", "k1", "cx", "cy")
    assert known.fx == known.fy == pytest.approx(26.0 / np.hypot(36.0, 24.0) * 800.0)
    assert (plain.fx, plain.cx, plain.cy, plain.width) == (pytest.approx(960.0), 300.0, 400.0, 600)
    assert broken.width == broken.height


def test_intrinsics_of_a_table_may_be_declared_unknown(tiny_tables: Path) -> None:
    edited(tiny_tables, "project.toml", "\ngnss", '\nintrinsics = ["focal"]\ngnss')
    found = survey(tiny_tables)
    assert {image.camera.estimate for image in found.epoch.images} == {("focal",)}
    assert {image.camera.fx for image in found.epoch.images} == {560.0}  # where the estimation starts
    assert {image.camera.estimate for image in found.reference.images} == {()}


@pytest.mark.parametrize(
    ("old", "new", "text"),
    [
        ('cameras = "camera.csv"\ngnss', "gnss", "nothing says what cameras took its images"),
        ("\ngnss", '\nintrinsics = ["k2"]\ngnss', "k2 only together with k1"),
        ("\ngnss", '\nintrinsics = ["p1"]\ngnss', "p1"),
        ("\ngnss", '\npanorama = { projection = "equirectangular" }\ngnss', "panoramas have no camera table"),
        ('cameras = "camera.csv"\ngnss', 'panorama = { projection = "cubic" }\ngnss', "cubic"),
    ],
)
def test_cameras_that_cannot_be_are_refused(tiny_tables: Path, old: str, new: str, text: str) -> None:
    edited(tiny_tables, "project.toml", old, new)
    with pytest.raises(ConfigError, match=text):
        open_project(tiny_tables)


# --- panoramas ------------------------------------------------------------------------------------

HEAD_TABLE = "head,width,height,fx,yaw,pitch,roll,x,y,z\nfront,60,40,30,0,0,0,0,0,0.1\nright,60,40,30,90,0,0,0.2,0,0\n"


@pytest.fixture
def panoramas(tiny_tables: Path) -> Path:
    """The new epoch's images are panoramas, each of one grey; n2.jpg is an empty file."""
    declared = 'panorama = { projection = "equirectangular", heads = "heads.csv", stitching_radius_m = 10.0 }\ngnss'
    edited(tiny_tables, "project.toml", 'cameras = "camera.csv"\ngnss', declared)
    without_points(tiny_tables)
    (tiny_tables / "heads.csv").write_text(HEAD_TABLE, encoding="utf-8")
    with_column(tiny_tables, f"{EPOCH}_gnss.csv", "heading_deg", {"n0.jpg": "90"})
    for name, grey in (("n0.jpg", 80), ("n1.jpg", 160)):
        cv2.imwrite(str(tiny_tables / EPOCH / name), np.full((64, 128, 3), grey, np.uint8))
    return tiny_tables


def test_a_panorama_becomes_its_heads(panoramas: Path) -> None:
    found = survey(panoramas)
    images = found.epoch.images
    assert [image.image_id for image in images[:3]] == ["n0.jpg/front", "n0.jpg/right", "n1.jpg/front"]
    assert [image.camera.width for image in images] == [60] * 6
    assert found.source_of(images[0]) == panoramas.resolve() / EPOCH / "n0.jpg"
    front, right = images[0], images[1]
    assert front.heading_rad == pytest.approx(np.pi / 2)
    assert right.heading_rad == pytest.approx(np.pi)  # clockwise: the panorama looks east, this head south
    assert front.gnss is not None
    assert right.gnss is not None
    between = right.gnss.position_in_world - front.gnss.position_in_world
    assert between == pytest.approx([-0.1, -0.2, 0.0], abs=1e-9)  # 0.1 m ahead is east, 0.2 m to the right south
    assert images[2].heading_rad is None
    assert images[2].gnss is not None
    assert images[3].gnss is not None
    assert images[3].gnss.cov[0, 0] - images[2].gnss.cov[0, 0] == pytest.approx(0.5 * (0.2**2 - 0.1**2))


def test_heads_are_cut_once_and_anew_where_the_panorama_changed(panoramas: Path) -> None:
    first = survey(panoramas)
    failed = cut_missing(first.cutouts, Executor())
    paths = [cutout.path for cutout in first.cutouts]
    assert [path.is_file() for path in paths] == [True] * 4 + [False] * 2
    assert {reason for reason, _ in failed.values()} == {"unreadable"}
    assert set(failed) == set(paths[4:])
    assert np.abs(read_image(paths[0]).astype(int) - 80).max() <= 1
    stamps = [path.stat().st_mtime_ns for path in paths[:4]]
    paths[1].unlink()  # as where the cutting was interrupted
    cut_missing(survey(panoramas).cutouts, Executor())
    assert [path.stat().st_mtime_ns for path in (paths[0], *paths[2:4])] == [stamps[0], *stamps[2:4]]
    assert paths[1].is_file()
    source = panoramas / EPOCH / "n0.jpg"
    cv2.imwrite(str(source), np.full((64, 128, 3), 200, np.uint8))
    os.utime(source, ns=(1, 1))
    again = survey(panoramas)
    assert [c.path != path for c, path in zip(again.cutouts, paths, strict=True)] == [True] * 2 + [False] * 4
    cut_missing(again.cutouts, Executor())
    assert np.abs(read_image(again.cutouts[0].path).astype(int) - 200).max() <= 1


def test_a_picture_that_is_no_panorama_is_rejected_alone(panoramas: Path) -> None:
    cv2.imwrite(str(panoramas / EPOCH / "n1.jpg"), np.zeros((60, 80, 3), np.uint8))
    found = survey(panoramas)
    failed = cut_missing(found.cutouts, Executor())
    assert failed[found.cutouts[2].path] == (
        "wrong_size",
        "80 x 60 px; an image of equirectangular is twice as wide as high",
    )
    assert found.cutouts[0].path.is_file()


def test_without_a_table_five_standard_heads_are_cut(panoramas: Path) -> None:
    edited(panoramas, "project.toml", ', heads = "heads.csv", stitching_radius_m = 10.0', "")
    images = survey(panoramas).epoch.images
    assert [i.image_id for i in images[:5]] == [f"n0.jpg/head_{a:03d}" for a in (0, 72, 144, 216, 288)]


@pytest.mark.parametrize(
    ("old", "new", "text"),
    [
        ("front,60,40,30", "front,60,0,30", "height = 0"),
        ("front,60,40,30", "front,60,40,1", "a view of 90 degrees"),
        ("right,60", "front,60", "listed twice"),
        ("right,60", "a/b,60", "cannot be part of an image's name"),
        ("0.2,0,0\n", "20,0,0\n", "well inside the sphere"),
    ],
)
def test_heads_that_cannot_be_are_refused_with_their_row(tmp_path: Path, old: str, new: str, text: str) -> None:
    assert old in HEAD_TABLE
    (tmp_path / "heads.csv").write_text(HEAD_TABLE.replace(old, new), encoding="utf-8")
    with pytest.raises(InputError, match=rf"(?s){text}.*row [23] of .*heads\.csv"):
        read_heads(tmp_path / "heads.csv", stitching_radius_m=10.0)


def test_positions_of_heads_need_the_radius_of_stitching(tmp_path: Path) -> None:
    (tmp_path / "heads.csv").write_text(HEAD_TABLE, encoding="utf-8")
    with pytest.raises(InputError, match=r"(?s)nothing says how the panorama was stitched.*stitching_radius_m"):
        read_heads(tmp_path / "heads.csv")


# --- init and doctor ------------------------------------------------------------------------------


def test_init_finds_several_references_and_their_cameras(tiny_tables: Path, tmp_path: Path) -> None:
    two_references(tiny_tables)
    (tiny_tables / "reference_eo.csv").rename(tiny_tables / "old_eo.csv")
    (tiny_tables / "reference").rename(tiny_tables / "old")
    (tiny_tables / "camera.csv").rename(tiny_tables / "cameras_old.csv")
    shutil.copy(tiny_tables / "cameras_old.csv", tiny_tables / "cameras_new.csv")
    (tiny_tables / "project.toml").unlink()
    written = init_project(tmp_path / "made", tiny_tables, Answers(check_kind="absolute"))
    made = open_project(tmp_path / "made", data=tiny_tables)
    assert list(made.file.reference_epochs) == ["new", "old"]
    assert made.file.reference_epochs["old"].cameras == "cameras_old.csv"
    assert made.file.epochs[EPOCH].unknown == ("focal", "k1", "cx", "cy")
    assert "reference old: 8 images, omega-phi-kappa in deg" in written.said
    assert f"epoch {EPOCH}: no table of cameras, focal length and k1 are to be estimated" in written.said
    assert len(load_survey(made, EPOCH).reference.images) == 16


def test_the_doctor_says_what_is_declared(two_cameras: Path, panoramas: Path) -> None:
    """The same tables: two cameras a reference epoch, and panoramas of which one has a wrong shape."""
    cv2.imwrite(str(panoramas / EPOCH / "n1.jpg"), np.zeros((60, 80, 3), np.uint8))
    findings = {finding.text: finding for finding in check_project(open_project(panoramas))}
    assert any(text.startswith("reference: 8 images over") for text in findings)
    assert f"epoch {EPOCH}: images of 2 cameras: 3 front, 3 right" in findings
    wrong = findings["1 images are no panoramas of their declared projection: n1.jpg"]
    assert wrong.level == "warning"


def test_the_doctor_names_reference_epochs_and_unknown_cameras(tiny_tables: Path) -> None:
    edited(two_references(tiny_tables), "project.toml", "\ngnss", '\nintrinsics = ["focal", "k1"]\ngnss')
    texts = [finding.text for finding in check_project(open_project(tiny_tables))]
    assert any(text.startswith("reference: 16 images of 2 epochs (8 old, 8 2025.1) over") for text in texts)
    assert f"epoch {EPOCH}: focal, k1 of 3 images are estimated with their poses" in texts
