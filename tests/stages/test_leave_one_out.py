"""Reference images against each other: what is left out, what is kept, what is written and said."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from georef.cli import app
from georef.comparison.leave_one_out import LeaveOneOut, leave_out, panels, write_leave_one_out
from georef.comparison.run import Source
from georef.config import Config
from georef.errors import ConfigError
from georef.executor import Executor
from georef.geometry.camera import Camera
from georef.geometry.rigid import Rigid3
from georef.report.reliability_figure import reliability_figure
from georef.stages.leave_one_out import Choice, as_new, together
from georef.terminal import exit_code
from georef.types.campaign import Image
from tests.stages.bench import Bench


def image(name: str, epoch: str = "2023", station: str | None = None) -> Image:
    camera = Camera("cam", 640, 480, 560.0, 560.0, 320.0, 240.0)
    return Image(name, Path(name), camera, epoch, world_from_cam=Rigid3.identity(), station=station)


def left_out(bench: Bench, choice: Choice, said: list[str] | None = None, *settings: str) -> LeaveOneOut:
    say = (said if said is not None else []).append
    source = Source(bench.data, output=bench.output, settings=settings)
    return leave_out(source, choice, executor=Executor(), say=say)


def test_an_image_is_left_out_with_its_station_and_no_other() -> None:
    head, mate = image("a/front", station="a"), image("a/back", station="a")
    assert together(head, head)
    assert together(head, mate)
    assert not together(head, image("b/front", station="b"))
    assert not together(head, image("a/front2", epoch="2025", station="a"))
    assert not together(image("x"), image("y"))


def test_nothing_of_its_pose_but_the_place_to_search_about_is_left() -> None:
    new = as_new(replace(image("a", station="s"), heading_rad=1.0))
    assert new.world_from_cam is new.gnss is new.heading_rad is new.station is new.given_sigma is None
    np.testing.assert_array_equal(new.near, np.zeros(3))


def test_choice_is_spread_evenly_and_checked() -> None:
    images = [image(f"{k}", epoch="old" if k < 6 else "new") for k in range(12)]
    assert [i.image_id for i in Choice(count=3).of(images)] == ["0", "6", "11"]
    assert [i.image_id for i in Choice("new", 2).of(images)] == ["6", "11"]
    assert len(Choice(count=50).of(images)) == 12
    with pytest.raises(ConfigError, match=r"no reference epoch 'x'.[^.]*\n?.*old, new"):
        Choice("x").check(["old", "new"], Config())
    with pytest.raises(ConfigError, match="--count 0"):
        Choice(count=0).check(["old"], Config())
    mapped = Config.model_validate({"localize": {"method": "global-model"}})
    with pytest.raises(ConfigError, match="cannot leave a reference image out"):
        Choice().check(["old"], mapped)


def test_poses_agree_with_the_given_ones_as_their_covariances_say(copied: Callable[..., Bench]) -> None:
    bench, said = copied(), []
    found = left_out(bench, Choice(count=4), said)
    assert len(found.results) == 4
    assert not found.rejected
    row = found.table.to_dict()["rows"][0]
    assert row["localized"]["value"] == 100.0
    assert 0.0005 < row["median_position"]["value"] < 0.02
    assert 0.1 < row["nees_per_dof"]["value"] < 3.0
    assert 0.3 < row["median_position"]["value"] / row["predicted_position"] < 2.0
    assert said[-1].endswith("CPU-s]")
    again: list[str] = []
    left_out(bench, Choice(count=4), again)
    assert all(line.endswith("[kept]") for line in again), again
    paths = {path.name: path for path in write_leave_one_out(found)}
    data = json.loads(paths["leave-one-out.json"].read_text(encoding="utf-8"))
    assert len(data["images"]) == data["errors"]["image_count"] == 4
    assert data["images"][0]["predicted_position_sigma_m"] > 0.002  # no less than that of the given pose
    stored = list(csv.DictReader(paths["leave-one-out.csv"].read_text(encoding="utf-8").splitlines()))
    assert stored[0]["images"] == "4"
    assert paths["reliability.svg"].read_text(encoding="utf-8").count("<circle") == 8
    for outcome in sorted((bench.output / "work" / "reference" / "leave-one-out").rglob("*.npz")):
        with np.load(outcome) as stored_item:
            header = json.loads(stored_item["header_json"].tobytes())
        assert header["image_id"] not in [*header["references"], *header["candidates"]]


def test_tracks_are_looked_up_without_the_image(copied: Callable[..., Bench]) -> None:
    bench, said = copied(), []
    found = left_out(bench, Choice(count=4), said, "localize.method=tracks")
    assert any(line.startswith("  tracks ") for line in said), said
    row = found.table.to_dict()["rows"][0]
    assert row["localized"]["value"] == 100.0
    assert 0.0005 < row["median_position"]["value"] < 0.02
    assert 0.1 < row["nees_per_dof"]["value"] < 3.0
    for path in sorted((bench.output / "work" / "reference" / "leave-one-out").rglob("*.npz")):
        with np.load(path) as stored:
            header = json.loads(stored["header_json"].tobytes())
        assert len(header["references"]) >= 2
        assert header["image_id"] not in [*header["references"], *header["candidates"]]


def test_more_images_are_added_to_those_that_are_there(copied: Callable[..., Bench]) -> None:
    bench = copied()
    left_out(bench, Choice(count=2))
    items = bench.output / "work" / "reference" / "leave-one-out"
    before = {path: path.stat().st_mtime_ns for path in items.rglob("*.npz")}
    left_out(bench, Choice(count=3))
    after = {path: path.stat().st_mtime_ns for path in items.rglob("*.npz")}
    assert len(before) == 2
    assert len(after) == 3
    assert before.items() <= after.items()


def test_figure_draws_every_image_inside_its_frame() -> None:
    assert panels([]) == [replace(panel, names=[], sigmas=[], errors=[]) for panel in panels([])]
    picture = reliability_figure(panels([]))
    assert picture.startswith("<svg ")
    assert picture.endswith("</svg>\n")


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        (["--leave-one-out"], "--leave-one-out is given with no project"),
        (["P", "--leave-one-out", "--truth", "t.csv"], "--leave-one-out is given with --truth"),
        (["P", "--count", "3"], "Add --leave-one-out"),
        (["P"], "There is nothing to compare with"),
    ],
)
def test_options_that_do_not_go_together(options: list[str], problem: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert exit_code(app, ["evaluate", *options]) == 1
    assert problem in capsys.readouterr().err
