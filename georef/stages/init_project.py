"""Verb `init`: writes project.toml for a folder of data whose files have the usual names.

    reference_eo.csv  reference/   camera.csv   <epoch>_gnss.csv  <epoch>/   points.csv  marks_<epoch>.csv

or several reference epochs and tables of cameras, see `init_files`; or what Pix4D exports of a block, see `init_block`.

What the files declare in their comments is taken over; what nobody says is asked for, never guessed.
"""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from georef.config import validated
from georef.crs import LOCAL, CrsDefinition, choose_origin, crs_kind
from georef.errors import ConfigError, CrsError, InputError
from georef.io.columns import POSITION_COLUMNS
from georef.io.declarations import ANGLE_NAMES, AngleConvention, AngleUnit, normalized_crs
from georef.io.exterior_orientation import exterior_orientation_from_table
from georef.io.files import write_text_atomically
from georef.io.tables import Table, read_table
from georef.project import PROJECT_FILE, REFERENCE, ProjectFile
from georef.stages.init_block import find_pix4d, init_block
from georef.stages.init_files import EO_SUFFIX, GNSS_SUFFIX, Found, find_files
from georef.types.constraints import CheckKind

POINTS, MARKS_PREFIX = "points.csv", "marks_"


@dataclass(frozen=True)
class Answers:
    """What the user states; None where the files are to say it."""

    crs: str | None = None
    height: str | None = None
    angles: AngleConvention | None = None
    angle_unit: AngleUnit | None = None
    check_kind: Literal["absolute", "relative"] | None = None
    name: str | None = None
    columns: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Written:
    """The new file, and a line for each thing that it says and where that comes from."""

    path: Path
    said: tuple[str, ...]


@dataclass
class _Facts:
    """What was found out, with its sources."""

    tables: dict[str, Table]
    found: Found
    values: dict[str, str] = field(default_factory=dict)
    said: list[str] = field(default_factory=list)


def init_project(folder: Path, data: Path, answers: Answers) -> Written:
    """Writes the project file of a folder of data. Raises ConfigError, InputError, CrsError; overwrites nothing."""
    path = folder / PROJECT_FILE
    if path.exists():
        raise ConfigError(
            "There is a project already; it stays as it is.",
            "Edit it, or name another folder for the new project.",
            f"In {path}.",
        )
    exports = find_pix4d(data)
    if exports is not None:
        return Written(path, init_block(path, exports, answers.crs, answers.height, answers.name))
    found = find_files(data)
    facts = _Facts(_tables(found, answers.columns), found)
    definition = _definition(facts, answers)
    origin = _origin(facts, definition, answers)
    text = _project_text(found, definition, origin, facts, answers)
    validated(ProjectFile, tomllib.loads(text), str(path))
    write_text_atomically(text, path)
    facts.said.append(f"epochs: {', '.join(found.epochs)}")
    return Written(path, tuple(facts.said))


def parse_columns(texts: Iterable[str]) -> dict[str, str]:
    """ "easting=X" texts: our name of a column to that in the files. Raises ConfigError."""
    out = {}
    for text in texts:
        ours, equals, theirs = (part.strip() for part in text.partition("="))
        if not (equals and theirs and re.fullmatch(r"[a-z_0-9]+", ours)):
            raise ConfigError(f"--column {text!r} cannot be read.", "Expected name=column, e.g. --column easting=X.")
        out[ours] = theirs
    return out


def _tables(found: Found, columns: Mapping[str, str]) -> dict[str, Table]:
    names = [*found.orientations, *(f"{epoch}{GNSS_SUFFIX}" for epoch in found.epochs)]
    names += [POINTS] if (found.data / POINTS).is_file() else []
    return {name: read_table(found.data / name, columns=columns) for name in names}


def _definition(facts: _Facts, answers: Answers) -> CrsDefinition:
    crs = _stated(facts, "crs", "--crs", None if answers.crs is None else normalized_crs(answers.crs))
    if crs is None:
        raise _unknown(facts, "the coordinate reference system", "--crs EPSG:25832, or --crs local for a site system")
    given = answers.crs or crs
    height = None
    if crs != LOCAL and "+" not in given:
        height = _stated(facts, "height", "--height", answers.height)
    definition = CrsDefinition(given, height)
    try:
        crs_kind(definition)
    except CrsError as error:
        raise CrsError(str(error), "State it: --crs, and --height ellipsoidal or --height EPSG:code.") from None
    facts.values["kind"] = crs_kind(definition)
    return definition


def _origin(facts: _Facts, definition: CrsDefinition, answers: Answers) -> list[float]:
    """Where the world frame is to stand: in the middle of the reference; reads its exterior orientation."""
    for name in facts.found.orientations:
        _require_axes(facts, facts.tables[name])
    angles = _stated(facts, "angles", "--angles", answers.angles)
    convention: AngleConvention | None = next((name for name in ANGLE_NAMES if name == angles), None)
    if convention is None:
        options = " or ".join(f"--angles {name}" for name in ANGLE_NAMES)
        raise _unknown(
            facts, f"a convention of the angles that can be read ({angles})" if angles else "the angles", options
        )
    unit_text = _stated(facts, "angle_unit", "--angle-unit", answers.angle_unit)
    unit = next((name for name in get_args(AngleUnit) if name == unit_text), None)
    if unit is None:
        raise _unknown(facts, "the unit of the angles", "--angle-unit deg, gon or rad")
    positions = []
    for epoch, name in zip(facts.found.references, facts.found.orientations, strict=True):
        table = facts.tables[name]
        orientation = exterior_orientation_from_table(table, crs_kind=_kind(facts), angles=convention, angle_unit=unit)
        facts.said.append(f"{_titled(epoch)}: {len(orientation)} images, {convention} in {unit}")
        positions.append(orientation.positions_in_crs)
    return choose_origin(definition, np.concatenate(positions)).tolist()


def _titled(epoch: str) -> str:
    return epoch if epoch == REFERENCE else f"reference {epoch}"


def _kind(facts: _Facts) -> Any:
    return facts.values["kind"]


def _require_axes(facts: _Facts, table: Table) -> None:
    wanted = POSITION_COLUMNS[_kind(facts)]
    missing = [name for name in wanted if not table.has(name)]
    if missing:
        raise InputError(
            f"The table has no column '{missing[0]}'; its columns are: {', '.join(table.header)}.",
            expected=f"the columns {', '.join(wanted)}; the order of axes is never guessed.",
            remedy=f"State which column is which: {' '.join(f'--column {name}=...' for name in missing)}.",
            path=table.path,
            row=table.header_row,
        )


def _stated(facts: _Facts, key: str, option: str, answer: str | None) -> str | None:
    """The value that the option or the files state; InputError where they contradict each other."""
    value, source = answer, option
    for name, table in facts.tables.items():
        own = getattr(table.declared, key)
        if own is None:
            continue
        if value is not None and own != value:
            raise InputError(
                f"The file declares {key} = {own!r}, {source} says {value!r}.",
                expected="one declaration for all files of a project.",
                remedy=f"Correct {option}, or the comment in the file.",
                path=table.path,
                row=table.declared.rows.get(key),
            )
        value, source = own, name if source == option and answer is None else source
    if value is not None:
        facts.values[key] = value
        facts.said.append(f"{key}: {value} (stated in {source})")
    return value


def _unknown(facts: _Facts, what: str, options: str) -> InputError:
    return InputError(
        f"No file declares {what}, and no option states it.",
        expected="a comment in the first lines, such as '# CRS: EPSG:25832, height: ellipsoidal. Angles: degrees, "
        "omega-phi-kappa'.",
        remedy=f"State it: {options}. It is never guessed.",
        path=facts.tables[facts.found.orientations[0]].path,
    )


def _check_kind(facts: _Facts, answers: Answers) -> str:
    if answers.check_kind is not None:
        return answers.check_kind
    table = facts.tables[POINTS]
    if table.has("kind") and all(table.text("kind")):
        return CheckKind.RELATIVE.value  # each point says its own
    raise InputError(
        "The table does not say what its check points are independent of.",
        expected="absolute (surveyed independently of the reference) or relative (derived from the reference).",
        remedy="State it: --check-kind absolute or --check-kind relative.",
        path=table.path,
    )


def _project_text(found: Found, definition: CrsDefinition, origin: list[float], facts: _Facts, answers: Answers) -> str:
    mapping = ", ".join(f"{key} = {_quoted(value)}" for key, value in answers.columns.items())
    table = [f"table = {{ columns = {{ {mapping} }} }}"] if mapping else []
    lines = [
        "# File names are relative to the folder of the data: --data DIR, or GEOREF_DATA, or else this folder.",
        f"name = {_quoted(answers.name or found.data.resolve().name)}",
        *_crs_text(definition, origin),
        *(line for epoch in found.references for line in _reference_text(epoch, facts, table)),
    ]
    for epoch in found.epochs:
        lines += ["", f"[epochs.{_key(epoch)}]", f"images = {_quoted(epoch)}", _cameras_text(epoch, facts)]
        lines += [f"gnss = {_quoted(epoch + GNSS_SUFFIX)}", *_rig_text(epoch, facts), *table]
    return "\n".join([*lines, *_points_text(found.data, found.epochs, facts, answers, table)]) + "\n"


def _crs_text(definition: CrsDefinition, origin: list[float]) -> list[str]:
    return [
        "",
        "[crs]",
        f"horizontal = {_quoted(definition.horizontal)}",
        *([f"height = {_quoted(definition.height)}"] if definition.height else []),
        f"origin = {json.dumps(origin)}  # of the world frame, in this CRS; fixed, so that all epochs share it",
    ]


def _cameras_text(epoch: str, facts: _Facts) -> str:
    """The line that says what cameras took an epoch's images."""
    cameras = facts.found.cameras(epoch)
    if cameras is not None:
        return f"cameras = {_quoted(cameras)}"
    facts.said.append(f"epoch {epoch}: no table of cameras, focal length and k1 are to be estimated")
    return 'intrinsics = "estimate"  # no table of cameras was found'


def _rig_text(epoch: str, facts: _Facts) -> list[str]:
    """The line that names the rig of an epoch whose table of positions says what was exposed together."""
    rig, positions = facts.found.rig(epoch), facts.tables[epoch + GNSS_SUFFIX]
    if rig is None:
        return []
    if not positions.has("station"):
        facts.said.append(f"epoch {epoch}: {rig} is left out, its positions have no column 'station'")
        return []
    facts.said.append(f"epoch {epoch}: a rig, {rig}")
    return [f"rig = {_quoted(rig)}"]


def _reference_text(epoch: str, facts: _Facts, table: list[str]) -> list[str]:
    cameras = facts.found.cameras(epoch)
    return [
        "",
        f"[{REFERENCE}]" if epoch == REFERENCE else f"[references.{_key(epoch)}]",
        f"images = {_quoted(epoch)}",
        *([f"cameras = {_quoted(cameras)}"] if cameras is not None else []),
        f"exterior_orientation = {_quoted(epoch + EO_SUFFIX)}",
        f"angles = {_quoted(facts.values['angles'])}",
        f"angle_unit = {_quoted(facts.values['angle_unit'])}",
        'sigma = "estimate"  # or { position_m = [0.01, 0.01, 0.02], rotation_deg = [0.01, 0.01, 0.01] }',
        *table,
    ]


def _points_text(data: Path, epochs: Sequence[str], facts: _Facts, answers: Answers, table: list[str]) -> list[str]:
    marks = {epoch: f"{MARKS_PREFIX}{epoch}.csv" for epoch in epochs}
    marks = {epoch: name for epoch, name in marks.items() if (data / name).is_file()}
    if POINTS not in facts.tables or not marks:
        return []
    facts.said.append(f"points: {len(facts.tables[POINTS])}, marked in {', '.join(marks)}")
    named = ", ".join(f"{_key(epoch)} = {_quoted(name)}" for epoch, name in marks.items())
    kind = f'check_kind = "{_check_kind(facts, answers)}"'
    return ["", "[points]", f'coordinates = "{POINTS}"', f"marks = {{ {named} }}", kind, *table]


def _quoted(text: str) -> str:
    """A TOML string; JSON's escapes are valid there."""
    return json.dumps(text, ensure_ascii=False)


def _key(name: str) -> str:
    return name if re.fullmatch(r"[A-Za-z0-9_-]+", name) else _quoted(name)
