"""Stage order, fingerprints, run, resume and status.

A stage's fingerprint hashes its version, its sections of the configuration, what it reads, and the fingerprints of the
stages before it. Same fingerprint: done work is kept. Different: a new folder; nothing is overwritten.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from georef.config import Config
from georef.executor import Executor
from georef.io.files import write_text_atomically
from georef.project import Project
from georef.stages import (
    adjust,
    adjusted_epoch,
    features,
    global_map,
    index,
    leave_one_out,
    localize,
    network,
    report,
    stations,
    tracks,
)
from georef.stages.base import Meter, Run, StageContext, StageSummary
from georef.stages.fingerprints import (
    all_images,
    check,
    control_and_mountings,
    digest_of,
    epoch_files,
    mountings,
    reference_with_images,
    setting,
)
from georef.stages.survey import Survey, load_survey

DONE = "stage.json"
BEGUN = "fingerprint.json"


@dataclass(frozen=True)
class Stage:
    """A step of the common route."""

    name: str
    version: int  # raise it when the same inputs give other results
    sections: tuple[str, ...]  # of the configuration, or section.key
    reads: Callable[[Project, Survey], dict[str, Any]]
    needs: tuple[str, ...]  # stages before it, where they are wanted
    run: Run
    wanted: Callable[[Config], bool] = lambda config: True
    applies: Callable[[Config, Survey], bool] = lambda config, survey: True  # to what the epoch holds
    of_reference: bool = False  # looks at the reference alone: done once for all epochs
    results_exist: Callable[[StageContext], bool] | None = None  # where it is not known of the stage's name


_GUIDED_KEYS = ("localize.guided_gate", "localize.guided_min_similarity", "localize.guided_ratio")
_NETWORK_KEYS = (
    "network",
    *_GUIDED_KEYS,
    "adjust.cauchy_scale",
    "adjust.gate_probability",
    "adjust.max_iterations",
)

_MAP_KEYS = ("matching", "global_map", "candidates.epochs")
_TRACKS_KEYS = ("tracks", *_GUIDED_KEYS, "candidates.epochs")
LOCALIZE_KEYS = ("matching", "candidates", "localize")
_BEFORE_LOCALIZE = ("features", "network", "index", "global-map", "tracks")
_STATION_KEYS = ("stations", "localize", "candidates.epochs")
_BEFORE_STATIONS = ("features", "network", "localize")
_BEFORE_ADJUST = (*_BEFORE_STATIONS, "stations")


def _uses_index(config: Config) -> bool:
    return config.candidates.ranking != "votes"


def _uses_map(config: Config) -> bool:
    return config.localize.method == "global-model"


def _uses_tracks(config: Config) -> bool:
    return config.localize.method == "tracks"


STAGES: tuple[Stage, ...] = (
    Stage("features", 2, ("features",), all_images, (), features.run),
    Stage("network", 5, _NETWORK_KEYS, reference_with_images, (), network.run, of_reference=True),
    Stage("index", 1, ("retrieval",), reference_with_images, (), index.run, _uses_index, of_reference=True),
    Stage(
        "global-map", 2, _MAP_KEYS, reference_with_images, ("network",), global_map.run, _uses_map, of_reference=True
    ),
    Stage("tracks", 1, _TRACKS_KEYS, reference_with_images, ("network",), tracks.run, _uses_tracks, of_reference=True),
    Stage("localize", 6, LOCALIZE_KEYS, epoch_files, _BEFORE_LOCALIZE, localize.run),
    Stage("stations", 1, _STATION_KEYS, mountings, _BEFORE_STATIONS, stations.run, applies=stations.wanted),
    Stage("adjust", 9, ("adjust", "localize", "matching"), control_and_mountings, _BEFORE_ADJUST, adjust.run),
    Stage("report", 3, ("report",), check, (*_BEFORE_ADJUST, "adjust"), report.run),
)


@dataclass(frozen=True)
class StageState:
    """What is known of a stage without running it."""

    stage: str
    state: str  # "done", "partial", "stale" or "new"
    why: str
    folder: Path


@dataclass(frozen=True)
class StageResult:
    """What running a stage gave: `reused` when all of it was there."""

    stage: str
    summary: StageSummary
    timing: dict[str, float]
    reused: bool
    context: StageContext


def run_pipeline(
    project: Project, epoch: str, executor: Executor, last: str = "report", stages: Sequence[Stage] = STAGES
) -> Iterator[StageResult]:
    """Runs what is not done, stage by stage up to the one named `last`. Raises GeorefError."""
    survey = load_survey(project, epoch)
    plan = list(_plan(project, epoch, survey, stages))  # as a whole: what cannot be made fails before any work
    for stage, folder, parts, before in plan:
        yield _run_stage(stage, StageContext(project, project.config, epoch, survey, executor, folder, before), parts)
        if stage.name == last:
            return


def status(project: Project, epoch: str) -> list[StageState]:
    """The state of every stage: done, partial, stale (and why), or new."""
    survey = load_survey(project, epoch)
    return [
        _state_of(project, epoch, stage, folder, parts) for stage, folder, parts, _ in _plan(project, epoch, survey)
    ]


def _plan(
    project: Project, epoch: str, survey: Survey, stages: Sequence[Stage] = STAGES
) -> Iterator[tuple[Stage, Path, dict[str, Any], dict[str, Path]]]:
    """Each stage with its folder, the parts of its fingerprint, and the folders of the stages before it."""
    prints: dict[str, str] = {}
    version = features.extractor_version(project.config.features)
    before = {"store": project.feature_folder / digest_of(version)[:12]}
    for stage in (s for s in stages if s.wanted(project.config) and s.applies(project.config, survey)):
        parts = {
            "stage version": stage.version,
            "components": _components(stage, project.config),
            **{f"[{name}]": setting(project.config, name) for name in stage.sections},
            **stage.reads(project, survey),
            **{f"stage {name}": prints[name] for name in stage.needs if name in prints},
        }
        prints[stage.name] = digest_of(parts)[:12]
        folder = project.stage_folder(_scope(stage, epoch), stage.name, prints[stage.name])
        yield stage, folder, parts, dict(before)
        before[stage.name] = folder


def _scope(stage: Stage, epoch: str) -> str:
    """The folder of an epoch's own stages, or that of stages of the reference: no epoch may have its name."""
    return "reference" if stage.of_reference else epoch


def _components(stage: Stage, config: Config) -> str:
    """What else than configuration and inputs decides the result: versions of the components that a stage uses."""
    if stage.name == "features":
        return features.extractor_version(config.features)
    if stage.name == "index":
        return index.descriptor_version(config)
    matching = ("localize", "global-map", leave_one_out.NAME)
    return localize.matcher_version(config) if stage.name in matching else ""


def _run_stage(stage: Stage, context: StageContext, parts: dict[str, Any]) -> StageResult:
    done = _read_json(context.folder / DONE)
    exist = stage.results_exist or partial(_results_exist, stage=stage.name)
    if done is not None and exist(context):
        summary = StageSummary(done["line"], done["data"], 0, done["total"])
        return StageResult(stage.name, summary, done["timing"], reused=True, context=context)
    context.folder.mkdir(parents=True, exist_ok=True)
    write_text_atomically(json.dumps(parts, indent=1), context.folder / BEGUN)
    meter = Meter()
    summary = stage.run(context)
    timing = meter.read()
    record = {
        "stage": stage.name,
        "line": summary.line,
        "data": summary.data,
        "computed": summary.computed,
        "total": summary.total,
        "timing": timing,
        "finished": time.strftime("%Y-%m-%dT%H:%M:%S%z"),
    }
    write_text_atomically(json.dumps(record, indent=1), context.folder / DONE)
    return StageResult(stage.name, summary, timing, reused=False, context=context)


def _results_exist(context: StageContext, stage: str) -> bool:
    """Whether what a finished stage left is still there: files may have been deleted since."""
    left = {
        "network": context.folder / network.RESULT,
        "index": context.folder / index.VECTORS,
        "global-map": context.folder / global_map.STRUCTURE,
        "tracks": context.folder / global_map.STRUCTURE,
        "adjust": context.folder / adjusted_epoch.RESULT,
    }
    checks = {"localize": localize.outcomes_exist, "stations": localize.outcomes_exist, "report": report.outputs_exist}
    return checks[stage](context) if stage in checks else stage not in left or left[stage].exists()


def _state_of(project: Project, epoch: str, stage: Stage, folder: Path, parts: dict[str, Any]) -> StageState:
    if (folder / DONE).is_file():
        return StageState(stage.name, "done", "", folder)
    if folder.is_dir():
        items = len(list((folder / localize.ITEMS).glob("*.npz"))) if (folder / localize.ITEMS).is_dir() else 0
        return StageState(
            stage.name, "partial", f"interrupted; {items} items are kept" if items else "interrupted", folder
        )
    older = [p for p in project.stage_history(_scope(stage, epoch), stage.name) if (p / BEGUN).is_file()]
    if not older:
        return StageState(stage.name, "new", "", folder)
    before = _read_json(older[-1] / BEGUN) or {}
    now = json.loads(json.dumps(parts))  # as it is stored: a tuple is a list there
    changed = [key for key in {**before, **now} if before.get(key) != now.get(key)]
    return StageState(stage.name, "stale", f"changed: {', '.join(changed)}", folder)


def _read_json(path: Path) -> dict[str, Any] | None:
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
