"""A project on its data with its results somewhere else, and what the tests of stages ask of it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from georef.executor import Executor
from georef.pipeline import StageResult, StageState, run_pipeline, status
from georef.project import Project, open_project
from tests.worlds.tiny import EPOCH


@dataclass(frozen=True)
class Bench:
    """A project on its data, with its results somewhere else."""

    data: Path
    output: Path

    def open(self, *settings: str) -> Project:
        return open_project(self.data, output=self.output, settings=settings)

    def run(self, *settings: str, executor: Executor | None = None) -> dict[str, StageResult]:
        results = run_pipeline(self.open(*settings), EPOCH, executor or Executor())
        return {result.stage: result for result in results}

    def states(self, *settings: str) -> dict[str, StageState]:
        return {state.stage: state for state in status(self.open(*settings), EPOCH)}

    def published(self, name: str) -> bytes:
        return (self.open().published(EPOCH) / name).read_bytes()

    def files(self) -> dict[str, int]:
        """Time of change of each file of the results."""
        return {str(p.relative_to(self.output)): p.stat().st_mtime_ns for p in self.output.rglob("*") if p.is_file()}
