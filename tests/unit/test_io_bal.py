"""Problem files of Bundle Adjustment in the Large."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from georef.errors import InputError
from georef.geometry.poses import exp_so3
from georef.geometry.projection import Views
from georef.geometry.rigid import Array
from georef.io.bal import BalProblem, read_bal, write_bal


def _problem(seed: int = 0) -> BalProblem:
    """Four cameras about a cloud that lies in front of them, along -z."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1, 1, (20, 3)) + np.array([0, 0, -8])
    cameras = np.concatenate(
        [
            0.1 * rng.normal(size=(4, 3)),
            0.3 * rng.normal(size=(4, 3)),
            np.column_stack([rng.uniform(500, 900, 4), 0.1 * rng.normal(size=4), 0.01 * rng.normal(size=4)]),
        ],
        axis=1,
    )
    camera, point = (index.ravel() for index in np.indices((4, 20)))
    empty = BalProblem(camera, point, np.zeros((80, 2)), cameras, points)
    return replace(empty, xy=_by_definition(empty) + rng.normal(size=(80, 2)))


def _by_definition(problem: BalProblem) -> Array:
    """Pixels from the image centre, right and up, as the format defines them."""
    row = problem.cameras[problem.camera]
    p = np.einsum("nij,nj->ni", exp_so3(row[:, :3]), problem.points[problem.point]) + row[:, 3:6]
    slope = -p[:, :2] / p[:, 2:]
    r2 = np.sum(np.square(slope), axis=1, keepdims=True)
    return row[:, 6:7] * (1 + row[:, 7:8] * r2 + row[:, 8:9] * r2**2) * slope


def test_the_cost_in_the_frame_of_the_house_is_that_of_the_definition() -> None:
    problem = _problem()
    views = Views.of(problem.world_from_cam.to_list(), problem.house_cameras())
    ours = views.project(problem.camera, problem.points[problem.point]) - problem.pixels
    theirs = _by_definition(problem) - problem.xy
    assert ours == pytest.approx(theirs * [1, -1], abs=1e-9)
    assert 10 < np.sum(np.square(ours)) < 1000  # noise of 1 px: the cloud is in front


@pytest.mark.parametrize("ending", ["txt", "txt.gz", "txt.bz2"])
def test_what_is_written_is_read_again_to_the_last_digit(tmp_path: Path, ending: str) -> None:
    problem = _problem()
    write_bal(problem, tmp_path / f"p.{ending}")
    again = read_bal(tmp_path / f"p.{ending}")
    for name in ("camera", "point", "xy", "cameras", "points"):
        assert np.array_equal(getattr(again, name), getattr(problem, name))


def test_values_of_the_house_go_back_into_a_problem() -> None:
    problem = _problem()
    again = problem.with_values(problem.world_from_cam, problem.house_cameras(), problem.points)
    assert again.cameras == pytest.approx(problem.cameras, abs=1e-12)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda lines: lines[:-1], "holds 175 values after its first row, which announces 176"),
        (lambda lines: ["4 20", *lines[1:]], "The first row is '4 20'"),
        (lambda lines: [lines[0], "4 0 1.0 2.0", *lines[2:]], "Observation 0 is of camera 4 and point 0"),
        (lambda lines: [lines[0], "0.5 0 1.0 2.0", *lines[2:]], "Observation 0 is of camera 0.5"),
        (lambda lines: [*lines[:-1], "inf"], "'inf' is not a finite number"),
        (lambda lines: [*lines[:-1], "1,5"], "'1,5' is not a finite number"),
    ],
)
def test_what_cannot_be_is_refused(tmp_path: Path, change, said: str) -> None:
    path = tmp_path / "p.txt"
    problem = _problem()
    few = problem.camera < 1
    small = replace(problem, camera=problem.camera[few], point=problem.point[few], xy=problem.xy[few])
    write_bal(small, path)
    path.write_text("\n".join(change(path.read_text().split("\n")[:-1])))
    with pytest.raises(InputError, match=said) as caught:
        read_bal(path)
    assert str(path) in str(caught.value)


def test_a_damaged_archive_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "p.txt.bz2"
    path.write_bytes(b"BZh9 no archive")
    with pytest.raises(InputError, match="cannot be read"):
        read_bal(path)
