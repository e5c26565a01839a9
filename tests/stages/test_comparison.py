"""Evaluation of a project: variants through the ordinary pipeline, tables against the truth, what is kept."""

from __future__ import annotations

import csv
import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from georef.cli import app
from georef.comparison.evaluate import Comparison, compare, write_comparison
from georef.comparison.run import Runs, Source
from georef.comparison.variants import Variant, read_tables
from georef.errors import ConfigError, InputError
from georef.evaluation.pose_errors import TruthSigmas
from georef.executor import Executor
from georef.terminal import exit_code
from georef.types.results import Localized
from tests.stages.bench import Bench
from tests.worlds.tiny import EPOCH

TABLES = """
[[tables]]
name = "cameras"
title = "By camera"
rows = "cameras"

[[tables]]
name = "epochs"
title = "By reference epoch"
rows = "reference-epochs"

[[tables]]
name = "models"
title = "Local and global"
variants = [
  { name = "local" },
  { name = "global", set = { localize.method = "global-model" } },
  { name = "nothing", set = { localize.min_inliers = 100000 } },
  { name = "unknown", set = { matching.matcher = "no-such" } },
]

[[tables]]
name = "retrieval"
title = "Pre-filter"
columns = "retrieval"
variants = [
  { name = "none", set = { candidates.box = "none" } },
  { name = "4 m", set = { candidates.box = "fixed", candidates.half_side_m = 4.0 } },
]
"""

TOGETHER = """
[[tables]]
name = "stations"
title = "Together"
poses = "stations"
variants = [
  { name = "single image", set = { stations.together = "none" } },
  { name = "sequence", set = { stations.together = "sequence" } },
]
"""


@pytest.fixture
def tables(tmp_path: Path) -> Path:
    path = tmp_path / "tables.toml"
    path.write_text(TABLES, encoding="utf-8")
    return path


def truth_of(bench: Bench) -> Path:
    return bench.data / f"truth_{EPOCH}_eo.csv"


def compared(bench: Bench, tables: Path, *wanted: str, truth: Path | None = None, said: list | None = None):
    source = Source(bench.data, output=bench.output)
    say = (said if said is not None else []).append
    sigmas = TruthSigmas()
    return compare(
        source, truth or truth_of(bench), sigmas, variants=tables, wanted=wanted, executor=Executor(), say=say
    )


def rows(comparison: Comparison, name: str) -> dict[str, dict]:
    table = next(table for table in comparison.tables if table.name == name)
    return {row["name"]: row for row in table.to_dict()["rows"]}


def test_all_tables_and_files(copied: Callable[..., Bench], tables: Path) -> None:
    bench = copied()
    comparison = compared(bench, tables)
    models = rows(comparison, "models")
    assert 0.0003 < models["local"]["median_position"]["value"] < 0.01
    assert 0.0003 < models["global"]["median_position"]["value"] < 0.01
    assert models["global"]["median_position"] != models["local"]["median_position"]
    assert models["nothing"]["localized"]["value"] == models["nothing"]["within_1m_10deg"]["value"] == 0.0
    assert models["nothing"]["median_position"]["value"] == "infinite"
    assert models["unknown"]["images"] is None
    assert rows(comparison, "cameras").keys() == {"cam"}
    assert rows(comparison, "epochs").keys() == {"reference"}
    assert rows(comparison, "retrieval")["none"]["recall_at_10"]["value"] == 100.0
    paths = {path.name: path for path in write_comparison(comparison)}
    data = json.loads(paths["evaluation.json"].read_text(encoding="utf-8"))
    assert data["curves"]["models"]["local"]["position_m"]["total"] == 3
    assert data["errors"]["models"]["nothing"]["failed"] == ["n0.jpg", "n1.jpg", "n2.jpg"]
    assert "not run. There is no matcher &#39;no-such&#39;" in paths["evaluation.html"].read_text(encoding="utf-8")
    stored = list(csv.DictReader(paths["models.csv"].read_text(encoding="utf-8").splitlines()))
    assert float(stored[0]["median_position_m"]) == pytest.approx(models["local"]["median_position"]["value"])
    curve = list(csv.DictReader(paths["models-curves.csv"].read_text(encoding="utf-8").splitlines()))
    assert (curve[0]["limit"], curve[-1]["limit"], curve[-1]["local_percent"]) == ("0.0005", "10", "100")
    assert paths["models-position.svg"].read_text(encoding="utf-8").startswith("<svg ")


def test_costs_are_those_of_the_steps_and_the_files(copied: Callable[..., Bench], tables: Path) -> None:
    bench = copied()
    comparison = compared(bench, tables, "models")
    runtime = next(t for t in comparison.tables if t.name == "runtime").rows
    steps = [(row["name"], row["step"]) for row in runtime]
    assert len(set(steps)) == len(steps)
    assert [name for name, step in steps if step == "features"] == ["models: local"]
    assert ("models: global", "global-map") in steps
    local = {row["step"]: row for row in runtime if row["name"] == "models: local"}
    parts = [
        row["cpu"] for step, row in local.items() if str(step).startswith("localize: ") and step != "localize: all"
    ]
    assert local["localize: all"]["cpu"] == pytest.approx(np.sum(np.array(parts, dtype=float)))
    storage = next(t for t in comparison.tables if t.name == "storage").rows
    features = next(row for row in storage if row["what"] == "local features")
    files = list(bench.open().feature_folder.rglob("*.safetensors"))
    assert (features["images"], features["bytes"]) == (len(files), sum(f.stat().st_size for f in files))
    assert features["keypoints"] == 700


def test_images_posed_together_stand_beside_single_ones(copied: Callable[..., Bench], tmp_path: Path) -> None:
    path = tmp_path / "together.toml"
    path.write_text(TOGETHER, encoding="utf-8")
    comparison = compared(copied(), path)
    runs = {row.name: row.run for row in comparison.rows["stations"]}
    poses = {
        name: [o.world_from_cam.matrix() for o in run.outcomes if isinstance(o, Localized)]
        for name, run in runs.items()
    }
    assert len(poses["single image"]) == len(poses["sequence"]) == 3
    moved = np.abs(np.array(poses["single image"]) - np.array(poses["sequence"])).max()
    assert 1e-6 < moved < 0.02
    assert [run.costs[-1].stage for run in runs.values()] == ["localize", "stations"]
    runtime = next(t for t in comparison.tables if t.name == "runtime").rows
    assert [row["name"] for row in runtime if row["step"] == "localize: all"] == ["stations: single image"]
    assert [row["name"] for row in runtime if row["step"] == "stations"] == ["stations: sequence"]


def test_the_pipeline_runs_without_the_truth(
    finished: Bench, copied: Callable[..., Bench], tables: Path, tmp_path: Path
) -> None:
    """From nothing, with no truth file anywhere, it gives the poses that it gave beside one."""
    bench = copied(data=True)
    truth_of(bench).unlink()
    source = Source(bench.data, output=tmp_path / "fresh")
    variants = read_tables(tables, ["models"])[0].variants[:2]
    blind = {v.name: Runs(source, Executor(), _silent).run(v).outcomes for v in variants}
    beside = Runs(Source(finished.data, output=finished.output), Executor(), _silent).run(variants[0]).outcomes
    for ours, theirs in zip(blind["local"], beside, strict=True):
        assert isinstance(ours, Localized)
        assert isinstance(theirs, Localized)
        assert np.array_equal(ours.world_from_cam.matrix(), theirs.world_from_cam.matrix())
    assert all(isinstance(outcome, Localized) for outcome in blind["global"])
    with pytest.raises(InputError, match="truth"):
        compared(bench, tables, "models")


def _silent(line: str) -> None:
    assert line


def test_errors_follow_the_truth_that_is_named(copied: Callable[..., Bench], tables: Path, tmp_path: Path) -> None:
    bench = copied()
    lines = truth_of(bench).read_text(encoding="utf-8").splitlines()
    moved = [
        ",".join([c if i != 3 else f"{float(c) + 0.07:.5f}" for i, c in enumerate(x.split(","))]) for x in lines[2:]
    ]
    other = tmp_path / "moved.csv"
    other.write_text("\n".join([*lines[:2], *moved]) + "\n", encoding="utf-8")
    found = rows(compared(bench, tables, "cameras", truth=other), "cameras")["cam"]
    assert found["median_position"]["value"] == pytest.approx(0.07, abs=0.005)
    assert (found["within_0.05m_0.5deg"]["value"], found["within_0.1m_1deg"]["value"]) == (0.0, 100.0)


def test_what_is_done_is_kept(copied: Callable[..., Bench], tables: Path) -> None:
    bench = copied()
    compared(bench, tables, "models", "retrieval")
    before = bench.files()
    said: list[str] = []
    compared(bench, tables, "models", "retrieval", said=said)
    assert bench.files() == before
    stages = [line for line in said if line.startswith("  ")]
    assert stages
    assert all(line.endswith("[kept]") for line in stages)


KILLED_AT_THE_FOURTH = """
import os, signal, sys
from pathlib import Path
from georef.executor import Executor
from georef.pipeline import run_pipeline
from georef.project import open_project
from georef.stages import global_map

original, calls = global_map.write_matches, []
def killed(*arguments):
    calls.append(1)
    if len(calls) == 4:
        os.kill(os.getpid(), signal.SIGKILL)
    return original(*arguments)
global_map.write_matches = killed
settings = ("localize.method=global-model", "global_map.block_images=3")
project = open_project(Path(sys.argv[1]), output=Path(sys.argv[2]), settings=settings)
list(run_pipeline(project, sys.argv[3], Executor(), "localize"))
"""


def test_a_killed_map_goes_on_where_it_was(copied: Callable[..., Bench]) -> None:
    bench = copied()
    settings = ("localize.method=global-model", "global_map.block_images=3")
    command = [sys.executable, "-c", KILLED_AT_THE_FOURTH, str(bench.data), str(bench.output), EPOCH]
    killed = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False, env=dict(os.environ))
    assert killed.returncode == -signal.SIGKILL, killed.stderr
    folder = bench.states(*settings)["global-map"].folder
    kept = {path: path.stat().st_mtime_ns for path in (folder / "matches").glob("*.npz")}
    assert len(kept) == 3
    result = bench.run(*settings)["global-map"]
    assert (result.summary.computed, result.summary.total) == (5, 8)
    assert kept.items() <= {path: path.stat().st_mtime_ns for path in (folder / "matches").glob("*.npz")}.items()
    again = copied_structure(folder)
    lost = sorted((folder / "structure").glob("*.npz"))[0]
    lost.unlink()
    (folder / "stage.json").unlink()
    bench.run(*settings)
    for name, points in copied_structure(folder).items():
        assert np.array_equal(points, again[name])


def copied_structure(folder: Path) -> dict[str, np.ndarray]:
    return {path.name: np.load(path)["points"] for path in (folder / "structure").glob("*.npz")}


def test_the_map_is_no_part_of_other_methods(finished: Bench) -> None:
    assert "global-map" not in finished.states()
    assert "global-map" in finished.states("localize.method=global-model")


def test_workers_make_the_same_map(copied: Callable[..., Bench], tmp_path: Path) -> None:
    one = copied()
    two = Bench(one.data, Path(shutil.copytree(one.output, tmp_path / "two")))
    settings = ("localize.method=global-model",)
    folders = []
    for bench, workers in ((one, 1), (two, 2)):
        results = bench.run(*settings, executor=Executor(workers, 1))
        folders.append(results["global-map"].context.folder)
    first, second = (copied_structure(folder) for folder in folders)
    assert first.keys() == second.keys()
    assert all(np.array_equal(first[name], second[name]) for name in first)


def test_the_default_tables_fit_the_configuration(finished: Bench) -> None:
    source = Source(finished.data, output=finished.output)
    listed = read_tables(None, [])
    assert [table.name for table in listed] == ["cameras", "epochs", "features", "retrieval", "models", "stations"]
    for variant in (v for table in listed for v in table.variants):
        source.open(variant)
    boxes = [source.open(v)[0].config.candidates for v in listed[3].variants]
    five = [
        ("none", 100.0, 180.0),
        *(("fixed", 100.0, angle) for angle in (180.0, 90.0)),
        *(("fixed", 15.0, angle) for angle in (180.0, 90.0)),
    ]
    assert [(c.box, c.half_side_m, c.heading_window_deg) for c in boxes] == 2 * five  # of two global descriptors
    assert {c.ranking for c in boxes} == {"global"}


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (("candidates.half_side_m", "candidates.half_sid_m"), "Did you mean 'half_side_m'"),
        (('name = "4 m"', 'name = "none"'), "a name of its own"),
        (('columns = "retrieval"', 'columns = "speed"'), "columns"),
        (('name = "models"', 'name = "cameras"'), "a name of its own"),
    ],
)
def test_a_mistake_in_the_tables_shows_before_any_work(
    finished: Bench, tables: Path, tmp_path: Path, change: tuple[str, str], text: str
) -> None:
    tables.write_text(TABLES.replace(*change), encoding="utf-8")
    bench = Bench(finished.data, tmp_path / "fresh")
    with pytest.raises(ConfigError, match=text):
        compared(bench, tables)
    assert not bench.output.exists()


def test_the_variant_s_setting_wins_over_the_command_line_s(finished: Bench) -> None:
    source = Source(finished.data, output=finished.output, settings=("localize.seed=3", "candidates.count=5"))
    variant = Variant(name="v", set={"localize": {"seed": 7}})
    config = source.open(variant)[0].config
    assert (config.localize.seed, config.candidates.count) == (7, 5)


def test_the_command_line(
    copied: Callable[..., Bench], tables: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    bench = copied()

    def called(*arguments: object) -> int:
        return exit_code(app, ["evaluate", *map(str, arguments)])

    options = ["--truth", truth_of(bench), "-o", bench.output, "--variants", tables]
    assert called(bench.data, *options, "--tables", "cameras") == 0
    text = capsys.readouterr().out
    assert "By camera" in text
    assert "Runtime by step" in text
    assert str(bench.output / "evaluation" / EPOCH / "evaluation.html") in text
    assert called(bench.data, *options, "--tables", "speed") == 1
    assert "Expected one of cameras, epochs, models, retrieval" in capsys.readouterr().err
    assert called("--truth", truth_of(bench)) == 1
    assert "Neither a project nor a file of poses" in capsys.readouterr().err
    other = tmp_path / "other.csv"
    other.write_text(
        truth_of(bench).read_text(encoding="utf-8").replace("n0", "x0").replace("n1", "x1"), encoding="utf-8"
    )
    other.write_text(other.read_text(encoding="utf-8").replace("n2", "x2"), encoding="utf-8")
    assert called(bench.data, "--truth", other, "-o", bench.output, "--variants", tables) == 1
    assert "the first there is 'x0.jpg'" in capsys.readouterr().err
