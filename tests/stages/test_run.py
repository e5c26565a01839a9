"""The common route on the small world: run, run again, run elsewhere, run with other settings, run on workers."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from georef.cli import app
from georef.executor import Executor
from georef.stages.evaluate import evaluate
from georef.terminal import exit_code
from tests.stages.bench import Bench
from tests.worlds.tiny import EPOCH, TinyWorld

STAGES = ["features", "network", "index", "localize", "adjust", "report"]


def test_all_images_come_out_right(finished: Bench, tiny_world: TinyWorld) -> None:
    """Two-sided: a position error far below the noise of the pictures would mean that the truth leaked."""
    poses = finished.open().published(EPOCH) / "poses.csv"
    errors = evaluate(poses, tiny_world.data / f"truth_{EPOCH}_eo.csv").errors
    assert errors.failed == ()
    assert 0.0002 < errors.position_m.median < 0.01
    assert 0.0002 < errors.rotation_deg.median < 0.03
    report = json.loads(finished.published("report.json"))
    assert report["check_points"]["count"] >= 8
    assert 0.002 < report["check_points"]["rmse_3d_m"] < 0.03


def test_a_second_run_computes_nothing(finished: Bench) -> None:
    before = finished.files()
    results = finished.run()
    assert list(results) == STAGES
    assert all(result.reused and result.summary.computed == 0 for result in results.values())
    assert {name: r.summary.total for name, r in results.items()} == {
        "features": 11,
        "network": 8,
        "index": 8,
        "localize": 3,
        "adjust": 3,
        "report": 1,
    }
    assert finished.files() == before
    assert {state.state for state in finished.states().values()} == {"done"}


def test_results_elsewhere_leave_the_project_alone(finished: Bench) -> None:
    assert sorted(p.name for p in finished.data.iterdir()) == [
        "camera.csv",
        f"marks_{EPOCH}.csv",
        "points.csv",
        "project.toml",
        "reference",
        "reference_eo.csv",
        EPOCH,
        f"{EPOCH}_gnss.csv",
        f"truth_{EPOCH}_eo.csv",
    ]


def test_two_workers_give_the_same(finished: Bench, tmp_path: Path) -> None:
    bench = Bench(finished.data, tmp_path)
    results = bench.run(executor=Executor(workers=2, threads=1))
    assert results["features"].summary.computed == 11
    assert results["localize"].summary.computed == 3
    for name in ("localization.csv", "poses.csv"):
        assert bench.published(name) == finished.published(name)


def test_a_changed_setting_makes_stale_what_depends_on_it(copied: Callable[..., Bench]) -> None:
    bench = copied()
    states = bench.states("adjust.cauchy_scale=2.5")
    assert {name: s.state for name, s in states.items()} == {
        "features": "done",
        "network": "stale",
        "index": "done",
        "localize": "stale",
        "adjust": "stale",
        "report": "stale",
    }
    assert states["network"].why == "changed: [adjust.cauchy_scale]"
    assert states["localize"].why == "changed: stage network"
    states = bench.states("report.recording_max_points=10")
    assert [name for name, s in states.items() if s.state != "done"] == ["report"]
    assert states["report"].why == "changed: [report]"


def test_going_back_to_earlier_settings_computes_nothing(copied: Callable[..., Bench], finished: Bench) -> None:
    """Folders of other settings stay; only what is published is written again."""
    bench = copied()
    changed = bench.run("adjust.tie_points=false")
    assert not changed["adjust"].reused
    assert bench.published("poses.csv") != finished.published("poses.csv")
    again = bench.run()
    assert [name for name, result in again.items() if not result.reused] == ["report"]
    assert bench.published("poses.csv") == finished.published("poses.csv")


@pytest.mark.parametrize("name", ["reference_eo.csv", f"{EPOCH}_gnss.csv", "points.csv"])
def test_a_changed_table_is_noticed(copied: Callable[..., Bench], name: str) -> None:
    bench = copied(data=True)
    path = bench.data / name
    lines = path.read_text(encoding="utf-8").splitlines()
    at = next(i for i, line in enumerate(lines) if ",check," in line or (name != "points.csv" and i == 2))
    cells = lines[at].split(",")
    place = 3 if name == "points.csv" else 1
    cells[place] = f"{float(cells[place]) + 0.001:.4f}"
    lines[at] = ",".join(cells)
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    first = next(state for state in bench.states().values() if state.state != "done")
    assert (first.stage, first.why) == {
        "reference_eo.csv": ("network", "changed: reference tables"),
        f"{EPOCH}_gnss.csv": ("localize", "changed: epoch tables"),
        "points.csv": ("report", "changed: check points"),
    }[name]


def test_poses_are_the_same_with_another_origin(copied: Callable[..., Bench], finished: Bench) -> None:
    """The origin of the world is a choice; what is published must not depend on it."""
    bench = copied()
    bench.run("crs.origin=[456600, 5421000, 160]")
    ours, theirs = _numbers(bench.published("poses.csv")), _numbers(finished.published("poses.csv"))
    assert np.abs(ours - theirs).max() < 2e-3  # another thinning and rounding, 2 mm at most


def _numbers(poses: bytes) -> np.ndarray:
    rows = [line.split(",") for line in poses.decode().splitlines() if not line.startswith(("#", "image"))]
    return np.array([[float(cell) for cell in row[1:4]] for row in rows])


def test_the_command_says_a_line_a_stage_and_where_results_are(
    copied: Callable[..., Bench], capsys: pytest.CaptureFixture[str]
) -> None:
    bench = copied()
    assert exit_code(app, ["run", str(bench.data), "-o", str(bench.output)]) == 0
    lines = capsys.readouterr().out.splitlines()
    of_stages, of_files = lines[: len(STAGES)], lines[len(STAGES) :]
    assert [line.split()[0] for line in of_stages] == STAGES
    assert all(line.endswith("[kept]") for line in of_stages)
    names = ["poses.csv", "localization.csv", "report.html", "report.json", "adjustment.txt"]
    assert [line.split()[0] for line in of_files] == names
    assert all(Path(line.split()[-1]).is_file() for line in of_files)


def test_the_report_is_rendered_again_from_its_data(
    copied: Callable[..., Bench], finished: Bench, capsys: pytest.CaptureFixture[str]
) -> None:
    bench = copied()
    page = bench.open().published(EPOCH) / "report.html"
    page.write_text("spoilt", encoding="utf-8")
    assert exit_code(app, ["report", str(bench.data), "-o", str(bench.output)]) == 0
    assert str(page) in capsys.readouterr().out
    assert page.read_bytes() == finished.published("report.html")
