"""Tables of accuracy and retrieval: runs of variants against true poses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from georef.comparison.run import VariantRun
from georef.comparison.truth import Truth, TruthFile
from georef.comparison.variants import TableSection
from georef.evaluation.curves import CumulativeCurve
from georef.evaluation.pose_errors import THRESHOLDS, ErrorQuantiles, PoseErrors, Recall, compare_poses
from georef.evaluation.retrieval import RANKS, RetrievalQuality, retrieval_quality, right_references
from georef.evaluation.statistics import wilson_interval
from georef.evaluation.tables import Cell, Column, Estimate, Table
from georef.types.campaign import Image
from georef.types.results import Localized

LEVELS = {"accurate": (0.05, 0.5), "moderate": (0.1, 1.0), "low": (0.2, 2.0)}
_FIRST = (Column("name", ""), Column("images", "images"))
_ACCURACY = (
    *_FIRST,
    Column("localized", "localized", "%", 0, interval=True),
    Column("median_position", "median position", "m", 1, 1e3, "mm", interval=True),
    Column("median_rotation", "median rotation", "deg", 4, interval=True),
    *(
        Column(f"within_{p:g}m_{r:g}deg", f"{p:g} m, {r:g}\N{DEGREE SIGN}", "%", 0, interval=True)
        for p, r in THRESHOLDS
    ),
    Column("nees_per_dof", "NEES / 6", "", 2),
)
_RETRIEVAL = (
    *_FIRST,
    *(Column(f"recall_at_{rank}", f"recall @{rank}", "%", 0, interval=True) for rank in RANKS),
    Column("precision", f"right of {RANKS[-1]}", "%", 0),
    *(Column(name, f"{name}: {p:g} m, {r:g}\N{DEGREE SIGN}", "%", 0, interval=True) for name, (p, r) in LEVELS.items()),
    Column("median_position", "median position", "m", 1, 1e3, "mm", interval=True),
    Column("median_rotation", "median rotation", "deg", 4, interval=True),
)
_RIGHT = (
    "A candidate is right where its viewing frustum and that of the query at its true pose have at least a fifth in "
    "common (to 30 m; what walls hide is not known). Recall @k: queries with a right one among their first k "
    "candidates; queries that nothing is right for are left out."
)


@dataclass(frozen=True, eq=False)
class Row:
    """Images of one variant, all or those of a camera, against the truth."""

    name: str
    run: VariantRun
    images: tuple[str, ...]  # that have a true pose
    truth: Truth

    @cached_property
    def errors(self) -> PoseErrors:
        """Images that were rejected count as infinitely wrong."""
        wanted = set(self.images)
        found = {
            o.image_id: (o.world_from_cam, o.world_from_cam_cov)
            for o in self.run.outcomes
            if isinstance(o, Localized) and o.image_id in wanted
        }
        return compare_poses(found, self.truth.poses, truth_sigmas=self.truth.sigmas, expected=self.images)

    @cached_property
    def retrieval(self) -> RetrievalQuality:
        context = self.run.context
        assert context is not None
        queries = [image for image in context.survey.epoch.images if image.image_id in set(self.images)]
        right = right_references(queries, self.truth.poses, context.survey.reference.images)
        return retrieval_quality({o.image_id: o.candidates for o in self.run.outcomes}, right)

    @property
    def curves(self) -> dict[str, CumulativeCurve]:
        """Cumulative curves of position (m) and rotation (deg)."""
        errors = self.errors.errors
        return {
            "position_m": CumulativeCurve.of([e.position_m for e in errors]),
            "rotation_deg": CumulativeCurve.of([float(np.rad2deg(e.rotation_rad)) for e in errors]),
        }


def rows_of(section: TableSection, runs: Sequence[VariantRun], file: TruthFile) -> list[Row]:
    """The rows of a table: one a variant, or one a camera of each variant and one of all cameras."""
    rows = []
    for run in runs:
        if run.context is None:
            rows.append(Row(run.variant.name, run, (), Truth({}, file.sigmas)))
            continue
        truth = file.in_world(run.context.survey.world)
        images = [image for image in run.context.survey.epoch.images if image.image_id in truth.poses]
        if section.rows == "cameras":
            rows += _camera_rows(images, run, truth, f"{run.variant.name}, " if len(runs) > 1 else "")
        else:
            rows.append(Row(run.variant.name, run, tuple(image.image_id for image in images), truth))
    return rows


def _camera_rows(images: Sequence[Image], run: VariantRun, truth: Truth, prefix: str) -> list[Row]:
    by_camera: dict[str, list[str]] = {}
    for image in images:
        by_camera.setdefault(image.camera.camera_id, []).append(image.image_id)
    rows = [Row(f"{prefix}{name}", run, tuple(ids), truth) for name, ids in sorted(by_camera.items())]
    every = tuple(image.image_id for image in images)
    return rows if len(rows) == 1 else [*rows, Row(f"{prefix}all cameras", run, every, truth)]


def table_of(section: TableSection, rows: Sequence[Row]) -> Table:
    """The table of accuracy or retrieval that a section asks for."""
    retrieval = section.columns == "retrieval"
    cells = [_retrieval(row) if retrieval else _accuracy(row) for row in rows]
    caption = " ".join(text for text in (section.caption, _RIGHT if retrieval else "") if text)
    columns = _RETRIEVAL if retrieval else _ACCURACY
    return Table(section.name, section.title, columns, tuple(cells), caption, tuple(_notes(rows, retrieval)))


def _accuracy(row: Row) -> dict[str, Cell]:
    if row.run.problem:
        return {"name": row.name}
    errors = row.errors
    count = len(errors.errors)
    localized = count - len(errors.failed)
    within = {f"within_{r.position_m:g}m_{r.rotation_deg:g}deg": _share(r) for r in errors.recall}
    share = 100.0 * localized / count if count else None
    return {
        **_named(row),
        "localized": Estimate(share, wilson_interval(localized, count)),
        **within,
        "nees_per_dof": errors.nees.mean_ratio,
    }


def _retrieval(row: Row) -> dict[str, Cell]:
    if row.run.problem:
        return {"name": row.name}
    within = {(r.position_m, r.rotation_deg): r for r in row.errors.recall}
    return {
        **_named(row),
        **{f"recall_at_{r.rank}": Estimate(r.percent, r.interval) for r in row.retrieval.recall},
        "precision": row.retrieval.precision_percent,
        **{name: _share(within[limits]) for name, limits in LEVELS.items()},
    }


def _named(row: Row) -> dict[str, Cell]:
    return {
        "name": row.name,
        "images": len(row.errors.errors),
        "median_position": _median(row.errors.position_m),
        "median_rotation": _median(row.errors.rotation_deg),
    }


def _share(recall: Recall) -> Estimate:
    return Estimate(recall.percent, recall.interval)


def _median(quantiles: ErrorQuantiles) -> Estimate:
    return Estimate(quantiles.median, quantiles.median_interval)


def _notes(rows: Sequence[Row], retrieval: bool) -> list[str]:
    notes = [f"{row.name}: not run. {row.run.problem}" for row in rows if row.run.problem]
    run = next((row for row in rows if row.run.context is not None), None)
    if not retrieval or run is None or run.run.context is None:
        return notes
    images = [image for image in run.run.context.survey.epoch.images if image.image_id in set(run.images)]
    for what, known in (("heading", "heading_rad"), ("position prior", "gnss")):
        without = sum(getattr(image, known) is None for image in images)
        if without:
            notes.append(f"{without} of {len(images)} images have no {what}: that filter leaves nothing out for them.")
    nothing = run.retrieval.without
    if nothing:
        notes.append(f"No reference is right for {len(nothing)} of the images.")
    return notes
