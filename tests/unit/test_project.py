"""A project on disk: what opens, what is refused and how."""

from __future__ import annotations

from pathlib import Path

import pytest

from georef.errors import ConfigError
from georef.project import open_project

PROJECT = Path(__file__).parents[2] / "projects" / "castle"


def edited(tables: Path, old: str, new: str) -> Path:
    path = tables / "project.toml"
    text = path.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new), encoding="utf-8")
    return tables


def test_a_project_opens_by_its_folder_and_by_its_file(tiny_tables: Path) -> None:
    by_folder, by_file = open_project(tiny_tables), open_project(tiny_tables / "project.toml")
    assert by_folder == by_file
    assert by_folder.data_root == by_folder.output == tiny_tables.resolve()
    assert by_folder.select_epoch(None) == "second"
    assert by_folder.config.features.extractor == "sift"  # of its preset


def test_the_data_may_be_named_by_their_folder_or_its_parent(
    tiny_tables: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "project" / tiny_tables.name
    folder.mkdir(parents=True)
    (tiny_tables / "project.toml").rename(folder / "project.toml")
    for named in (tiny_tables, tiny_tables.parent):
        assert open_project(folder, data=named).data_root == tiny_tables.resolve()
        monkeypatch.setenv("GEOREF_DATA", str(named))
        assert open_project(folder).data_root == tiny_tables.resolve()
    monkeypatch.setenv("GEOREF_DATA", str(tmp_path))
    assert open_project(folder, data=tiny_tables).data_root == tiny_tables.resolve()  # the option goes first


def test_results_stay_inside_the_named_output(tiny_tables: Path, tmp_path: Path) -> None:
    project = open_project(tiny_tables, output=tmp_path / "out")
    for folder in (project.feature_folder, project.published("second"), project.stage_folder("second", "x", "1")):
        assert folder.is_relative_to(tmp_path / "out")
    assert project.stage_history("second", "x") == []


def test_settings_reach_the_project_and_the_configuration(tiny_tables: Path) -> None:
    project = open_project(
        tiny_tables, settings=("crs.height=EPSG:7837", "adjust.gnss=false", "reference.sigma=estimate")
    )
    assert project.file.crs.height == "EPSG:7837"
    assert project.file.reference_epochs["reference"].sigma == "estimate"
    assert not project.config.adjust.gnss


def test_the_preset_of_the_command_line_goes_before_that_of_the_project(tiny_tables: Path) -> None:
    assert open_project(tiny_tables, preset="published").config.localize.method == "published"


def test_the_shipped_project_is_valid(tmp_path: Path) -> None:
    (tmp_path / "reference_eo.csv").touch()
    project = open_project(PROJECT, data=tmp_path)
    assert project.file.points is not None
    assert project.file.points.check_kind == "relative"


def test_an_epoch_that_is_not_there_lists_those_that_are(tiny_tables: Path) -> None:
    with pytest.raises(ConfigError, match=r"There is no epoch 'third'\.\nName one with --epoch: second\."):
        open_project(tiny_tables).select_epoch("third")
    section = '[epochs.third]\nimages = "second"\ncameras = "camera.csv"\n\n[points]'
    with pytest.raises(ConfigError, match=r"several epochs\.\nName one with --epoch: second, third\."):
        open_project(edited(tiny_tables, "[points]", section)).select_epoch(None)


@pytest.mark.parametrize(
    ("old", "new", "texts"),
    [
        ("[crs]", "[crss]", ["The key 'crs' is missing.", "Unknown key 'crss'. Did you mean 'crs'?"]),
        ('angle_unit = "deg"', 'angle_units = "deg"', ["Unknown key 'reference.angle_units'", "'angle_unit'?"]),
        (
            'angles = "omega-phi-kappa"',
            'angles = "opk"',
            ["'reference.angles' has the value 'opk'", "'yaw-pitch-roll'"],
        ),
        ("position_m = [0.002, ", "position_m = [0.0, ", ["a reference is never exact"]),
        ("marks = { second", "marks = { third", ["points.marks names epochs that do not exist: third"]),
        ("[epochs.second]", "[epochs.reference]", ["the epoch name 'reference' must be letters"]),
        ("[epochs.second]", '[epochs."../x"]', ["the epoch name '../x' must be letters"]),
        ('check_kind = "absolute"', 'check_kind = "both"', ["'points.check_kind' has the value 'both'"]),
        ("[config.features]", "[config.featurs]", ["Unknown key 'featurs'. Did you mean 'features'?", "project.toml"]),
        ('name = "tiny"', "name = tiny", ["Not valid TOML", "line 1"]),
        ('gnss = "', 'gnns = "', ["Unknown key 'epochs.second.gnns'. Did you mean 'gnss'?"]),
    ],
)
def test_mistakes_in_project_toml_are_explained(tiny_tables: Path, old: str, new: str, texts: list[str]) -> None:
    with pytest.raises(ConfigError) as caught:
        open_project(edited(tiny_tables, old, new))
    for text in [*texts, "project.toml"]:
        assert text in str(caught.value)


def test_no_project_and_no_data(tmp_path: Path, tiny_tables: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ConfigError, match=r"(?s)no project at.*georef init"):
        open_project(tmp_path / "absent")
    monkeypatch.delenv("GEOREF_DATA", raising=False)
    with pytest.raises(ConfigError, match=r"(?s)'tiny' were not found.*reference_eo\.csv.*--data DIR.*GEOREF_DATA"):
        open_project(tiny_tables, data=tmp_path / "nothing")
