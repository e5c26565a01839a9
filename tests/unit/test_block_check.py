"""Surveyed points against an adjusted block: derivatives, covariance, offset, and control without adjusting again."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from georef.config import AdjustConfig
from georef.estimation.adjustment.equations.block_equations import moved_state
from georef.estimation.adjustment.equations.reduced import Layout
from georef.estimation.adjustment.measured.check import check_block, common_offset, with_points_as_control
from georef.estimation.adjustment.measured.correlations import correlations_of, unknowns_of
from georef.estimation.adjustment.measured.solutions import (
    CleanBlock,
    Solved,
    clean,
    solve_with_control,
    without_offset,
)
from georef.geometry.camera import Camera
from georef.project import open_project
from georef.stages.block_survey import BlockSurvey, load_block
from tests.worlds.aerial import flight, write_flight

_CONFIG = AdjustConfig()


@pytest.fixture(scope="module")
def survey(tmp_path_factory: pytest.TempPathFactory) -> BlockSurvey:
    folder = write_flight(flight(offset_m=(0.05, -0.03, 0.1)), tmp_path_factory.mktemp("flight"))
    return load_block(open_project(folder), "flight")


@pytest.fixture(scope="module")
def cleaned(survey: BlockSurvey) -> CleanBlock:
    return clean(without_offset(survey.block), _CONFIG)


@pytest.fixture(scope="module")
def free(survey: BlockSurvey, cleaned: CleanBlock) -> Solved:
    return solve_with_control(cleaned, (), survey.check(()), _CONFIG)


def test_points_follow_the_unknowns_as_their_derivatives_say(survey: BlockSurvey, free: Solved) -> None:
    layout, state = Layout.of(free.block), free.solution.state
    rng = np.random.default_rng(0)
    steps = 1e-5 * rng.normal(size=(4, layout.size))
    steps[:2, : 6 * layout.stations] = 0.0  # the cameras alone
    solve = free.cofactors.apply
    for step in steps:
        moved = check_block(free.block, moved_state(layout, state, step), solve, survey.check(()))
        change = _differences(moved.errors) - _differences(free.check.errors)
        assert change.ravel() == pytest.approx(free.check.by_unknowns @ step, abs=2e-3 * np.abs(change).max())


def test_the_image_sigma_and_the_camera_are_found(cleaned: CleanBlock, free: Solved) -> None:
    assert 0.6 < cleaned.sigma_scale < 0.8  # 0.7 px were made, 1 px stated
    assert cleaned.dropped < 0.01 * (cleaned.dropped + len(cleaned.block.observations))
    found = {unknown.name: unknown for unknown in unknowns_of(free)}
    for name, truth in (("focal", 4100.0), ("cx", 2010.0), ("cy", 1490.0), ("k1", -0.05), ("k2", 0.02)):
        unknown = found[f"{name} of c"]
        assert 0.0 < abs(unknown.value - truth) < 4.0 * unknown.sigma


def test_the_offset_of_all_positions_is_found_with_its_sigma(free: Solved) -> None:
    offset = common_offset(free.check)
    assert offset is not None
    off = offset.offset_m - np.array([0.05, -0.03, 0.1])
    assert off @ np.linalg.solve(offset.cov, off) < 16.3  # 99.9 % of three degrees of freedom
    assert offset.statistic > 16.3
    assert (offset.sigma_m < [0.02, 0.02, 0.1]).all()
    assert 0.3 < offset.left_over < 2.2


def test_control_without_adjusting_again_is_what_adjusting_gives(survey: BlockSurvey, cleaned: CleanBlock) -> None:
    offset = CleanBlock(
        replace(
            cleaned.block,
            position_priors=replace(
                survey.block.position_priors,
                drift_node=np.tile([0, -1], (28, 1)),
                drift_weight=np.tile([1.0, 0.0], (28, 1)),
            ),
            drift_information=np.diag([100.0, 100.0, 25.0])[None],
        ),
        replace(cleaned.state, drift_m=np.zeros((1, 3))),
        *(cleaned.rejected, cleaned.dropped, cleaned.dropped_points, cleaned.sigma_scale),
    )
    free = solve_with_control(offset, (), survey.check(()), _CONFIG)
    control = ("P0", "P3", "P5", "P6")
    adjusted = solve_with_control(offset, survey.control(control), survey.check(control), _CONFIG).check.errors
    quick = with_points_as_control(free.check, [0, 3, 5, 6])
    assert [e.point_id for e in quick.determined] == [e.point_id for e in adjusted.determined]
    assert _differences(quick) == pytest.approx(_differences(adjusted), abs=5e-4)
    assert np.abs(_differences(quick) - _differences(free.check.errors)[[1, 2, 4, 7]]).max() > 0.03  # it did something
    assert quick.joint_cov is not None
    assert adjusted.joint_cov is not None
    assert quick.joint_cov == pytest.approx(adjusted.joint_cov, rel=0.02, abs=1e-6)


def test_what_cannot_be_told_apart_is_named(free: Solved) -> None:
    pairs = {frozenset((c.first, c.second)): c.value for c in correlations_of(free)}
    assert frozenset(("cx of c", "p2 of c")) in pairs or frozenset(("k1 of c", "k2 of c")) in pairs
    assert all(0.9 <= abs(value) <= 1.0 for value in pairs.values())


def test_a_mark_of_another_size_of_image_is_refused(tmp_path: Path) -> None:
    from georef.errors import InputError

    folder = write_flight(flight(), tmp_path / "f")
    path = folder / "project.toml"
    path.write_text(path.read_text().replace("sensor_mm = [20.0, 15.0]", "sensor_mm = [15.0, 10.0]"))
    with pytest.raises(InputError, match="lies outside image 'i0'"):
        load_block(open_project(folder), "flight")


def test_images_without_a_position_are_named(tmp_path: Path) -> None:
    from georef.errors import InputError

    folder = write_flight(flight(), tmp_path / "f")
    rows = (folder / "rtk.csv").read_text().splitlines()
    (folder / "rtk.csv").write_text("\n".join([*rows[:4], *rows[6:]]))
    with pytest.raises(InputError, match=r"2 images have measurements and no row in rtk.csv, the first is 'i3'"):
        load_block(open_project(folder), "flight")


def test_control_that_has_no_coordinates_is_refused(tmp_path: Path) -> None:
    from georef.errors import InputError

    folder = write_flight(flight(), tmp_path / "f", control='["P0", "P77"]')
    with pytest.raises(InputError, match=r"blocks\.flight\.control names 'P77'"):
        load_block(open_project(folder), "flight")


def test_a_camera_is_estimated_about_a_stated_value(tmp_path: Path) -> None:
    folder = write_flight(flight(), tmp_path / "f", more="camera_sigma = { focal = 2.0 }")
    block = load_block(open_project(folder), "flight").block
    camera: Camera = block.calibrations[0].camera
    weights = np.diag(block.calibrations[0].information)
    assert weights[camera.estimate.index("focal")] == pytest.approx((camera.fx / 2.0) ** 2)
    assert np.count_nonzero(weights) == 1


def _differences(errors) -> np.ndarray:
    return np.array([error.difference_m for error in errors.determined])
