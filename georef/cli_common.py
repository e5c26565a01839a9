"""What the verbs of the command line share: their common options, and an executor that shows progress."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

if TYPE_CHECKING:
    from georef.executor import Executor
    from georef.project import Project

REPEATED: Any = {"consume_multiple": False, "negative": (), "show_default": False}
ProjectArgument = Annotated[Path, Parameter(help="Project folder, or its project.toml.")]
Data = Annotated[Path | None, Parameter(name="--data", help="Folder with the data; else GEOREF_DATA.")]
Output = Annotated[Path | None, Parameter(name=["--output", "-o"], help="Where all results go; else the project.")]
Epoch = Annotated[str | None, Parameter(help="Epoch to work on; needed where the project has several.")]
Preset = Annotated[str | None, Parameter(help="A preset of configs/, or the path of a TOML file.")]
Settings = Annotated[tuple[str, ...], Parameter(name="--set", help="section.key=value, may be repeated.", **REPEATED)]
Crs = Annotated[str | None, Parameter(name="--crs", help="EPSG:code or local; else what the files declare.")]
Height = Annotated[str | None, Parameter(help="ellipsoidal, or a vertical CRS; else what the files declare.")]


def local_executor(project: Project) -> Executor:
    from georef.executor import Executor

    return Executor(project.config.run.workers, project.config.run.threads, _progress())


def _progress():
    """A bar on a terminal; a line every half minute where output is a file."""
    from georef.progress import Bars, Lines

    return Bars() if sys.stderr.isatty() else Lines()
