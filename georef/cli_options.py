"""Options that several verbs share, and how a project is opened with them."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

if TYPE_CHECKING:
    from georef.executor import Executor
    from georef.project import Project

REPEATED: Any = {"consume_multiple": False, "negative": (), "show_default": False}
ProjectArgument = Annotated[Path, Parameter(help="Project folder, or its project.toml.")]
OptionalProject = Annotated[Path | None, Parameter(help="Project folder, or its project.toml.")]
Data = Annotated[Path | None, Parameter(name="--data", help="Folder with the data; else GEOREF_DATA.")]
Output = Annotated[Path | None, Parameter(name=["--output", "-o"], help="Where all results go; else the project.")]
Epoch = Annotated[str | None, Parameter(help="Epoch to work on; needed where the project has several.")]
Preset = Annotated[str | None, Parameter(help="A preset of configs/, or the path of a TOML file.")]
Settings = Annotated[tuple[str, ...], Parameter(name="--set", help="section.key=value, may be repeated.", **REPEATED)]
Crs = Annotated[str | None, Parameter(name="--crs", help="EPSG:code or local; else what the files declare.")]
Height = Annotated[str | None, Parameter(help="ellipsoidal, or a vertical CRS; else what the files declare.")]


@Parameter(name="*")
@dataclass(frozen=True)
class Place:
    """Where a project's data and results are."""

    data: Data = None
    output: Output = None

    def open(self, project: Path, preset: str | None = None, settings: tuple[str, ...] = ()) -> Project:
        """The project, validated. Raises ConfigError."""
        from georef.project import open_project

        return open_project(project, data=self.data, output=self.output, preset=preset, settings=settings)


@Parameter(name="*")
@dataclass(frozen=True)
class Choice:
    """Which configuration."""

    preset: Preset = None
    set_: Settings = ()


ANYWHERE, AS_DECLARED = Place(), Choice()


def executor_of(project: Project) -> Executor:
    """Workers and threads as configured; a bar on a terminal, a line every half minute where output is a file."""
    from georef.executor import Executor
    from georef.progress import Bars, Lines

    return Executor(project.config.run.workers, project.config.run.threads, Bars() if sys.stderr.isatty() else Lines())
