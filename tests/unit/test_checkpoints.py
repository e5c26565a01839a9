"""An adjustment that is killed goes on from its last iteration, and ends at the same numbers."""

from __future__ import annotations

import logging
import os
import re
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from georef.estimation.adjustment.adjust_block import BlockOptions, adjust_block
from georef.estimation.adjustment.block import Block, State
from georef.estimation.adjustment.campaign.checkpoints import Reached, Resumable, digest_of
from georef.estimation.adjustment.solver import BlockSolution, SolverOptions, solve_block
from georef.geometry.poses import Poses
from georef.io.bal import BalProblem, write_bal
from georef.stages.bal import run_bal
from georef.stages.solve_files import SolveFiles
from tests.unit.test_io_bal import _problem as bal_problem
from tests.worlds.rig_blocks import rig_block

_KILLED = """
import os, signal, sys
from pathlib import Path
from georef.estimation.adjustment.adjust_block import BlockOptions, adjust_block
from georef.estimation.adjustment.campaign.checkpoints import Resumable
from georef.io.bal import BalProblem, write_bal
from georef.stages.bal import run_bal
from georef.stages.solve_files import SolveFiles
from tests.unit.test_io_bal import _problem as bal_problem
from tests.worlds.rig_blocks import rig_block

class Killing(SolveFiles):
    def write(self, key, reached):
        super().write(key, reached)
        left[0] -= 1
        if not left[0]:
            os.kill(os.getpid(), signal.SIGTERM if sys.argv[3] == "term" else signal.SIGKILL)

left = [int(sys.argv[2])]
adjust_block(rig_block(3).block, BlockOptions.of(2.0), Resumable(Killing(Path(sys.argv[1]))))
"""


class _Killed(Exception):
    pass


class _Memory:
    """Checkpoints that end the adjustment after a number of iterations."""

    def __init__(self, lasts: int) -> None:
        self.kept: dict[str, Reached] = {}
        self.lasts, self.iterations = lasts, 0

    def read(self, key: str) -> Reached | None:
        return self.kept.get(key)

    def write(self, key: str, reached: Reached) -> None:
        self.kept[key] = reached
        self.iterations += not reached.finished
        if self.iterations >= self.lasts and not reached.finished:
            self.lasts += self.iterations
            raise _Killed


def _same(a: State, b: State, tolerance: float = 0.0) -> bool:
    """Whether two states are equal up to what summing in another order can do."""
    moved = np.concatenate([np.abs(x.local(y)).ravel() for x, y in _poses(a, b)])
    points = np.abs(a.points - b.points).max()
    cameras = all(abs(x.fx - y.fx) <= 1e3 * tolerance for x, y in zip(a.cameras, b.cameras, strict=True))
    return bool(moved.max() <= max(tolerance, 1e-13) and points <= tolerance and cameras)


def _poses(a: State, b: State) -> list[tuple[Poses, Poses]]:
    return [(a.world_from_rig, b.world_from_rig), (a.rig_from_cam, b.rig_from_cam)]


def test_an_adjustment_that_is_interrupted_again_and_again_does_no_iteration_twice() -> None:
    block, options = rig_block(2).block, BlockOptions.of(2.0)
    through = _Memory(10**9)
    whole = adjust_block(block, options, Resumable(through))
    kept = _Memory(2)
    interruptions = 0
    while True:
        try:
            found = adjust_block(block, options, Resumable(kept))
            break
        except _Killed:
            interruptions += 1
    assert interruptions >= 3
    # An interruption behind the last iteration of a solve costs one more: nobody could note that it was the last.
    assert through.iterations <= kept.iterations <= through.iterations + interruptions
    assert np.abs(found.solution.state.world_from_rig.local(whole.solution.state.world_from_rig)).max() < 1e-9
    assert found.solution.cost == pytest.approx(whole.solution.cost, rel=1e-12)


@pytest.mark.parametrize("how", ["term", "kill"])
def test_a_killed_process_leaves_what_the_next_one_goes_on_from(
    how: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    root = str(Path(__file__).parents[2])
    command = [sys.executable, "-c", _KILLED, str(tmp_path), "3", how]
    killed = subprocess.run(
        command, capture_output=True, text=True, timeout=300, check=False, env={**os.environ, "PYTHONPATH": root}
    )
    assert killed.returncode == -(signal.SIGTERM if how == "term" else signal.SIGKILL), killed.stderr
    block, options = rig_block(3).block, BlockOptions.of(2.0)
    with caplog.at_level(logging.INFO):
        resumed = adjust_block(block, options, Resumable(SolveFiles(tmp_path)))
    assert re.search(r"going on after iteration 3", caplog.text)
    resumed_iterations = caplog.text.count(": cost ")
    caplog.clear()
    with caplog.at_level(logging.INFO):
        whole = adjust_block(block, options)
    assert resumed_iterations == caplog.text.count(": cost ") - 3
    assert _same(resumed.solution.state, whole.solution.state, 1e-9)
    assert resumed.solution.iterations == whole.solution.iterations
    SolveFiles(tmp_path).clear()
    assert not tmp_path.exists()


def test_a_changed_input_starts_anew(tmp_path: Path) -> None:
    block, files = rig_block(4).block, SolveFiles(tmp_path)

    def solve(given: Block, **others: Any) -> BlockSolution:
        return Resumable(files)(given, **others)

    first, again = solve(block), solve(block)
    assert _same(again.state, first.state)
    assert len(list(tmp_path.iterdir())) == 1
    moved = replace(block, observations=replace(block.observations, pixel=block.observations.pixel + 0.01))
    assert _same(solve(moved).state, solve_block(moved).state, 1e-12)
    solve(block, options=SolverOptions(max_iterations=3))
    solve(block, losses={"image observations": 2.0})
    assert len(list(tmp_path.iterdir())) == 4


def test_a_damaged_checkpoint_counts_as_none(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    block, files = rig_block(4).block, SolveFiles(tmp_path)
    first = Resumable(files)(block)
    (path,) = tmp_path.iterdir()
    path.write_bytes(path.read_bytes()[:1000])
    assert _same(Resumable(files)(block).state, first.state)
    assert "cannot be read" in caplog.text


def test_digests_tell_data_apart() -> None:
    block: Block = rig_block(4).block
    same = replace(block, points=block.points.copy())
    assert digest_of(block) == digest_of(same)
    same.points[7, 1] = np.nextafter(same.points[7, 1], 1e9)
    assert digest_of(block) != digest_of(same)
    assert digest_of([1], [2]) != digest_of([1, 2])
    assert digest_of(np.zeros((2, 3))) != digest_of(np.zeros((3, 2)))
    with pytest.raises(TypeError, match="object has no digest"):
        digest_of(object())


def test_an_interrupted_problem_file_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, output = tmp_path / "p.txt", tmp_path / "out"
    write_bal(_moved(bal_problem()), path)
    expected = run_bal(path, None)
    assert expected.iterations > 4
    seen: list[str] = []
    with monkeypatch.context() as patched:
        written = SolveFiles.write

        def write(self: SolveFiles, key: str, reached: Reached) -> None:
            written(self, key, reached)
            if reached.solution.iterations == 2:
                raise _Killed

        patched.setattr(SolveFiles, "write", write)
        with pytest.raises(_Killed):
            run_bal(path, output)
    done = run_bal(path, output, seen.append)
    assert seen[0].startswith("iteration 3:")
    assert done.iterations == expected.iterations
    assert done.cost == pytest.approx(expected.cost, rel=1e-9)
    assert [file.name for file in output.iterdir()] == ["p.txt"]


def _moved(problem: BalProblem) -> BalProblem:
    """With points that are off, so that there is something to do."""
    return replace(problem, points=problem.points + np.random.default_rng(1).normal(size=problem.points.shape) * 0.2)
