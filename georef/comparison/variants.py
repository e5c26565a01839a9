"""What an evaluation compares: tables of variants, read from a TOML file; `configs/evaluation/` holds the default."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

from pydantic import Field, field_validator

from georef.config import Section, presets_folder, read_toml, validated
from georef.errors import ConfigError

AS_CONFIGURED = "as configured"


class Variant(Section):
    """A name, and what of the configuration differs from that of the project."""

    name: str = Field(min_length=1)
    preset: str | None = None
    set: dict[str, Any] = Field(default_factory=dict)

    @property
    def settings(self) -> tuple[str, ...]:
        """As `--set` takes them: section.key=value, the value in TOML."""
        return tuple(f"{key}={json.dumps(value)}" for key, value in _flat(self.set))


class TableSection(Section):
    """A table: its variants, and what each row and column of it is."""

    name: str = Field(pattern=r"^[a-z0-9][a-z0-9-]*$")
    title: str
    caption: str = ""
    rows: Literal["variants", "cameras", "reference-epochs"] = "variants"
    columns: Literal["accuracy", "retrieval"] = "accuracy"
    poses: Literal["single", "stations"] = "single"  # of each image alone, or as [stations] poses them together
    variants: tuple[Variant, ...] = Field(default=(Variant(name=AS_CONFIGURED),), min_length=1)

    @field_validator("variants")
    @classmethod
    def _different_names(cls, variants: tuple[Variant, ...]) -> tuple[Variant, ...]:
        names = [variant.name for variant in variants]
        if len(set(names)) < len(names):
            raise ValueError(f"each variant of a table needs a name of its own, not {', '.join(names)}")
        return variants


class EvaluationFile(Section):
    """The content of the TOML file."""

    tables: tuple[TableSection, ...] = Field(min_length=1)

    @field_validator("tables")
    @classmethod
    def _different_names(cls, tables: tuple[TableSection, ...]) -> tuple[TableSection, ...]:
        names = [table.name for table in tables]
        if len(set(names)) < len(names):
            raise ValueError(f"each table needs a name of its own, not {', '.join(names)}")
        return tables


def read_tables(path: Path | None, wanted: Sequence[str]) -> tuple[TableSection, ...]:
    """The tables of a file, of the default one where it is None; only the wanted ones, all where none is named."""
    path = path or presets_folder() / "evaluation" / "default.toml"
    tables = validated(EvaluationFile, read_toml(path), str(path)).tables
    known = [table.name for table in tables]
    for name in wanted:
        if name not in known:
            raise ConfigError(f"There is no table '{name}'.", f"Expected one of {', '.join(known)}.", f"In {path}.")
    return tuple(table for table in tables if not wanted or table.name in wanted)


def _flat(values: Mapping[str, Any], prefix: str = "") -> list[tuple[str, Any]]:
    out: list[tuple[str, Any]] = []
    for key, value in values.items():
        out += _flat(value, f"{prefix}{key}.") if isinstance(value, Mapping) else [(f"{prefix}{key}", value)]
    return out
