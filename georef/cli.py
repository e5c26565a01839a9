"""The command line: verbs, progress, exit codes. Heavy imports stand inside the verbs.

Exit codes: 0 done, 1 our error (message only), 2 usage, 3 finished but a quality gate failed.
"""

from __future__ import annotations

import json
import logging
import sys
import time
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import App, Parameter

from georef import __version__
from georef.cli_adjust import adjust
from georef.cli_benchmark import benchmark
from georef.cli_evaluate import evaluate
from georef.cli_options import (
    ANYWHERE,
    AS_DECLARED,
    REPEATED,
    Choice,
    Crs,
    Epoch,
    Height,
    OptionalProject,
    Place,
    ProjectArgument,
    executor_of,
)
from georef.cli_weights import weights
from georef.terminal import exit_code, say

if TYPE_CHECKING:
    from georef.doctor import Finding
    from georef.project import Project

app = App(
    name="georef",
    version=__version__,
    help="Georeference new images against mapped reference images.",
    help_format="plaintext",
    suppress_keyboard_interrupt=False,
)
app.command(weights)
app.command(benchmark)
app.command(evaluate)
app.command(adjust)


@app.command
def init(
    folder: Annotated[Path, Parameter(help="Folder of the new project; it may be that of the data.")],
    *,
    data: Annotated[Path, Parameter(name="--data", help="Folder with reference_eo.csv, reference/, camera.csv, ...")],
    crs: Crs = None,
    height: Height = None,
    angles: Annotated[
        Literal["omega-phi-kappa", "yaw-pitch-roll"] | None, Parameter(help="Convention of the reference's angles.")
    ] = None,
    angle_unit: Annotated[Literal["deg", "gon", "rad"] | None, Parameter(help="Their unit.")] = None,
    check_kind: Annotated[
        Literal["absolute", "relative"] | None, Parameter(help="Check points: surveyed, or from the reference.")
    ] = None,
    column: Annotated[
        tuple[str, ...], Parameter(help="easting=X: which column is which; may be repeated.", **REPEATED)
    ] = (),
    name: Annotated[str | None, Parameter(help="Name of the project; else that of the folder of the data.")] = None,
) -> int:
    """Write project.toml for a folder of data with the usual file names."""
    from georef.stages.init_project import Answers, init_project, parse_columns

    answers = Answers(crs, height, angles, angle_unit, check_kind, name, parse_columns(column))
    written = init_project(folder, data, answers)
    say(*written.said, f"written    {written.path}", f"next       georef doctor {folder} --data {data}")
    return 0


@app.command
def doctor(
    project: OptionalProject = None,
    *,
    place: Place = ANYWHERE,
    choice: Choice = AS_DECLARED,
) -> int:
    """Check this machine and, if one is named, a project with all its tables."""
    from georef.doctor import check_machine, check_project, check_space

    levels = _report_findings(check_machine())
    if project is None:
        levels |= _report_findings([check_space(Path.cwd())])
        return int("fail" in levels)
    levels |= _report_findings(check_project(place.open(project, choice.preset, choice.set_)))
    return int("fail" in levels)


@app.command
def run(
    project: ProjectArgument,
    *,
    place: Place = ANYWHERE,
    epoch: Epoch = None,
    choice: Choice = AS_DECLARED,
) -> int:
    """Localize, adjust and report one epoch; what is done already is kept."""
    opened = place.open(project, choice.preset, choice.set_)
    return _run(opened, opened.select_epoch(epoch))


@app.command
def demo(
    *,
    output: Annotated[Path, Parameter(name=["--output", "-o"], help="Where all results go.")] = Path("georef-demo"),
    large: Annotated[bool, Parameter(help="All cameras of both vehicles, and pedestrians.", negative="")] = False,
    evaluation: Annotated[
        bool, Parameter(help="Two reference epochs, and new images of many kinds of cameras.", negative="")
    ] = False,
    seed: Annotated[int, Parameter(help="Of the street and all its errors.")] = 0,
    change: Annotated[float, Parameter(help="0 to 1: how much changes between the epochs.")] = 1.0,
    choice: Choice = AS_DECLARED,
) -> int:
    """Render a street in two epochs, localize the second against the first, and compare with the exact truth."""
    from georef.stages.demo import against_truth, demo_options, render_missing, survey_files

    options = demo_options(seed, change, large=large, evaluation=evaluation)
    folder = survey_files(options)
    project = Place(folder, output).open(folder, choice.preset, choice.set_)
    start = time.process_time()
    street = render_missing(options, folder, executor_of(project))
    cost = f"{street.computed} rendered, {time.process_time() - start:.0f} CPU-s" if street.computed else "kept"
    say(f"{'render':<9} {street.line}  [{cost}]")
    code = 0
    for name in project.file.epochs:
        code = max(code, _run(project, name))
        say("exact truth, where the reference would have it:", *against_truth(project, name))
    say(f"project           {folder}")
    return code


@app.command
def status(
    project: ProjectArgument,
    *,
    place: Place = ANYWHERE,
    epoch: Epoch = None,
    choice: Choice = AS_DECLARED,
) -> int:
    """What is done, partial or stale, and why."""
    from georef.pipeline import DONE
    from georef.pipeline import status as stage_states

    opened = place.open(project, choice.preset, choice.set_)
    for block in opened.file.blocks if epoch is None else ():
        from georef.stages.block_state import block_state

        state, why = block_state(opened, block)
        say(f"project {opened.file.name}, block {block}, results in {opened.output}", f"{state:<8} {why}")
    if not opened.file.epochs:
        return 0
    name = opened.select_epoch(epoch)
    say(f"project {opened.file.name}, epoch {name}, results in {opened.output}", "")
    say(f"{'stage':<9} {'state':<8} why or what", f"{'-' * 9} {'-' * 8} {'-' * 40}")
    for state in stage_states(opened, name):
        say(f"{state.stage:<9} {state.state:<8} {state.why or _line_of(state.folder / DONE)}".rstrip())
    return 0


@app.command
def report(
    project: ProjectArgument,
    *,
    place: Place = ANYWHERE,
    epoch: Epoch = None,
) -> int:
    """Render report.html again from report.json, and say where everything is."""
    from georef.stages.published import render_again

    opened = place.open(project)
    name = opened.select_epoch(epoch)
    render_again(opened.published(name))
    _say_published(opened, name)
    return 0


@app.command
def view(
    project: ProjectArgument,
    *,
    place: Place = ANYWHERE,
    epoch: Epoch = None,
    port: Annotated[int, Parameter(help="Port on 127.0.0.1 that the viewer listens on.")] = 9876,
) -> int:
    """Open the recording of an epoch in the rerun viewer."""
    from georef.stages.report import RECORDING
    from georef.viewer.show import show_recording

    opened = place.open(project)
    show_recording(opened.published(opened.select_epoch(epoch)) / RECORDING, port)
    return 0


def _run(project: Project, epoch: str) -> int:
    """Runs all stages, a line for each; 3 where no image was localized, or which poses are wrong cannot be decided."""
    from georef.pipeline import run_pipeline

    report = None
    for result in run_pipeline(project, epoch, executor_of(project)):
        cost = (
            "kept" if result.reused else f"{result.timing['cpu_s']:.0f} CPU-s, {result.timing['peak_memory_mb']:.0f} MB"
        )
        say(f"{result.stage:<9} {result.summary.line}  [{cost}]")
        report = result.summary.data
    _say_published(project, epoch)
    return 3 if report is not None and (report["images"]["localized"] == 0 or report["undecidable"]) else 0


def _report_findings(findings: Iterable[Finding]) -> set[str]:
    levels = set()
    for finding in findings:
        say(f"{finding.level:<8} {finding.text}")
        if finding.remedy:
            say("         " + finding.remedy.replace("\n", "\n         "))
        levels.add(finding.level)
    return levels


def _line_of(done: Path) -> str:
    """What a finished stage said of its result."""
    return json.loads(done.read_text(encoding="utf-8"))["line"] if done.is_file() else ""


def _say_published(project: Project, epoch: str) -> None:
    from georef.stages.published import published_files

    for path, what in published_files(project.published(epoch)):
        say(f"{path.name:<17} {what:<27} {path}")


def main() -> None:
    """The entry point of the command `georef`."""
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s: %(message)s")
    sys.exit(exit_code(app, sys.argv[1:]))
