"""The texts of a recording: what is shown and in which colour, the headline figures, the rejected images."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from georef.report.wording import BRIEF, REASONS
from georef.types.results import Rejected

_MOST_REJECTED = 500


def summary_text(title: str, report: Mapping[str, Any], legend: Sequence[tuple[str, str]]) -> str:
    """Markdown: headline figures, and what each entity shows."""
    images = report["images"]
    lines = [
        f"# {title}",
        "",
        f"{images['localized']} of {images['total']} images localized, {images['rejected']} rejected.",
        "",
        *[_kind_text(kind, summary) for kind, summary in report["check_points"]["by_kind"].items()],
        "",
        "Positions are metres in the project's topocentric frame (x east, y north, z up), not grid coordinates. "
        "Residuals are estimated minus reference.",
        "",
        "| Entity | Shows |",
        "|---|---|",
        *[f"| {entity} | {what} |" for entity, what in legend],
    ]
    return "\n".join(lines)


def rejected_text(rejected: Sequence[Rejected]) -> str:
    """Markdown: every image without a pose, and why."""
    if not rejected:
        return "# Rejected images\n\nNone: every image has a pose."
    rows = [f"| {r.image_id} | {REASONS.get(r.reason.value, r.reason.value)} | {r.detail} |" for r in rejected]
    more = [f"\n{len(rows) - _MOST_REJECTED} more are in report.json."] if len(rows) > _MOST_REJECTED else []
    head = ["# Rejected images", "", "| Image | Reason | Detail |", "|---|---|---|"]
    return "\n".join([*head, *rows[:_MOST_REJECTED], *more])


def _kind_text(kind: str, summary: Mapping[str, Any]) -> str:
    if not summary["count"]:
        return f"- No {kind} check point could be determined."
    values = [f"{name} {1e3 * summary[f'rmse_{key}_m']:.1f}" for name, key in zip("ENH", "enh", strict=True)]
    return (
        f"- **{summary['count']} {kind} check points**: RMSE {', '.join(values)}, "
        f"**3D {1e3 * summary['rmse_3d_m']:.1f} mm**. {BRIEF[kind]}"
    )
