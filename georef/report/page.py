"""report.json arranged as the page shows it: rows of tables, sorted and cut, beside the words for them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from georef.report.wording import BRIEF, GROUPS, MEANING, REASONS, attention, component_reading, nees_verdict

MOST_ROWS = 400
_MOST_REJECTED = 15  # of a group
_STAGES = {
    "features": "Features",
    "network": "Reference network",
    "localize": "Localization",
    "stations": "Stations and sequences",
    "adjust": "Adjustment",
    "report": "Report",
}
_MEASURES = ("rmse_{}_m", "rmse_{}_interval_95_m")


def page_values(report: dict[str, Any]) -> dict[str, Any]:
    """What the template needs beside the report itself."""
    axes = ("X", "Y", "Z") if report["crs"]["kind"] == "geocentric" else ("E", "N", "H")
    images = _images(report["images"]["by_image"])
    return {
        "axes": axes,
        "kinds": [_kind(name, report, axes) for name in ("absolute", "relative") if _has(report, name)],
        "attention": attention(report),
        "images": images[:MOST_ROWS],
        "images_cut": max(0, len(images) - MOST_ROWS),
        "adjusted": [i for i in images if i.get("adjustment")][:MOST_ROWS],
        "gnss_rms_m": _gnss_rms(images),
        "gates": [{"name": GROUPS.get(key, key), **gate} for key, gate in report["gates"].items() if gate["tested"]],
        "components": [
            {"name": GROUPS.get(key, key), "reading": component_reading(c), **c}
            for key, c in report["variance_components"].items()
        ],
        "reliability": _reliability(report.get("reliability", {})),
        "timings": _timings(report["timings"]),
        "settings": _flat(report["config"]),
    }


def _has(report: dict[str, Any], kind: str) -> bool:
    return kind in report["check_points"]["by_kind"]


def _kind(name: str, report: dict[str, Any], axes: tuple[str, str, str]) -> dict[str, Any]:
    after, before = report["check_points"], report["check_points_after_pnp"]
    summary = after["by_kind"][name]
    points = _by_error([p for p in after["points"] if p["kind"] == name])
    pnp = {p["point_id"]: p["distance_m"] for p in before["points"] if p["kind"] == name}
    estimated = summary.get("nees_with_estimated_mark_sigma")
    return {
        "name": name,
        "meaning": MEANING[name],
        "brief": BRIEF[name],
        "summary": summary,
        "measures": _measures(summary, before["by_kind"].get(name), axes),
        "verdict": nees_verdict(summary["nees"]),
        "estimated_verdict": None if estimated is None else nees_verdict(estimated),
        "all_points": points,
        "points": points[:MOST_ROWS],
        "points_cut": max(0, len(points) - MOST_ROWS),
        "after_pnp_m": pnp,
        "not_determined": [entry for entry in after["not_determined"] if entry["kind"] == name],
    }


def _by_error(points: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Largest 3D error first, each with its share of the largest in percent."""
    lengths = [p["distance_m"] or 0.0 for p in points]
    largest = max(lengths, default=0.0) or 1.0
    rows = [{**p, "share": round(100 * length / largest, 1)} for p, length in zip(points, lengths, strict=True)]
    return sorted(rows, key=lambda p: -p["share"])


def _measures(after: dict[str, Any], before: dict[str, Any] | None, axes: tuple[str, str, str]) -> list[dict[str, Any]]:
    """RMSE, bias and spread of each axis, horizontal and 3D; after the adjustment and after PnP."""
    names = {axes[0]: "e", axes[1]: "n", axes[2]: "h", "horizontal": "horizontal", "3D": "3d"}
    rows = []
    for index, (title, key) in enumerate(names.items()):
        value, interval = (text.format(key) for text in _MEASURES)
        rows.append(
            {
                "title": title,
                "after": after[value],
                "interval": after[interval],
                "mean": _item(after["mean_m"], index),
                "std": _item(after["std_m"], index),
                "before": None if before is None else before[value],
                "before_interval": None if before is None else before[interval],
            }
        )
    return rows


def _item(values: list[float | None] | None, index: int) -> float | None:
    return values[index] if values is not None and index < len(values) else None


def _images(by_image: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Rejected images first, else as they come, so that none is lost where the table is cut."""
    rows = [{**i, "reason_text": REASONS.get(i["reason"], "")} if i["status"] == "rejected" else i for i in by_image]
    return sorted(rows, key=lambda i: i["status"] != "rejected")


def _gnss_rms(images: list[dict[str, Any]]) -> list[float] | None:
    found = [i["adjustment"]["gnss_residual_m"] for i in images if (i.get("adjustment") or {}).get("gnss_residual_m")]
    return np.sqrt(np.square(np.array(found)).mean(axis=0)).tolist() if found else None


def _reliability(section: Mapping[str, Any]) -> dict[str, Any]:
    """Groups with their names in words; what failed its test with the name of its group."""
    groups = [
        {"key": key, "name": GROUPS.get(key, key), **group, "ranges": _ranges(group)}
        for key, group in section.get("groups", {}).items()
    ]
    listed = section.get("rejected_constraints", ())
    kinds = dict.fromkeys(one["kind"] for one in listed)
    rejected = [one for kind in kinds for one in [r for r in listed if r["kind"] == kind][:_MOST_REJECTED]]
    return {
        "groups": groups,
        "rejected": [{**one, "group": GROUPS.get(one["kind"], one["kind"])} for one in rejected],
        "redundancy": section.get("redundancy"),
        "shared": section.get("shared_unknowns", [])[:MOST_ROWS],
        "correlations": section.get("correlations", []),
        "correlations_in_all": section.get("correlations_in_all", 0),
    }


def _ranges(group: Mapping[str, Any]) -> list[dict[str, Any]]:
    """One row an axis: median and worst redundancy number, median and largest detectable bias and its effect."""
    return [
        {
            "axis": index,
            "redundancy": group["redundancy"][axis],
            "detectable": group["detectable_m"][axis],
            "effect": group["effect_m"][axis],
        }
        for index, axis in enumerate(("e", "n", "h"))
        if group["redundancy"][axis] is not None
    ]


def _timings(timings: Mapping[str, dict[str, Any]]) -> list[dict[str, Any]]:
    rows = [{"name": _STAGES.get(key, key), **value} for key, value in timings.items()]
    if not rows:
        return []
    total = {key: sum(row[key] for row in rows) for key in ("cpu_s", "wall_s")}
    return [*rows, {"name": "Together", **total, "peak_memory_mb": max(row["peak_memory_mb"] for row in rows)}]


def _flat(config: Mapping[str, Any], prefix: str = "") -> list[tuple[str, Any]]:
    out: list[tuple[str, Any]] = []
    for key, value in config.items():
        if isinstance(value, Mapping) and value:
            out += _flat(value, f"{prefix}{key}.")
        else:
            out.append((prefix + key, value))
    return out
