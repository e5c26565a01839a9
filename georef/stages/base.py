"""What a stage is given and what it leaves behind."""

from __future__ import annotations

import os
import resource
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from georef.config import Config
from georef.executor import Executor
from georef.project import Project
from georef.stages.survey import Survey
from georef.store.feature_store import FeatureStore
from georef.types.campaign import Image


@dataclass(frozen=True, eq=False)
class StageContext:
    """A stage's inputs: the survey, the configuration, its own folder and those of the stages before it."""

    project: Project
    config: Config
    epoch: str
    survey: Survey
    executor: Executor
    folder: Path
    before: Mapping[str, Path]


@dataclass(frozen=True)
class StageSummary:
    """One line for the terminal, and the data for the report."""

    line: str
    data: dict[str, Any] = field(default_factory=dict)
    computed: int = 0
    total: int = 0


Run = Callable[[StageContext], StageSummary]


def feature_id(image: Image, quarter_turns: int = 0) -> str:
    """The key of an image in the feature store, which holds all epochs; or of its picture turned clockwise."""
    turned = f"?quarter_turns={quarter_turns}" if quarter_turns else ""
    return f"{image.epoch}/{image.image_id}{turned}"


def open_features(folder: Path) -> FeatureStore:
    return FeatureStore(folder)


class Meter:
    """CPU seconds of this process and its children, wall seconds, and peak memory, since it was made."""

    def __init__(self) -> None:
        _reset_peak()
        self._cpu, self._wall = _cpu_s(), time.monotonic()

    def read(self) -> dict[str, float]:
        return {
            "cpu_s": round(_cpu_s() - self._cpu, 2),
            "wall_s": round(time.monotonic() - self._wall, 2),
            "peak_memory_mb": round(_peak_mb(), 1),
        }


def _cpu_s() -> float:
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system


def _reset_peak() -> None:
    """Lets Linux count the peak of this process anew; elsewhere the peak since its start is reported."""
    try:
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
    except OSError:
        return


def _peak_mb() -> float:
    """Peak resident memory of this process or, if larger, of one worker."""
    children = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024.0
    try:
        status = Path("/proc/self/status").read_text(encoding="ascii")
        own = next(int(line.split()[1]) / 1024.0 for line in status.splitlines() if line.startswith("VmHWM"))
    except (OSError, StopIteration):
        own = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
    return max(own, children)
