"""`georef evaluate PROJECT --leave-one-out`: reference images localized against the others, and what their errors say.

No truth is needed: the given pose of an image is what its localization is compared with, and both have a covariance.
What is common to the whole reference (a shift, a turn) moves both alike and does not show.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from georef import __version__
from georef.comparison.run import Say, Source
from georef.evaluation.pose_errors import PoseErrors, summarize_errors
from georef.evaluation.reliability import Reliability, median_nees_ratio, reliability
from georef.evaluation.statistics import wilson_interval
from georef.evaluation.tables import Cell, Column, Estimate, Table
from georef.executor import Executor
from georef.io.files import write_text_atomically
from georef.pipeline import LOCALIZE_KEYS, STAGES, Stage, reference_with_images, run_pipeline
from georef.project import Project
from georef.report.reliability_figure import Panel, reliability_figure
from georef.stages import leave_one_out
from georef.stages.base import StageContext
from georef.stages.leave_one_out import Choice
from georef.stages.network import COMMON, read_noise
from georef.types.campaign import Image
from georef.types.results import Localized, ReferenceNoise, Rejected

FOLDER = leave_one_out.NAME
JSON, CSV, SVG = "leave-one-out.json", "leave-one-out.csv", "reliability.svg"
_COLUMNS = (
    Column("name", ""),
    Column("images", "images"),
    Column("localized", "localized", "%", 0, interval=True),
    Column("median_position", "median position", "m", 1, 1e3, "mm", interval=True),
    Column("predicted_position", "median predicted position sigma", "m", 1, 1e3, "mm"),
    Column("median_rotation", "median rotation", "deg", 4, interval=True),
    Column("predicted_rotation", "median predicted rotation sigma", "deg", 4),
    Column("within_0.025m_0.25deg", "0.025 m, 0.25\N{DEGREE SIGN}", "%", 0, interval=True),
    Column("nees_per_dof", "NEES / 6", "", 2, interval=True),
    Column("nees_position_per_dof", "NEES / 3, position", "", 2),
    Column("nees_rotation_per_dof", "NEES / 3, rotation", "", 2),
    Column("nees_median", "median NEES / 5.35", "", 2),
)
_CAPTION = (
    "Each reference image localized against the others, without the images of its own station, and compared with its "
    "given pose. Errors and sigmas are those of the difference: of the localization and of the given pose. NEES per "
    "degree of freedom is 1 where the covariances are true; then its mean lies in the interval below it (95 %, images "
    "taken for independent)."
)


@dataclass(frozen=True, eq=False)
class LeaveOneOut:
    """The chosen reference images after their localization against the others."""

    project: Project
    choice: Choice
    noise: ReferenceNoise
    suspects: tuple[str, ...]  # which contradict the others: neither localized nor part of the map
    images: tuple[Image, ...]
    results: tuple[Reliability, ...]
    rejected: tuple[Rejected, ...]

    @property
    def table(self) -> Table:
        """All images; then by reference epoch and by camera, where there are several."""
        rows = [_row("all", self.results)]
        for name in ("epoch", "camera"):
            groups = self._groups(name)
            rows += [_row(key, part) for key, part in groups.items()] if len(groups) > 1 else []
        notes = [f"{r.image_id}: {r.reason.value}, {r.detail}" for r in self.rejected]
        if self.suspects:
            notes.append(f"Left out, their poses contradict the others: {', '.join(self.suspects)}.")
        return Table(FOLDER, "Reference images left out one by one", _COLUMNS, tuple(rows), _CAPTION, tuple(notes))

    def _groups(self, kind: str) -> dict[str, list[Reliability]]:
        out: dict[str, list[Reliability]] = {}
        for image, result in zip(self.images, self.results, strict=True):
            name = image.epoch if kind == "epoch" else f"camera {image.camera.camera_id}"
            out.setdefault(name, []).append(result)
        return out

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON, free of NaN and infinity."""
        noise = self.noise
        return {
            "project": self.project.file.name,
            "georef_version": __version__,
            "references": self.choice.references,
            "reference_sigma": {
                "source": noise.source,
                "position_m": list(noise.position_sigma_m),
                "rotation_deg": np.rad2deg(noise.rotation_sigma_rad).tolist(),
            },
            "not_observable": COMMON,
            "table": self.table.to_dict(),
            "errors": _errors(self.results).to_dict(),
            "images": [result.to_dict() for result in self.results],
            "rejected": {r.image_id: f"{r.reason.value}: {r.detail}" for r in self.rejected},
        }


def stages_of(choice: Choice) -> tuple[Stage, ...]:
    """What localizes chosen reference images against the others, and the stages that it needs."""
    needed = tuple(stage for stage in STAGES if stage.name in ("features", "network", "index", "tracks"))
    run, exist = partial(leave_one_out.run, choice), partial(leave_one_out.outcomes_exist, choice)
    reads, needs = reference_with_images, ("network", "index", "tracks")
    last = Stage(FOLDER, 1, LOCALIZE_KEYS, reads, needs, run, of_reference=True, results_exist=exist)
    return *needed, last


def leave_out(source: Source, choice: Choice, *, executor: Executor, say: Say) -> LeaveOneOut:
    """Localizes the chosen reference images against the others; finished ones are kept. Raises GeorefError."""
    project, epoch = source.open()
    choice.check(list(project.file.reference_epochs), project.config)
    context = None
    for result in run_pipeline(project, epoch, executor, stages=stages_of(choice)):
        kept = "kept" if result.reused else f"{result.timing['cpu_s']:.0f} CPU-s"
        say(f"  {result.stage:<13} {result.summary.line}  [{kept}]")
        context = result.context
    assert context is not None
    return of_context(choice, context)


def of_context(choice: Choice, context: StageContext) -> LeaveOneOut:
    """What a finished stage `leave-one-out` has found."""
    noise, suspects = read_noise(context.before["network"])
    compared = leave_one_out.read_compared(choice, context)
    results = []
    for c in compared:
        outcome = c.outcome
        found = (outcome.world_from_cam, outcome.world_from_cam_cov) if isinstance(outcome, Localized) else None
        results.append(reliability(outcome.image_id, found, c.given.world_from_cam, c.given.cov))
    rejected = tuple(c.outcome for c in compared if isinstance(c.outcome, Rejected))
    images = tuple(c.image for c in compared)
    return LeaveOneOut(context.project, choice, noise, suspects, images, tuple(results), rejected)


def write_leave_one_out(found: LeaveOneOut) -> list[Path]:
    """Writes the JSON, the table and the picture; returns their paths."""
    folder = found.project.evaluation(FOLDER)
    folder.mkdir(parents=True, exist_ok=True)
    texts = {
        JSON: json.dumps(found.to_dict(), indent=1, allow_nan=False),
        CSV: found.table.csv(),
        SVG: reliability_figure(panels(found.results)),
    }
    for name, text in texts.items():
        write_text_atomically(text, folder / name)
    return [folder / name for name in texts]


def panels(results: Sequence[Reliability]) -> list[Panel]:
    """Position in millimetres and rotation in degrees, of the images that have a pose."""
    known = [r for r in results if r.position_sigma_m is not None and r.rotation_sigma_rad is not None]
    names = [r.error.image_id for r in known]
    position = [1e3 * (r.position_sigma_m or 0.0) for r in known], [1e3 * r.error.position_m for r in known]
    turned = [r.error.rotation_rad for r in known]
    rotation = np.rad2deg([r.rotation_sigma_rad or 0.0 for r in known]).tolist(), np.rad2deg(turned).tolist()
    return [Panel("Position", "mm", names, *position), Panel("Rotation", "deg", names, *rotation)]


def _errors(results: Sequence[Reliability]) -> PoseErrors:
    return summarize_errors(tuple(result.error for result in results))


def _row(name: str, results: Sequence[Reliability]) -> dict[str, Cell]:
    errors = _errors(results)
    count, localized = len(results), len(results) - len(errors.failed)
    within = next(r for r in errors.recall if (r.position_m, r.rotation_deg) == (0.025, 0.25))
    sigmas = [r.position_sigma_m for r in results if r.position_sigma_m is not None]
    turns = [r.rotation_sigma_rad for r in results if r.rotation_sigma_rad is not None]
    return {
        "name": name,
        "images": count,
        "localized": Estimate(100.0 * localized / count if count else None, wilson_interval(localized, count)),
        "median_position": Estimate(errors.position_m.median, errors.position_m.median_interval),
        "predicted_position": float(np.median(sigmas)) if sigmas else None,
        "median_rotation": Estimate(errors.rotation_deg.median, errors.rotation_deg.median_interval),
        "predicted_rotation": float(np.rad2deg(np.median(turns))) if turns else None,
        "within_0.025m_0.25deg": Estimate(within.percent, within.interval),
        "nees_per_dof": Estimate(errors.nees.mean_ratio, errors.nees.interval),
        "nees_position_per_dof": errors.nees_position.mean_ratio,
        "nees_rotation_per_dof": errors.nees_rotation.mean_ratio,
        "nees_median": median_nees_ratio([result.error for result in results]),
    }
