"""The command line: verbs, progress, exit codes. Heavy imports stand inside the verbs.

Exit codes: 0 done, 1 our error (message only), 2 usage, 3 finished but a quality gate failed.
"""

from __future__ import annotations

import logging
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import App, Parameter

from georef import __version__
from georef.errors import GeorefError

if TYPE_CHECKING:
    from georef.executor import Executor
    from georef.project import Project

app = App(name="georef", version=__version__, help="Georeference new images against mapped reference images.")

ProjectArgument = Annotated[Path, Parameter(help="Project folder, or its project.toml.")]
Data = Annotated[Path | None, Parameter(name="--data", help="Folder with the data; else GEOREF_DATA.")]
Output = Annotated[Path | None, Parameter(name=["--output", "-o"], help="Where all results go; else the project.")]
Epoch = Annotated[str | None, Parameter(help="Epoch to work on; needed where the project has several.")]
Preset = Annotated[str | None, Parameter(help="A preset of configs/, or the path of a TOML file.")]
Settings = Annotated[
    tuple[str, ...], Parameter(name="--set", help="section.key=value, may be repeated.", consume_multiple=False)
]


@app.command
def run(
    project: ProjectArgument,
    *,
    data: Data = None,
    output: Output = None,
    epoch: Epoch = None,
    preset: Preset = None,
    set_: Settings = (),
) -> int:
    """Localize, adjust and report one epoch; what is done already is kept."""
    from georef.pipeline import run_pipeline

    opened, name = _open(project, data, output, epoch, preset, set_)
    report = None
    for result in run_pipeline(opened, name, _executor(opened)):
        cost = (
            "kept" if result.reused else f"{result.timing['cpu_s']:.0f} CPU-s, {result.timing['peak_memory_mb']:.0f} MB"
        )
        _say(f"{result.stage:<9} {result.summary.line}  [{cost}]")
        report = result.summary.data
    _say(f"results   {opened.published(name)}")
    return 3 if report is not None and report["images"]["localized"] == 0 else 0


@app.command
def status(
    project: ProjectArgument,
    *,
    data: Data = None,
    output: Output = None,
    epoch: Epoch = None,
    preset: Preset = None,
    set_: Settings = (),
) -> int:
    """What is done, partial or stale, and why."""
    from georef.pipeline import status as stage_states

    opened, name = _open(project, data, output, epoch, preset, set_)
    for state in stage_states(opened, name):
        _say(f"{state.stage:<9} {state.state:<8} {state.why}".rstrip())
    return 0


def _open(
    project: Path,
    data: Path | None,
    output: Path | None,
    epoch: str | None,
    preset: str | None,
    settings: tuple[str, ...],
) -> tuple[Project, str]:
    from georef.project import open_project

    opened = open_project(project, data=data, output=output, preset=preset, settings=settings)
    return opened, opened.select_epoch(epoch)


def _executor(project: Project) -> Executor:
    from georef.executor import Executor

    return Executor(project.config.run.workers, project.config.run.threads, _progress())


def _progress():
    """A bar on a terminal; a line every half minute where output is a file."""
    from georef.progress import Bars, Lines

    return Bars() if sys.stderr.isatty() else Lines()


def _say(text: str) -> None:
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def main() -> None:
    """The entry point of the command `georef`."""
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s: %(message)s")
    try:
        code = app(sys.argv[1:], result_action="return_value", exit_on_error=False)
    except GeorefError as error:
        sys.stderr.write(f"{type(error).__name__}: {error}\n")
        code = 1
    except KeyboardInterrupt:
        sys.stderr.write("Interrupted; run the same command again to go on.\n")
        code = 130
    sys.exit(code if isinstance(code, int) else 0)
