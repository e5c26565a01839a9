"""What a project can declare of a block: points known in part, roles, distances, drift; errors that name the row."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from georef.config import AdjustConfig
from georef.errors import ConfigError, InputError
from georef.estimation.adjustment.measured.correlations import unknowns_of
from georef.estimation.adjustment.measured.solutions import clean, solve_with_control
from georef.io.bingo import read_bingo, sensor_of_header
from georef.io.pix4d import read_pix4d_camera, read_pix4d_cameras
from georef.io.pix4d_ties import read_pix4d_ties, write_pix4d_ties
from georef.io.rig_table import read_rig
from georef.project import open_project
from georef.stages.block_numbers import control_numbers, distance_numbers, named, partial_check_numbers
from georef.stages.block_survey import BlockSurvey, load_block
from tests.worlds.aerial import Flight, flight, write_flight

_CONFIG = AdjustConfig()


def _survey(folder: Path) -> BlockSurvey:
    return load_block(open_project(folder), "flight")


def _rewritten(path: Path, rows: dict[str, str]) -> None:
    """The table with other rows for some ids; an id of "header" stands for the first row."""
    lines = path.read_text(encoding="utf-8").splitlines()
    keys = ["header", *(line.split(",")[0] for line in lines[1:])]
    out = [rows.get(key, line) for key, line in zip(keys, lines, strict=True)]
    path.write_text("\n".join(out) + "\n", encoding="utf-8")


def _row(made: Flight, index: int, *, horizontal: bool) -> str:
    x, y, z = made.surveyed[index]
    return f"P{index},{x:.3f},{y:.3f},,0.01,0.01," if horizontal else f"P{index},,,{z:.3f},,,0.02"


def test_horizontal_and_height_control_take_part_with_what_they_know(tmp_path: Path) -> None:
    made = flight(4)
    folder = write_flight(made, tmp_path)
    _rewritten(folder / "surveyed.csv", {"P0": _row(made, 0, horizontal=True), "P1": _row(made, 1, horizontal=False)})
    survey = _survey(folder)
    assert [point.point_id for point in survey.surveyed if not point.whole] == ["P0", "P1"]
    placed = survey.world.crs_from_world(survey.surveyed[1].point_in_world[None])[0]
    assert 0.0 < np.linalg.norm(placed - made.surveyed[1]) < 15.0  # by its marks
    cleaned = clean(survey.block, _CONFIG)
    found = solve_with_control(cleaned, survey.surveyed, (), _CONFIG)
    horizontal, height, whole = control_numbers(found)[:3]
    assert [value is None for value in horizontal["residual_m"]] == [False, False, True]
    assert [value is None for value in height["residual_m"]] == [True, True, False]
    assert (horizontal["dof"], height["dof"], whole["dof"]) == (2, 1, 3)
    assert np.linalg.matrix_rank(found.block.point_priors.information[1]) == 1
    others = [p.point_id for p in survey.whole]
    held = solve_with_control(cleaned, survey.control(others), (), _CONFIG)
    rows = {row["point_id"]: row for row in partial_check_numbers(held, survey.partly_known(others))}
    assert rows["P0"]["difference_m"][2] is None
    assert 0.0 < abs(rows["P1"]["difference_m"][2]) < 5.0 * rows["P1"]["predicted_sigma_m"][2] < 0.3


@pytest.mark.parametrize(
    ("row", "said"),
    [
        ("P3,1.0,,,0.01,0.01,0.02", "Point 'P3' has only x"),
        ("P3,1.0,2.0,3.0,0.01,0.01,-0.02", "has sigma_z = -0.02"),
        ("P3,,,,,,", "has no coordinate"),
    ],
)
def test_points_that_cannot_be_are_named_with_row_and_remedy(tmp_path: Path, row: str, said: str) -> None:
    folder = write_flight(flight(), tmp_path)
    _rewritten(folder / "surveyed.csv", {"P3": row})
    with pytest.raises(InputError) as caught:
        _survey(folder)
    assert said in str(caught.value)
    assert "surveyed.csv" in str(caught.value)
    assert caught.value.row == 5


def test_roles_are_those_of_lists_or_of_the_table(tmp_path: Path) -> None:
    folder = write_flight(flight(), tmp_path / "a", control='["P1", "P5"]', more='check = ["P0", "P7"]')
    survey = _survey(folder)
    assert survey.declared_control == ("P1", "P5")
    assert [point.point_id for point in survey.check(("P1", "P5"))] == ["P0", "P7"]
    assert not any(name.startswith("GCP_") for name in survey.tie_ids)  # points without a role take no part
    with pytest.raises(ConfigError, match="P1 is control and check at once"):
        open_project(write_flight(flight(), tmp_path / "b", control='["P1"]', more='check = ["P1"]'))
    with pytest.raises(InputError, match="'P9', which has no coordinates"):
        _survey(write_flight(flight(), tmp_path / "c", control='["P9"]'))


def test_distances_are_adjusted_checked_and_rejected(tmp_path: Path) -> None:
    made = flight(4)
    length = [float(np.linalg.norm(made.points[a] - made.points[b])) for a, b in ((0, 1), (2, 3), (4, 5))]
    entries = [(0, 1, length[0] + 0.004), (2, 3, length[1] - 0.003), (4, 5, length[2] + 0.5)]
    text = ", ".join(f'{{ a = "{a}", b = "{b}", distance_m = {d:.4f}, sigma_m = 0.005 }}' for a, b, d in entries)
    survey = _survey(write_flight(made, tmp_path, more=f"distances = [{text}]"))
    cleaned = clean(survey.block, _CONFIG)
    assert [named(entry, survey.tie_ids).name for entry in cleaned.rejected] == ["4 to 5"]
    rows = distance_numbers(solve_with_control(cleaned, (), (), _CONFIG), survey.tie_ids)
    assert [(row["a"], row["b"]) for row in rows] == [("0", "1"), ("2", "3")]
    assert all(0.01 < row["redundancy"] < 0.9 for row in rows)  # the images say much of them as well
    assert all(0.0 < abs(row["residual_m"]) < 0.02 and row["detectable_m"] > 4.1 * 0.005 for row in rows)
    with pytest.raises(InputError, match="ends at 'P3', which has coordinates"):
        _survey(write_flight(made, tmp_path / "b", more=_distances(text, "P3")))
    with pytest.raises(InputError, match="ends at '9999'"):
        _survey(write_flight(made, tmp_path / "c", more=_distances(text, "9999")))


def _distances(text: str, other: str) -> str:
    """The same distances with another first end."""
    return "distances = [" + text.replace('"0"', f'"{other}"') + "]"


def test_drift_by_flight_is_found(tmp_path: Path) -> None:
    """Two flights with offsets of their own, which control tells."""
    offsets = np.where(np.arange(28)[:, None] < 14, [0.10, -0.05, 0.06], [-0.08, 0.07, -0.04])
    survey = _survey(_with_drift(tmp_path, offsets, 'drift = { sigma_m = [0.3, 0.3, 0.3], flight = "flight" }'))
    unknowns = _drift_of(survey)
    for flight_number, truth in ((1, offsets[0]), (2, offsets[-1])):
        for axis, value in zip(("east", "north", "up"), truth, strict=True):
            found = unknowns[f"GNSS drift {flight_number} {axis}"]
            assert abs(found.value - value) < 4.0 * found.sigma
            assert 0.003 < found.sigma < 0.08


def test_drift_in_time_is_found(tmp_path: Path) -> None:
    """Linear between three nodes."""
    late = np.arange(28) / 27.0
    offsets = np.outer(late, [0.15, -0.12, 0.10])
    survey = _survey(_with_drift(tmp_path, offsets, "drift = { sigma_m = [0.3, 0.3, 0.3], interval_s = 140.0 }"))
    assert len(survey.block.drift_information) == 3
    assert survey.block.position_priors.drift_weight.sum(axis=1) == pytest.approx(np.ones(28))
    unknowns = _drift_of(survey)
    for node, share in ((1, 0.0), (2, 0.5), (3, 1.0)):
        found = unknowns[f"GNSS drift {node} east"]
        assert abs(found.value - 0.15 * share) < 4.0 * found.sigma
        assert found.sigma < 0.05


def _drift_of(survey: BlockSurvey) -> dict:
    cleaned = clean(survey.block, _CONFIG)
    assert len(cleaned.rejected) <= 1
    return {u.name: u for u in unknowns_of(solve_with_control(cleaned, survey.surveyed, (), _CONFIG))}


def _with_drift(folder: Path, offsets: np.ndarray, gnss: str) -> Path:
    """Positions with offsets (28, 3), a column of flights and one of times, ten seconds apart."""
    write_flight(flight(4), folder, gnss=gnss)
    path = folder / "rtk.csv"
    lines = path.read_text(encoding="utf-8").splitlines()
    rows = [lines[0] + ",flight,time"]
    for k, line in enumerate(lines[1:]):
        cells = line.split(",")
        place = np.array(cells[1:4], dtype=np.float64) + offsets[k]
        rows.append(",".join([cells[0], *(f"{v:.4f}" for v in place), *cells[4:], f"f{k // 14}", f"{10.0 * k}"]))
    path.write_text("\n".join(rows) + "\n", encoding="utf-8")
    return folder


def test_drift_without_times_says_what_is_missing(tmp_path: Path) -> None:
    folder = write_flight(flight(), tmp_path, gnss="drift = { sigma_m = [0.1, 0.1, 0.1], interval_s = 60.0 }")
    with pytest.raises(InputError, match="asks for times"):
        _survey(folder)


def test_the_header_says_the_sensor(tmp_path: Path) -> None:
    assert sensor_of_header("H_34.99999_23.32763") == (34.99999, 23.32763)
    assert sensor_of_header("P1") is None
    folder = write_flight(flight(), tmp_path)
    text = (folder / "points.txt").read_text(encoding="utf-8").replace(" c\n", " H_20.00000_15.00000\n")
    (folder / "points.txt").write_text(text, encoding="utf-8")
    project = (folder / "project.toml").read_text(encoding="utf-8").replace("sensor_mm = [20.0, 15.0]\n", "")
    (folder / "project.toml").write_text(project, encoding="utf-8")
    assert np.array_equal(_survey(folder).images.image_ids, [f"i{k}" for k in range(28)])


def test_tie_points_in_pixels_come_back(tmp_path: Path) -> None:
    path = tmp_path / "p_tp_pix4d.txt"
    path.write_text("a.JPG\n7 10.5 20.25 3.1\nGCP_1 1.0 2.0 1.0\n-99\nb.JPG\n7 11.5 21.25 2.0\n-99\n", encoding="utf-8")
    table = read_pix4d_ties(path)
    assert table.in_pixels
    assert table.image_ids == ("a.JPG", "b.JPG")
    assert table.xy_mm.tolist() == [[10.5, 20.25], [1.0, 2.0], [11.5, 21.25]]
    write_pix4d_ties(table, tmp_path / "again.txt")
    assert read_pix4d_ties(tmp_path / "again.txt").xy_mm.tolist() == table.xy_mm.tolist()
    with pytest.raises(InputError, match="has 4 values"):
        read_bingo(path)


def test_a_file_of_several_cameras_is_read_in_its_order(tmp_path: Path) -> None:
    section = (
        "Pix4D camera calibration file {i}\n#Focal Length mm assuming a sensor width of 20.0x15.0mm\n"
        "F {f}\nPx 10.0\nPy 7.5\nK1 0.1\nK2 0\nK3 0\nT1 0\nT2 0\n\n"
    )
    path = tmp_path / "two.cam"
    path.write_text(section.format(i=0, f=20.0) + section.format(i=1, f=25.0), encoding="utf-8")
    cameras = read_pix4d_cameras(path, [(4000, 3000), (4000, 3000)])
    assert [camera.fx for camera in cameras] == [4000.0, 5000.0]
    with pytest.raises(InputError, match="holds 2 cameras where 1 are expected"):
        read_pix4d_camera(path, (4000, 3000))


def test_a_free_mounting_has_empty_sigmas(tmp_path: Path) -> None:
    path = tmp_path / "rig.csv"
    path.write_text(
        "camera,x,y,z,omega,phi,kappa,sigma_m,sigma_deg\nN,0,0,0,0,0,0,0,0\nF,0.1,0,0,45,0,0,,\n", encoding="utf-8"
    )
    rig = read_rig(path)
    assert rig["N"].cov is None
    assert rig["F"].cov is not None
    # omega turns the image's y (up) towards its z (the viewer): the camera looks towards the top of the picture
    axis = rig["F"].rig_from_cam.rotation[:, 2]
    assert axis == pytest.approx([0.0, -np.sqrt(0.5), np.sqrt(0.5)])
    assert rig["F"].free
    assert not rig["N"].free
    path.write_text(path.read_text(encoding="utf-8").replace("45,0,0,,", "45,0,0,0.1,"), encoding="utf-8")
    with pytest.raises(InputError, match="one of sigma_m, sigma_deg"):
        read_rig(path)
