"""Tables of every constraint of an adjustment, written piece by piece: residuals, redundancy, w, detectable biases."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import cast

import numpy as np
from scipy.stats import chi2

from georef.crs import WorldFrame, crs_kind
from georef.estimation.adjustment.adjust_block import AdjustedBlock
from georef.estimation.adjustment.blunders.gates import RejectedConstraint
from georef.estimation.adjustment.quality.reliability import Reliability
from georef.geometry.rigid import Array
from georef.io.columns import POSITION_COLUMNS, CrsKind
from georef.io.files import write_lines_atomically
from georef.stages.adjustment_report import GROUPS

TABLES = {
    "control": "adjustment_control.csv",
    "automatic": "adjustment_gcps.csv",
    "localized": "adjustment_pose_priors.csv",
    "GNSS positions": "adjustment_gnss.csv",
}
REJECTED = "adjustment_rejected.csv"
_CHUNK = 20_000
_LENGTHS = ("residual", "sigma", "redundancy", "w", "detectable", "effect")


def write_tables(
    folder: Path, adjusted: AdjustedBlock, checked: Mapping[str, Reliability], world: WorldFrame
) -> list[Path]:
    """One table for each kind of constraint that is there, and one of all that was rejected."""
    paths = []
    for kind, found in checked.items():
        if len(found):
            paths.append(folder / TABLES[kind])
            write_lines_atomically(chain(_comments(found), _reliability_lines(found, world)), paths[-1])
    if adjusted.rejected:
        paths.append(folder / REJECTED)
        comment = "# Constraints that contradict all others, by their test when they left."
        write_lines_atomically(chain([comment], _rejected_lines(adjusted.rejected)), paths[-1])
    return paths


def _comments(found: Reliability) -> list[str]:
    return [
        "# Residual: adjusted minus given, along the axes of the CRS at each place; metres, rotations in degrees.",
        "# Detectable: minimal detectable bias (alpha0 0.001, beta0 0.20), inf where nothing checks the component; "
        "effect: how far a bias of that size would move the adjusted position. Empty: the component has no weight.",
        f"# {len(found)} constraints; statistic: of all components of a row together, chi-square with dof.",
    ]


def _reliability_lines(found: Reliability, world: WorldFrame) -> Iterator[str]:
    rotated = found.w.shape[1] == 6
    axes = ["rot_e", "rot_n", "rot_h", "e", "n", "h"] if rotated else ["e", "n", "h"]
    kind = cast(CrsKind, crs_kind(world.definition))
    parts = [f"{part}_{axis}{_unit(part, axis)}" for part in _LENGTHS for axis in axes]
    yield ",".join(["name", *POSITION_COLUMNS[kind], *parts, "statistic", "dof", "p_value"])
    decimals = (9, 9, 4) if kind == "geographic" else (4, 4, 4)
    factor = np.degrees(1.0) if rotated else 1.0
    for start in range(0, len(found), _CHUNK):
        rows = slice(start, start + _CHUNK)
        places = world.crs_from_world(found.place[rows])
        columns = [_in_degrees(getattr(found, part)[rows], part, factor) for part in _LENGTHS]
        p_value = chi2.sf(found.statistic[rows], np.maximum(found.dof[rows], 1))
        values = np.column_stack([*columns, found.statistic[rows]])
        for k, name in enumerate(found.ids[rows]):
            place = ",".join(f"{v:.{d}f}" for v, d in zip(places[k], decimals, strict=True))
            row = ",".join("" if v != v else f"{v:.6g}" for v in values[k].tolist())
            yield f"{_quoted(name)},{place},{row},{found.dof[start + k]},{p_value[k]:.4g}"


def _unit(part: str, axis: str) -> str:
    if part in ("redundancy", "w"):
        return ""
    return "_deg" if axis.startswith("rot") and part != "effect" else "_m"


def _in_degrees(values: Array, part: str, factor: float) -> Array:
    """Rotations, where there are any, in degrees; effects are metres throughout."""
    if values.shape[1] == 3 or part in ("redundancy", "w", "effect"):
        return values
    return np.column_stack([factor * values[:, :3], values[:, 3:]])


def _rejected_lines(rejected: Sequence[RejectedConstraint]) -> Iterator[str]:
    yield "kind,name,statistic,dof,p_value"
    for one in rejected:
        kind = GROUPS.get(one.kind, one.kind)
        p_value = chi2.sf(one.statistic, max(one.dof, 1))
        yield f"{_quoted(kind)},{_quoted(one.name)},{one.statistic:.6g},{one.dof},{p_value:.4g}"


def _quoted(name: str) -> str:
    return '"' + name.replace('"', '""') + '"' if set(name) & set(',"\n;#') else name
