"""Verb `demo`: a simulated street as an ordinary project, and its results against the exact truth."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from georef.cache import cache_folder
from georef.errors import ConfigError
from georef.executor import Executor
from georef.project import Project
from georef.simulate.evaluation import EvaluationOptions, EvaluationWorld, evaluation_options
from georef.simulate.evaluation_files import write_evaluation_images, write_evaluation_tables
from georef.simulate.evaluation_images import products
from georef.simulate.project_files import TRUTH, image_files, write_images, write_tables
from georef.simulate.world import StreetWorld, WorldOptions, large_options, small_options
from georef.stages.base import StageSummary
from georef.stages.evaluate import evaluate

_WITHIN_M = 0.025


def demo_options(seed: int, change: float, *, large: bool, evaluation: bool = False) -> WorldOptions:
    """The street of the demo: short with few cameras, long with all of them, or with two references for evaluations."""
    if large and evaluation:
        raise ConfigError("--large and --evaluation are two different streets.", "Choose one of them.")
    if not 0.0 <= change <= 1.0:
        raise ConfigError(f"--change {change:g} is not possible.", "Expected 0 (nothing changes) to 1.")
    if evaluation:
        return replace(evaluation_options(seed), change=change)
    return replace(large_options(seed) if large else small_options(seed), change=change)


def survey_files(options: WorldOptions) -> Path:
    """The folder in the cache where a street's tables are, and its images go."""
    folder = cache_folder("demo") / options.fingerprint
    if isinstance(options, EvaluationOptions):
        write_evaluation_tables(EvaluationWorld(options), folder)
    else:
        write_tables(StreetWorld(options), folder)
    return folder


def render_missing(options: WorldOptions, folder: Path, executor: Executor) -> StageSummary:
    """Renders the images that are not in the folder yet; an interrupted call is taken up where it ended."""
    if isinstance(options, EvaluationOptions):
        return _render_evaluation(options, folder, executor)
    world = StreetWorld(options)
    new = write_images(world, folder, executor)
    lenses = [world.images[name].lens for name in new]
    megapixels = sum(lens.width * lens.height for lens in lenses) / 1e6
    count = len(image_files(world))
    return StageSummary(f"{count} images of a street in two epochs, {megapixels:.0f} megapixels", {}, len(new), count)


def _render_evaluation(options: EvaluationOptions, folder: Path, executor: Executor) -> StageSummary:
    world = EvaluationWorld(options)
    new, everything = write_evaluation_images(world, folder, executor), products(world)
    epochs = len({product.epoch for product in everything})
    line = f"{len(everything)} images of a street in two states, {epochs} epochs"
    return StageSummary(line, {}, len(new), len(everything))


def against_truth(project: Project, epoch: str) -> list[str]:
    """How far the published poses are from the exact ones, in lines for a terminal.

    The exact poses are taken where the reference would have them: its own smooth error is common to all that is
    localized against it.
    """
    truth = project.data(TRUTH) / f"{epoch}_eo_relative.csv"
    lines = []
    for name, what in (("localization.csv", "each image alone"), ("poses.csv", "after the adjustment")):
        errors = evaluate(project.published(epoch) / name, truth).errors
        within = next(r for r in errors.recall if r.position_m == _WITHIN_M)
        line = f"{what:<20} median {1e3 * errors.position_m.median:.1f} mm, {errors.rotation_deg.median:.4f} deg; "
        line += f"{within.percent:.0f} % within {within.position_m:g} m and {within.rotation_deg:g} deg"
        if errors.nees.mean_ratio is not None:
            line += f"; NEES {errors.nees.mean_ratio:.2f}"
        lines.append(line)
    return lines
