"""Runs the variants of an evaluation through the ordinary pipeline, as far as localization or stations.

Nothing here reads the truth. Finished stages are kept, an interrupted evaluation goes on where it ended.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from georef.comparison.variants import AS_CONFIGURED, TableSection, Variant
from georef.config import Config
from georef.errors import ConfigError, StageError, WeightsError
from georef.executor import Executor
from georef.pipeline import DONE, STAGES, run_pipeline
from georef.project import Project, open_project
from georef.stages.base import StageContext
from georef.stages.localize import read_outcomes
from georef.stages.survey import load_survey
from georef.types.results import Outcome

LOCALIZE, STATIONS = "localize", "stations"
Say = Callable[[str], None]
logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Source:
    """The project to evaluate, as the command line names it."""

    where: Path
    data: Path | None = None
    output: Path | None = None
    epoch: str | None = None
    preset: str | None = None
    settings: tuple[str, ...] = ()

    def open(self, variant: Variant | None = None) -> tuple[Project, str]:
        """The project with a variant's settings on top of all others. Raises ConfigError."""
        preset, settings = (variant.preset, variant.settings) if variant else (None, ())
        project = open_project(
            self.where,
            data=self.data,
            output=self.output,
            preset=preset or self.preset,
            settings=(*self.settings, *settings),
        )
        return project, project.select_epoch(self.epoch)


@dataclass(frozen=True)
class StageCost:
    """What a stage took when it was computed; `computed` of its items were then, the others were there before."""

    stage: str
    run: str  # fingerprint: variants that share results of a stage have the same
    cpu_s: float
    wall_s: float
    peak_memory_mb: float
    computed: int


@dataclass(frozen=True, eq=False)
class VariantRun:
    """A variant after localization, or why it could not run."""

    variant: Variant
    config: Config | None = None
    outcomes: tuple[Outcome, ...] = ()  # of the last stage
    context: StageContext | None = None  # of the stage `localize`
    costs: tuple[StageCost, ...] = ()
    problem: str = ""


@dataclass
class Runs:
    """Runs variants, each configuration once, and remembers the results."""

    source: Source
    executor: Executor
    say: Say
    done: dict[str, VariantRun] = field(default_factory=dict)

    def run(self, variant: Variant, last: str = LOCALIZE) -> VariantRun:
        """The variant up to a stage. A component or weights that are missing are the result of their variant; what is
        wrong with the project itself is raised as GeorefError."""
        project, epoch = self.source.open(variant)
        said = [last, project.config.model_dump(), project.file.model_dump()]
        key = json.dumps(said, sort_keys=True, default=str)
        if key not in self.done:
            self.say(f"{variant.name}:")
            self.done[key] = self._run(variant, project, epoch, last)
        known = self.done[key]
        return VariantRun(variant, known.config, known.outcomes, known.context, known.costs, known.problem)

    def _run(self, variant: Variant, project: Project, epoch: str, last: str) -> VariantRun:
        costs, contexts = [], {}
        stages = STAGES[: [stage.name for stage in STAGES].index(last) + 1]
        try:
            for result in run_pipeline(project, epoch, self.executor, stages=stages):
                kept = "kept" if result.reused else f"{result.timing['cpu_s']:.0f} CPU-s"
                self.say(f"  {result.stage:<10} {result.summary.line}  [{kept}]")
                contexts[result.stage] = result.context
                costs.append(_cost(result.context.folder / DONE))
        except (ConfigError, StageError, WeightsError) as error:
            logger.warning("variant '%s' was not run: %s", variant.name, error)
            return VariantRun(variant, project.config, problem=str(error).splitlines()[0])
        context, final = contexts[LOCALIZE], contexts.get(STATIONS, contexts[LOCALIZE])
        outcomes = tuple(read_outcomes(final.folder, context.survey.epoch))
        return VariantRun(variant, project.config, outcomes, context, tuple(costs))


def variants_of(table: TableSection, source: Source) -> list[Variant]:
    """The variants of a table; for reference epochs each one alone and, where there are several, all together."""
    if table.rows != "reference-epochs":
        return list(table.variants)
    project, epoch = source.open()
    names = sorted({image.epoch for image in load_survey(project, epoch).reference.images})
    if len(names) < 2:
        return [base.model_copy(update={"name": _joined(names[0], base)}) for base in table.variants]
    rows: Sequence[tuple[str, list[str]]] = [*((name, [name]) for name in names), ("all", [])]
    return [
        base.model_copy(update={"name": _joined(row, base), "set": _with_epochs(base.set, chosen)})
        for base in table.variants
        for row, chosen in rows
    ]


def _joined(name: str, variant: Variant) -> str:
    return name if variant.name == AS_CONFIGURED else f"{variant.name}, {name}"


def _with_epochs(settings: dict[str, Any], epochs: list[str]) -> dict[str, Any]:
    candidates = settings.get("candidates", {})
    return {**settings, "candidates": {**candidates, "epochs": epochs}}


def _cost(path: Path) -> StageCost:
    record = json.loads(path.read_text(encoding="utf-8"))
    timing = {key: float(record["timing"][key]) for key in ("cpu_s", "wall_s", "peak_memory_mb")}
    return StageCost(record["stage"], path.parent.name, computed=int(record["computed"]), **timing)
