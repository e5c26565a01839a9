"""A run that was killed, and results that were damaged: what is whole is kept, what is not is computed again."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from georef.errors import StageError
from tests.stages.bench import Bench
from tests.worlds.tiny import EPOCH

KILLED_AT_THE_SECOND = """
import os, signal, sys
from pathlib import Path
from georef.executor import Executor
from georef.pipeline import run_pipeline
from georef.project import open_project
from georef.stages import localize

original, calls = localize.localize_image, []
def killed(*arguments):
    calls.append(1)
    if len(calls) == 2:
        os.kill(os.getpid(), signal.SIGKILL)
    return original(*arguments)
localize.localize_image = killed
project = open_project(Path(sys.argv[1]), output=Path(sys.argv[2]))
list(run_pipeline(project, sys.argv[3], Executor()))
"""

KILLED_WHILE_ADJUSTING = """
import os, signal, sys
from pathlib import Path
from georef.executor import Executor
from georef.pipeline import run_pipeline
from georef.project import open_project
from georef.stages import adjust, tie_matches

class Killing(adjust.SolveFiles):
    def write(self, key, reached):
        super().write(key, reached)
        if reached.solution.iterations == 2:
            os.kill(os.getpid(), signal.SIGTERM)

original, calls = tie_matches.match_pair, []
def killed(*arguments):
    calls.append(1)
    if len(calls) == 2 and sys.argv[4] == "ties":
        os.kill(os.getpid(), signal.SIGKILL)
    return original(*arguments)
tie_matches.match_pair, tie_matches._SHARD_PAIRS = killed, 1
adjust.SolveFiles = Killing
project = open_project(Path(sys.argv[1]), output=Path(sys.argv[2]))
list(run_pipeline(project, sys.argv[3], Executor()))
"""


def stage_folder(bench: Bench, stage: str) -> Path:
    return bench.states()[stage].folder


def items(bench: Bench) -> dict[str, int]:
    """Time of change of each stored outcome of the stage localize."""
    folder = stage_folder(bench, "localize") / "items"
    return {path.name: path.stat().st_mtime_ns for path in folder.glob("*.npz")}


def forget(bench: Bench, *stages: str) -> None:
    for stage in stages:
        shutil.rmtree(stage_folder(bench, stage))
    shutil.rmtree(bench.open().published(EPOCH))


def test_a_killed_run_goes_on_where_it_was(copied: Callable[..., Bench], finished: Bench) -> None:
    bench = copied()
    forget(bench, "localize", "adjust", "report")
    command = [sys.executable, "-c", KILLED_AT_THE_SECOND, str(bench.data), str(bench.output), EPOCH]
    killed = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False, env=dict(os.environ))
    assert killed.returncode == -signal.SIGKILL, killed.stderr
    kept = items(bench)
    assert list(kept) == ["n0.jpg.npz"]
    state = bench.states()["localize"]
    assert (state.state, state.why) == ("partial", "interrupted; 1 items are kept")

    results = bench.run()
    assert results["features"].reused
    assert results["network"].reused
    assert (results["localize"].summary.computed, results["localize"].summary.total) == (2, 3)
    assert kept.items() <= items(bench).items()
    assert bench.published("poses.csv") == finished.published("poses.csv")


def test_an_adjustment_that_was_killed_goes_on_where_it_was(
    copied: Callable[..., Bench], finished: Bench, caplog: pytest.LogCaptureFixture
) -> None:
    bench = copied()
    pairs = bench.run()["adjust"].summary.data["pairs_matched"]
    shutil.rmtree(stage_folder(bench, "adjust").parent)
    for where, signalled in (("ties", signal.SIGKILL), ("solve", signal.SIGTERM)):
        command = [sys.executable, "-c", KILLED_WHILE_ADJUSTING, str(bench.data), str(bench.output), EPOCH, where]
        killed = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False, env=dict(os.environ))
        assert killed.returncode == -signalled, killed.stderr
        ties = len(list((stage_folder(bench, "adjust").parent / "ties").glob("*.npz")))
        assert ties == (1 if where == "ties" else pairs)
    assert len(list((stage_folder(bench, "adjust") / "solves").glob("*.npz"))) == 1
    with caplog.at_level("INFO"):
        result = bench.run()["adjust"].summary.data
    assert result["pairs_matched"] == 0
    assert "going on after iteration 2" in caplog.text
    assert not (stage_folder(bench, "adjust") / "solves").exists()
    assert bench.published("poses.csv") == finished.published("poses.csv")
    for name in ("localization.csv", "poses.csv"):
        assert bench.published(name) == finished.published(name)


def test_a_damaged_outcome_names_its_file_and_is_computed_again(copied: Callable[..., Bench], finished: Bench) -> None:
    bench = copied()
    damaged = stage_folder(bench, "localize") / "items" / "n1.jpg.npz"
    damaged.write_bytes(damaged.read_bytes()[:500])
    forget(bench, "adjust", "report")
    with pytest.raises(StageError, match=r"(?s)cannot be read.*Delete the file and run again.*n1\.jpg\.npz"):
        bench.run()
    before = items(bench)
    damaged.unlink()
    results = bench.run()
    assert results["localize"].summary.computed == 1
    assert {name for name, time in items(bench).items() if before.get(name) != time} == {"n1.jpg.npz"}
    assert bench.published("poses.csv") == finished.published("poses.csv")


def test_damaged_features_are_extracted_again(copied: Callable[..., Bench], finished: Bench) -> None:
    bench = copied()
    stored = next(bench.open().feature_folder.rglob("*n2.jpg.safetensors"))
    stored.write_bytes(stored.read_bytes()[:500])
    forget(bench, "features", "adjust", "report")
    results = bench.run()
    assert results["features"].summary.computed == 1
    assert results["localize"].reused
    assert bench.published("poses.csv") == finished.published("poses.csv")


def test_what_was_published_and_is_gone_is_published_again(copied: Callable[..., Bench], finished: Bench) -> None:
    bench = copied()
    shutil.rmtree(bench.open().published(EPOCH))
    results = bench.run()
    assert [name for name, result in results.items() if not result.reused] == ["report"]
    assert bench.published("poses.csv") == finished.published("poses.csv")


@pytest.mark.parametrize("name", ["poses.csv", "report.html"])
def test_one_published_file_that_is_gone_is_written_again(copied: Callable[..., Bench], name: str) -> None:
    bench = copied()
    (bench.open().published(EPOCH) / name).unlink()
    bench.run()
    assert (bench.open().published(EPOCH) / name).is_file()


def test_a_stage_record_that_is_cut_off_counts_as_not_done(copied: Callable[..., Bench], finished: Bench) -> None:
    bench = copied()
    record = stage_folder(bench, "localize") / "stage.json"
    record.write_text(record.read_text(encoding="utf-8")[:50], encoding="utf-8")
    results = bench.run()
    assert (results["localize"].reused, results["localize"].summary.computed) == (False, 0)
    assert bench.published("poses.csv") == finished.published("poses.csv")
