"""Verb `evaluate`: a file of poses against the truth."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np

from georef.crs import CrsDefinition, WorldFrame, crs_kind
from georef.errors import ConfigError, CrsError, InputError
from georef.evaluation.pose_errors import ErrorQuantiles, PoseErrors, TruthSigmas, compare_poses
from georef.evaluation.statistics import NeesSummary
from georef.geometry.rigid import Rigid3
from georef.io.columns import CrsKind
from georef.io.declarations import Declared, normalized_crs
from georef.io.files import write_text_atomically
from georef.io.pose_records import PoseRecord, PoseTable
from georef.io.poses import read_poses
from georef.io.tables import read_table
from georef.stages.survey import world_poses

RESULT = "evaluation-{}.json"  # of the stem of the poses' file, so that each has its own


@dataclass(frozen=True, eq=False)
class Evaluation:
    """The errors of a file of poses, and what they refer to."""

    errors: PoseErrors
    definition: CrsDefinition
    truth_sigmas: TruthSigmas
    poses: Path
    truth: Path

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return {
            "poses": self.poses.name,
            "truth": self.truth.name,
            "crs": {"horizontal": self.definition.horizontal, "height": self.definition.height},
            "truth_sigma_position_m": self.truth_sigmas.position_m,
            "truth_sigma_rotation_deg": float(np.rad2deg(self.truth_sigmas.rotation_rad)),
            "residual": "estimated minus true, east-north-up at the first true position; images without a pose count "
            "as infinitely wrong",
            **self.errors.to_dict(),
        }


def evaluate(
    poses: Path,
    truth: Path,
    *,
    crs: str | None = None,
    height: str | None = None,
    truth_sigmas: TruthSigmas | None = None,
) -> Evaluation:
    """Compares all images of the truth, in one metric frame about the first of them. Raises InputError, CrsError."""
    definition = _definition(poses, truth, crs, height)
    kind = cast(CrsKind, crs_kind(definition))
    estimated, true = read_poses(poses, crs_kind=kind), read_poses(truth, crs_kind=kind)
    posed = [record for record in true.records if record.has_pose]
    _require_common(estimated, posed, truth)
    world = WorldFrame.create(definition, _position(posed[0]))
    found = [record for record in estimated.records if record.has_pose]
    covs = {record.image_id: record.cov for record in found}
    sigmas = truth_sigmas or TruthSigmas()
    errors = compare_poses(
        {name: (pose, covs[name]) for name, pose in _in_world(found, world).items()},
        _in_world(posed, world),
        truth_sigmas=sigmas,
    )
    return Evaluation(errors, definition, sigmas, poses, truth)


def write_evaluation(evaluation: Evaluation, path: Path | None = None) -> Path:
    """Writes the JSON, beside the poses unless told otherwise, and returns its path."""
    path = path or evaluation.poses.parent / RESULT.format(evaluation.poses.stem)
    write_text_atomically(json.dumps(evaluation.to_dict(), indent=1, allow_nan=False), path)
    return path


def what_to_compare(
    project: Path | None, poses: Path | None, truth: Path | None, *, leave_one_out: bool, chosen: bool
) -> None:
    """Raises ConfigError unless the options go together: a project or poses with a truth, or a project without."""
    if leave_one_out:
        if project is None or poses is not None or truth is not None:
            what = "no project" if project is None else "--poses" if poses is not None else "--truth"
            raise ConfigError(
                f"--leave-one-out is given with {what}.",
                "Expected a project alone, whose reference images are compared with their given poses: "
                "georef evaluate PROJECT --leave-one-out.",
            )
        return
    if chosen:
        raise ConfigError("--references and --count choose among left out images.", "Add --leave-one-out.")
    if (project is None) == (poses is None):
        raise ConfigError(
            "Neither a project nor a file of poses is named."
            if poses is None
            else "Both a project and --poses are named.",
            "Expected one of them: georef evaluate PROJECT --truth FILE, or --poses FILE --truth FILE.",
        )
    if truth is None:
        raise ConfigError(
            "There is nothing to compare with.",
            "Name the true exterior orientation with --truth FILE; or, of a project, compare its reference images with "
            "each other: --leave-one-out.",
        )


def parse_truth_sigma(text: str) -> TruthSigmas:
    """ "0.01,0.02": metres and degrees. Raises ConfigError."""
    try:
        position_m, rotation_deg = (float(part) for part in text.split(","))
        return TruthSigmas(position_m, float(np.deg2rad(rotation_deg)))
    except ValueError:
        raise ConfigError(
            f"--truth-sigma {text!r} cannot be read.",
            "Expected POSITION_M,ROTATION_DEG, neither of them negative, e.g. --truth-sigma 0.01,0.02.",
        ) from None


def describe(evaluation: Evaluation) -> list[str]:
    """The evaluation in lines for a terminal."""
    errors = evaluation.errors
    count = len(errors.errors)
    lines = [f"images      {count - len(errors.failed)} of {count} have a pose"]
    if errors.failed:
        lines[0] += f"; without: {_some(errors.failed)}"
    if errors.without_truth:
        lines.append(f"            left out, without truth: {_some(errors.without_truth)}")
    lines += [
        f"position    {_quantiles(errors.position_m, 1e3, 'mm', 1)}",
        f"rotation    {_quantiles(errors.rotation_deg, 1.0, 'deg', 4)}",
    ]
    if errors.mean_offset_m is not None and errors.rmse_offset_m is not None:
        lines.append(f"bias E N H  {_three(errors.mean_offset_m, '+')} mm, RMSE {_three(errors.rmse_offset_m, '')} mm")
    lines += [
        f"within      {r.position_m:5.3f} m and {r.rotation_deg:5.2f} deg: {r.percent:5.1f} %" for r in errors.recall
    ]
    names = (
        ("NEES / dof  ", errors.nees),
        ("  position  ", errors.nees_position),
        ("  rotation  ", errors.nees_rotation),
    )
    return [*lines, *(name + _nees(summary) for name, summary in names)]


def _definition(poses: Path, truth: Path, crs: str | None, height: str | None) -> CrsDefinition:
    """The CRS of both files, from the options, else from what they declare."""
    declared = [(path, read_table(path, allow_no_rows=True).declared) for path in (poses, truth)]
    found = _agreed("--crs", None if crs is None else normalized_crs(crs), [(p, d.crs, d) for p, d in declared])
    if found is None:
        raise InputError(
            "Neither file declares its coordinate reference system.",
            expected="a comment such as '# CRS: EPSG:25832, height: ellipsoidal' in one of them.",
            remedy="Write it into the files, or state it: --crs EPSG:25832 --height ellipsoidal, or --crs local.",
            path=poses,
        )
    found_height = _agreed("--height", height, [(p, d.height, d) for p, d in declared])
    definition = CrsDefinition(crs or found, found_height if "+" not in (crs or "") else None)
    try:
        crs_kind(definition)
    except CrsError as error:
        raise CrsError(str(error), "State what the coordinates refer to: --crs and --height.") from None
    return definition


def _agreed(option: str, stated: str | None, declared: list[tuple[Path, str | None, Declared]]) -> str | None:
    """The one value that the option and the files agree on, None where nobody says it."""
    value, source = stated, option
    for path, own, declarations in declared:
        if own is None:
            continue
        if value is not None and own != value:
            name = "crs" if option == "--crs" else "height"
            raise InputError(
                f"The file declares {name} {own!r}, {source} says {value!r}.",
                expected="both files, and the option where it is given, in one coordinate reference system.",
                remedy="Correct the option or the comment, or transform the coordinates.",
                path=path,
                row=declarations.rows.get(name),
            )
        value, source = own, str(path)
    return value


def _require_common(estimated: PoseTable, posed: list[PoseRecord], truth: Path) -> None:
    known = {record.image_id for record in posed}
    if known.isdisjoint(record.image_id for record in estimated.records):
        first = estimated.records[0].image_id if estimated.records else "none"
        raise InputError(
            f"No image of {estimated.path.name} has a true pose; the first there is '{first}'.",
            expected=f"the same image names in both files; the truth has {_some(tuple(known)) or 'none'}.",
            remedy="Correct the names, or name the right files with --poses and --truth.",
            path=truth,
        )


def _position(record: PoseRecord) -> np.ndarray:
    assert record.position_in_crs is not None
    return record.position_in_crs


def _in_world(records: list[PoseRecord], world: WorldFrame) -> dict[str, Rigid3]:
    if not records:
        return {}
    positions = np.array([_position(record) for record in records])
    axes = np.array([record.axes_from_cam for record in records])
    return dict(zip((r.image_id for r in records), world_poses(world, positions, axes), strict=True))


def _some(names: tuple[str, ...]) -> str:
    more = f" and {len(names) - 5} more" if len(names) > 5 else ""
    return ", ".join(sorted(names)[:5]) + more


def _quantiles(quantiles: ErrorQuantiles, scale: float, unit: str, digits: int) -> str:
    def text(value: float) -> str:
        return "infinite" if np.isinf(value) else f"{scale * value:.{digits}f} {unit}"

    interval = quantiles.median_interval
    spread = f" (95 %: {text(interval[0])} to {text(interval[1])})" if interval else " (too few for an interval)"
    largest = quantiles.maximum_estimated
    return f"median {text(quantiles.median)}{spread}" + (f", largest {text(largest)}" if np.isfinite(largest) else "")


def _three(values: np.ndarray, sign: str) -> str:
    return " ".join(f"{1e3 * value:{sign}.1f}" for value in values)


def _nees(summary: NeesSummary) -> str:
    ratio, interval = summary.mean_ratio, summary.interval
    if ratio is None or interval is None:
        return "not known: the poses have no covariances"
    verdict = "overconfident" if ratio > interval[1] else "too cautious"
    if summary.consistent:
        verdict = "consistent with their covariances"
    return f"{ratio:.2f} (95 %: {interval[0]:.2f} to {interval[1]:.2f}), {verdict}"
