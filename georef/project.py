"""A project on disk: `project.toml`, its data root, and where results go. The only module that knows folder names."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from pydantic import Field, field_validator, model_validator

from georef.config import Config, Section, load_config, merge, parse_overrides, read_toml, validated
from georef.epoch_sections import EpochSection, PanoramaSection, refuse_cameras_of_panoramas
from georef.errors import ConfigError
from georef.sections import AngleConvention, AngleUnit, BlockSection, CrsSection, TableSection

PROJECT_FILE = "project.toml"
REFERENCE = "reference"  # the name of the only reference epoch of a project
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]*")


class ReferenceSigma(Section):
    position_m: tuple[float, float, float]
    rotation_deg: tuple[float, float, float]

    @field_validator("position_m", "rotation_deg")
    @classmethod
    def _positive(cls, value: tuple[float, float, float]) -> tuple[float, float, float]:
        if min(value) <= 0:
            raise ValueError("each 1-sigma must be positive; a reference is never exact")
        return value


class ReferenceSection(Section):
    images: str
    cameras: str | None = None
    exterior_orientation: str
    angles: AngleConvention
    angle_unit: AngleUnit
    sigma: Literal["estimate"] | ReferenceSigma = "estimate"
    unmatched: Literal["refuse", "skip"] = "refuse"
    panorama: PanoramaSection | None = None
    table: TableSection = TableSection()

    @model_validator(mode="after")
    def _one_source_of_cameras(self) -> ReferenceSection:
        refuse_cameras_of_panoramas(self.cameras, self.panorama)
        return self


class PointsSection(Section):
    coordinates: str
    marks: dict[str, str] = Field(default_factory=dict)
    check_kind: Literal["absolute", "relative"]
    table: TableSection = TableSection()


class ProjectFile(Section):
    """The content of project.toml."""

    name: str = Field(min_length=1)
    crs: CrsSection
    reference: ReferenceSection | None = None
    references: dict[str, ReferenceSection] = Field(default_factory=dict)
    epochs: dict[str, EpochSection] = Field(default_factory=dict)
    blocks: dict[str, BlockSection] = Field(default_factory=dict)
    points: PointsSection | None = None
    preset: str = "default"
    config: dict[str, Any] = Field(default_factory=dict)

    @field_validator("epochs", "references", "blocks")
    @classmethod
    def _epoch_names(cls, epochs: dict[str, Any]) -> dict[str, Any]:
        for name in epochs:
            if not _NAME.fullmatch(name) or name == REFERENCE:
                raise ValueError(f"the epoch name '{name}' must be letters, digits, '_', '.', '-', and not 'reference'")
        return epochs

    @model_validator(mode="after")
    def _references(self) -> ProjectFile:
        if not self.epochs and not self.blocks:
            raise ValueError("a project has a section [epochs.NAME], or [blocks.NAME] where there are no images")
        if self.epochs and (self.reference is None) == (not self.references):
            raise ValueError("a project has a section [reference], or one [references.NAME] for each reference epoch")
        names = [*self.references, *self.epochs, *self.blocks]
        if both := sorted({name for name in names if names.count(name) > 1}):
            raise ValueError(f"a reference epoch and a new epoch or block have the same name: {', '.join(both)}")
        estimated = {name for name, section in self.reference_epochs.items() if section.sigma == "estimate"}
        if 0 < len(estimated) < len(self.reference_epochs):
            raise ValueError(
                f"the sigma of {', '.join(sorted(estimated))} is to be estimated and that of others is given; "
                "give all of them, or estimate all"
            )
        return self

    @property
    def reference_epochs(self) -> dict[str, ReferenceSection]:
        """The reference epochs by name."""
        return self.references if self.reference is None else {REFERENCE: self.reference}

    @model_validator(mode="after")
    def _marks_name_epochs(self) -> ProjectFile:
        unknown = set(self.points.marks) - set(self.epochs) if self.points else set()
        if unknown:
            raise ValueError(f"points.marks names epochs that do not exist: {', '.join(sorted(unknown))}")
        return self


@dataclass(frozen=True)
class Project:
    """A project opened for one run: declarations, configuration, and folders."""

    file: ProjectFile
    config: Config
    folder: Path
    data_root: Path
    output: Path

    def data(self, name: str) -> Path:
        """A file that the project declares: in the data root, else one that lies beside project.toml."""
        own = self.folder / name
        return own if own.is_file() and not (self.data_root / name).exists() else self.data_root / name

    def stage_folder(self, epoch: str, stage: str, fingerprint: str) -> Path:
        return self.output / "work" / epoch / stage / fingerprint

    def stage_history(self, epoch: str, stage: str) -> list[Path]:
        """Folders of all runs of a stage, oldest first."""
        parent = self.output / "work" / epoch / stage
        return sorted((p for p in parent.glob("*") if p.is_dir()), key=lambda p: p.stat().st_mtime)

    @property
    def panorama_folder(self) -> Path:
        """Where the heads that are cut from panoramas lie."""
        return self.output / "work" / "panoramas"

    @property
    def feature_folder(self) -> Path:
        return self.output / "work" / "features"

    def published(self, epoch: str) -> Path:
        return self.output / "epochs" / epoch

    def evaluation(self, epoch: str) -> Path:
        return self.output / "evaluation" / epoch

    def select_epoch(self, epoch: str | None) -> str:
        """The epoch that is named, or the only one there is."""
        return self._select("epoch", list(self.file.epochs), epoch)

    def select_block(self, block: str | None) -> str:
        """The block that is named, or the only one there is."""
        return self._select("block", list(self.file.blocks), block)

    def _select(self, what: str, names: list[str], wanted: str | None) -> str:
        if wanted is None and len(names) == 1:
            return names[0]
        if not names:
            raise ConfigError(f"The project has no {what}s.", "Blocks go by `georef adjust`, epochs by `georef run`.")
        if wanted not in names:
            problem = f"There is no {what} '{wanted}'." if wanted else f"The project has several {what}s."
            raise ConfigError(problem, f"Name one with --epoch: {', '.join(names)}.")
        return wanted


def open_project(
    where: Path,
    *,
    data: Path | None = None,
    output: Path | None = None,
    preset: str | None = None,
    settings: tuple[str, ...] = (),
) -> Project:
    """Reads and validates a project (its folder or its project.toml). Raises ConfigError.

    The data root is `data`, else GEOREF_DATA (either may be its parent), else the project's own folder.
    """
    path = where / PROJECT_FILE if where.is_dir() or not where.suffix else where
    if not path.is_file():
        raise ConfigError(f"There is no project at {where}.\nExpected {PROJECT_FILE} there; `georef init` writes one.")
    project_layer, config_layer = _split_overrides(parse_overrides(settings))
    file = validated(ProjectFile, merge(read_toml(path), project_layer), str(path))
    config = load_config(preset or file.preset, (file.config, config_layer))
    _check_epochs(config, list(file.reference_epochs))
    folder = path.parent.resolve()
    return Project(
        file=file,
        config=config,
        folder=folder,
        data_root=_data_root(file, folder, data),
        output=(output or folder).resolve(),
    )


def _check_epochs(config: Config, known: list[str]) -> None:
    for name in config.candidates.epochs:
        if name not in known:
            raise ConfigError(
                f"The key 'candidates.epochs' names '{name}', which is no reference epoch of the project.",
                f"Expected some of: {', '.join(known)}.",
            )


def _split_overrides(overrides: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Sections of project.toml and sections of the configuration have different names; anything else is the latter."""
    project = {key: value for key, value in overrides.items() if key in ProjectFile.model_fields}
    return project, {key: value for key, value in overrides.items() if key not in project}


def _data_root(file: ProjectFile, folder: Path, data: Path | None) -> Path:
    """The named folder, or its sub-folder of the project's name: whichever holds the exterior orientation."""
    environment = os.environ.get("GEOREF_DATA")
    if data:
        tried = [data, data / folder.name]
    else:
        named = Path(environment) if environment else None
        tried = [*([named, named / folder.name] if named else []), folder]
    tables = [section.exterior_orientation for section in file.reference_epochs.values()]
    wanted = [*tables, *(section.observations.file for section in file.blocks.values())][0]
    for root in tried:
        if (root / wanted).is_file():
            return root.resolve()
    raise ConfigError(
        f"The data of project '{file.name}' were not found.\n"
        f"Expected {wanted} in {' or '.join(str(root) for root in tried)}.\n"
        "Name the folder with --data DIR or in the environment variable GEOREF_DATA."
    )
