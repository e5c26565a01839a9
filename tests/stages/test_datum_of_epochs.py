"""The datum sentinel by the command line: what is wrong with GNSS ends with exit code 1 and its name."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from georef.cli import app
from georef.geometry.rigid import Array
from georef.terminal import exit_code
from tests.worlds.tiny import EPOCH, TinyWorld, write_tiny_world

Change = Callable[[Array], Array]


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> TinyWorld:
    """Twelve new images in a local CRS, where no area of use gives a fault away."""
    return write_tiny_world(tmp_path_factory.mktemp("tiny"), more=9, local=True)


@pytest.fixture(scope="module")
def kept(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Results that all runs share: features, network and index are made once."""
    return tmp_path_factory.mktemp("output")


def _run(world: TinyWorld, folder: Path, kept: Path, change: Change, *settings: str) -> int:
    """Runs a copy of the project with changed GNSS positions; the exit code."""
    data = folder / "data"
    if not data.exists():
        shutil.copytree(world.data, data)
    path = world.data / f"{EPOCH}_gnss.csv"
    (data / path.name).write_text(_changed(path.read_text(encoding="utf-8"), change), encoding="utf-8")
    options = [part for setting in settings for part in ("--set", setting)]
    return exit_code(app, ["run", str(data), "-o", str(kept), *options])


def _changed(text: str, change: Change) -> str:
    lines = text.splitlines()
    out = []
    for line in lines:
        cells = line.split(",")
        if line.startswith("#") or cells[0] == "image":
            out.append(line)
        else:
            moved = change(np.array([[float(v) for v in cells[1:4]]]))[0]
            out.append(",".join([cells[0], *(f"{v:.3f}" for v in moved), *cells[4:]]))
    return "\n".join(out) + "\n"


def test_good_positions_pass(world: TinyWorld, kept: Path, tmp_path: Path) -> None:
    assert _run(world, tmp_path, kept, lambda p: p) == 0
    report = json.loads((kept / "epochs" / EPOCH / "report.json").read_text(encoding="utf-8"))
    (compared,) = (c for c in report["datum"]["comparisons"] if c["source"] == "GNSS")
    assert compared["pairs"] == 12
    assert compared["findings"] == []


def _plus(*shift: float) -> Change:
    return lambda p: p + np.array(shift)


_FAULTS: dict[str, tuple[Change, str, str]] = {
    "geoid": (_plus(0.0, 0.0, 47.3), "height offset", r"Heights of GNSS are \+4[67]\.\d+ m.*geoid"),
    "swapped": (
        lambda p: p[:, [1, 0, 2]],
        "axes swapped",
        "easting and northing are swapped",
    ),
    "feet": (lambda p: p / 0.3048, "feet", "in feet that were taken as metres"),
    "zone": (_plus(430_000.0, 21_000.0, 0.0), "wrong zone", "wrong zone of the projection"),
}


@pytest.mark.parametrize("fault", list(_FAULTS))
def test_a_fault_ends_the_run_with_its_name(
    fault: str, world: TinyWorld, kept: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    change, kind, words = _FAULTS[fault]
    assert _run(world, tmp_path, kept, change) == 1
    said = " ".join(capsys.readouterr().err.split())
    assert re.search(words, said), said
    assert f"adjust.accept_datum='[\"{kind}\"]'" in said
    assert f"{EPOCH}_gnss.csv" in said


def test_what_is_accepted_goes_on_and_is_said(
    world: TinyWorld, kept: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    change, kind, _ = _FAULTS["geoid"]
    assert _run(world, tmp_path, kept, change, f'adjust.accept_datum=["{kind}"]') == 0
    capsys.readouterr()
    report = json.loads((kept / "epochs" / EPOCH / "report.json").read_text(encoding="utf-8"))
    (found,) = report["datum"]["comparisons"][0]["findings"]
    assert found["accepted"]
    assert found["value"][0] == pytest.approx(47.3, abs=1.5)
    assert "Accepted" in (kept / "epochs" / EPOCH / "adjustment.txt").read_text(encoding="utf-8")


def test_without_gnss_in_the_adjustment_a_fault_is_a_warning(world: TinyWorld, kept: Path, tmp_path: Path) -> None:
    assert _run(world, tmp_path, kept, _FAULTS["geoid"][0], "adjust.gnss=false") == 0
    report = json.loads((kept / "epochs" / EPOCH / "report.json").read_text(encoding="utf-8"))
    assert report["datum"]["comparisons"][0]["findings"][0]["kind"] == "height offset"
