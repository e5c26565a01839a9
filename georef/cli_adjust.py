"""The verb `adjust`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from georef.cli_options import ANYWHERE, AS_DECLARED, Choice, Epoch, Place, executor_of
from georef.terminal import say

if TYPE_CHECKING:
    from georef.project import Project

Adjusted = Annotated[
    Path, Parameter(help="Project folder, its project.toml, or a problem file of Bundle Adjustment in the Large.")
]


def adjust(project: Adjusted, *, place: Place = ANYWHERE, epoch: Epoch = None, choice: Choice = AS_DECLARED) -> int:
    """Adjust the measurements of a block without images, with check points, splits and offsets as the project asks.

    Of an epoch with images, run all up to its adjustment; of a problem file (.txt, .gz, .bz2), lower its cost.
    """
    if project.is_file() and project.suffix != ".toml":
        return _adjust_problem(project, place.output)
    opened = place.open(project, choice.preset, choice.set_)
    if opened.file.blocks and (epoch is None or epoch in opened.file.blocks):
        return _adjust_block(opened, opened.select_block(epoch))
    return _adjust_epoch(opened, opened.select_epoch(epoch))


def _adjust_problem(path: Path, output: Path | None) -> int:
    from georef.stages.bal import run_bal

    done = run_bal(path, output)
    say(*done.lines, *(() if done.written is None else (f"written     {done.written}",)))
    return 0 if done.converged else 3


def _adjust_block(project: Project, name: str) -> int:
    """3 where a solution did not converge."""
    from georef.stages.block import run

    done = run(project, name, lambda step: say(f"... {step}"))
    say("", *done.lines, "", *(f"written     {path}" for path in done.files))
    return 0 if all(variant["converged"] for variant in done.report["variants"].values()) else 3


def _adjust_epoch(project: Project, epoch: str) -> int:
    from georef.pipeline import run_pipeline

    for result in run_pipeline(project, epoch, executor_of(project), last="adjust"):
        say(f"{result.stage:<9} {result.summary.line}")
    return 0
