"""`georef evaluate PROJECT --truth FILE`: runs the variants of all tables, compares them with the truth, writes all."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from georef import __version__
from georef.comparison.accuracy import Row, rows_of, table_of
from georef.comparison.costs import runtime_table, storage_table
from georef.comparison.run import LOCALIZE, STATIONS, Runs, Say, Source, VariantRun, variants_of
from georef.comparison.truth import TruthFile, read_truth
from georef.comparison.variants import TableSection, read_tables
from georef.evaluation.curves import POSITION_RANGE_M, ROTATION_RANGE_DEG, round_limits
from georef.evaluation.pose_errors import TruthSigmas
from georef.evaluation.tables import Cell, Column, Table
from georef.executor import Executor
from georef.io.files import write_text_atomically
from georef.project import Project
from georef.report.evaluation_page import curve_pictures, render_evaluation

JSON, HTML = "evaluation.json", "evaluation.html"
LAST_STAGES = {"single": LOCALIZE, "stations": STATIONS}
_RANGES = {
    "position_m": ("position", "m", POSITION_RANGE_M),
    "rotation_deg": ("rotation", "deg", ROTATION_RANGE_DEG),
}


@dataclass(frozen=True, eq=False)
class Comparison:
    """All tables of an evaluation, and the rows they come from."""

    project: Project
    epoch: str
    truth: TruthFile
    sections: tuple[TableSection, ...]
    rows: dict[str, list[Row]]  # of each section
    tables: list[Table] = field(default_factory=list)

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON, free of NaN and infinity."""
        sigmas = self.truth.sigmas
        return {
            "project": self.project.file.name,
            "epoch": self.epoch,
            "georef_version": __version__,
            "truth": {
                "file": self.truth.table.path.name,
                "images": len(self.truth),
                "sigma_position_m": sigmas.position_m,
                "sigma_rotation_deg": float(np.rad2deg(sigmas.rotation_rad)),
            },
            "tables": [table.to_dict() for table in self.tables],
            "curves": {name: _curves(rows) for name, rows in self.rows.items()},
            "variants": [_variant(name, row.run) for name, rows in self.rows.items() for row in _first_of(rows)],
            "errors": {
                name: {row.name: row.errors.to_dict() for row in _run(rows)} for name, rows in self.rows.items()
            },
        }


def compare(
    source: Source,
    truth: Path,
    sigmas: TruthSigmas | None,
    *,
    variants: Path | None,
    wanted: Sequence[str],
    executor: Executor,
    say: Say,
) -> Comparison:
    """Runs every variant of the wanted tables and makes the tables. Raises GeorefError."""
    sections = read_tables(variants, wanted)
    project, epoch = source.open()
    listed = {section.name: variants_of(section, source) for section in sections}
    for variant in (variant for listing in listed.values() for variant in listing):
        source.open(variant)  # a mistake in any variant shows before the first one runs
    file = read_truth(truth, project, epoch, sigmas or TruthSigmas())
    runs = Runs(source, executor, say)
    results = {
        section.name: [runs.run(variant, LAST_STAGES[section.poses]) for variant in listed[section.name]]
        for section in sections
    }
    rows = {section.name: rows_of(section, results[section.name], file) for section in sections}
    tables = [table_of(section, rows[section.name]) for section in sections]
    once = _each_once(results)
    return Comparison(project, epoch, file, sections, rows, [*tables, runtime_table(once), storage_table(once)])


def write_comparison(comparison: Comparison) -> list[Path]:
    """Writes the page, the JSON, a CSV file a table and the curves; returns the paths, the page first."""
    folder = comparison.project.evaluation(comparison.epoch)
    folder.mkdir(parents=True, exist_ok=True)
    data = comparison.to_dict()
    texts = {
        HTML: render_evaluation(data),
        JSON: json.dumps(data, indent=1, allow_nan=False),
        **{f"{table.name}.csv": table.csv() for table in comparison.tables},
        **{f"{name}-curves.csv": _curve_table(name, rows).csv() for name, rows in comparison.rows.items()},
        **{f"{name}.svg": picture for name, picture in curve_pictures(data).items()},
    }
    for name, text in texts.items():
        write_text_atomically(text, folder / name)
    return [folder / name for name in texts]


def _run(rows: Sequence[Row]) -> list[Row]:
    return [row for row in rows if not row.run.problem]


def _first_of(rows: Sequence[Row]) -> list[Row]:
    """One row of each variant."""
    found: dict[str, Row] = {}
    for row in rows:
        found.setdefault(row.run.variant.name, row)
    return list(found.values())


def _each_once(results: Mapping[str, Sequence[VariantRun]]) -> dict[str, VariantRun]:
    """Runs that differ in their results, each by the name of the table and the variant that had it first."""
    found: dict[str, tuple[str, VariantRun]] = {}
    for table, runs in results.items():
        for run in runs:
            if run.context is not None:
                found.setdefault(run.costs[-1].run, (f"{table}: {run.variant.name}", run))
    return dict(found.values())


def _variant(table: str, run: VariantRun) -> dict[str, Any]:
    return {
        "table": table,
        "name": run.variant.name,
        "preset": run.variant.preset,
        "settings": list(run.variant.settings),
        "problem": run.problem,
        "run": None if run.context is None else run.context.folder.name,
    }


def _curves(rows: Sequence[Row]) -> dict[str, Any]:
    return {row.name: {key: curve.to_dict() for key, curve in row.curves.items()} for row in _run(rows)}


def _curve_table(name: str, rows: Sequence[Row]) -> Table:
    """Percentages within round limits, one column a row of the table that the curves belong to."""
    shown = _run(rows)
    columns = (
        Column("error", "error"),
        Column("limit", "limit"),
        Column("unit", "unit"),
        *(Column(row.name, row.name, "%", 1) for row in shown),
    )
    lines: list[dict[str, Cell]] = []
    for key, (error, unit, (low, high)) in _RANGES.items():
        for limit in round_limits(low, high):
            shares = {row.name: float(row.curves[key].at(limit)) for row in shown}
            lines.append({"error": error, "limit": limit, "unit": unit, **shares})
    return Table(f"{name}-curves", "Cumulative curves", columns, tuple(lines))
