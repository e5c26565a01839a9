"""adjustment.txt: what a bundle adjustment is asked for, as lines of plain text, made from report.json alone."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from georef.report.wording import GROUPS, attention

_NAMED = 20


def render_text(report: dict[str, Any]) -> str:
    """The adjustment of an epoch: redundancy, variance components, control, reliability, rejections, warnings."""
    axes = ("X", "Y", "Z") if report["crs"]["kind"] == "geocentric" else ("E", "N", "H")
    parts = (
        _head(report),
        _components(report),
        _control(report, axes),
        _groups(report, axes),
        _rejected(report),
        _shared(report),
        _warnings(report),
    )
    return "\n".join(line for part in parts for line in part) + "\n"


def _head(report: dict[str, Any]) -> Iterator[str]:
    yield f"Adjustment of {report['project']}, epoch {report['epoch']} (georef {report['georef_version']})"
    adjustment, redundancy = report["adjustment"], report["reliability"].get("redundancy")
    if redundancy is None:
        yield "No image was localized: nothing was adjusted."
        return
    state = "converged" if adjustment["converged"] else "NOT CONVERGED"
    scale = adjustment["image_sigma_scale"]
    yield f"{adjustment['iterations']} iterations, {state}; image sigmas scaled by {scale:.3f}"
    yield (
        f"{redundancy['observations']} observations, {redundancy['unknowns']} unknowns, redundancy "
        f"{redundancy['redundancy']:.0f}, sigma0 {_number(redundancy['sigma0'], 3)}"
    )


def _components(report: dict[str, Any]) -> Iterator[str]:
    if not report["variance_components"]:
        return
    yield ""
    yield f"{'Variance components':<52}{'obs.':>10}{'redundancy':>13}{'factor':>9}{'+-':>8}"
    for key, component in report["variance_components"].items():
        yield (
            f"{GROUPS.get(key, key):<52}{component['observations']:>10}{component['redundancy']:>13.1f}"
            f"{_number(component['factor'], 3):>9}{_number(component['factor_sigma'], 3):>8}"
        )


def _control(report: dict[str, Any], axes: Sequence[str]) -> Iterator[str]:
    points = [p for p in report["control_points"]["points"] if "w" in p]
    if not points:
        return
    yield ""
    yield "Surveyed control (mm; r: redundancy number, w: Baarda's test, MDB: minimal detectable bias, effect of one)"
    yield f"{'point':<16}{'axis':>4}{'residual':>10}{'sigma':>8}{'r':>7}{'w':>8}{'MDB':>9}{'effect':>9}"
    for point in points:
        for k, axis in enumerate(axes):
            if point["sigma_m"][k] is not None:
                yield (
                    f"{point['point'] if axis == axes[0] else '':<16}{axis:>4}{_mm(point['residual_m'][k]):>10}"
                    f"{_mm(point['sigma_m'][k]):>8}{_number(point['redundancy'][k]):>7}{_number(point['w'][k]):>8}"
                    f"{_mm(point['detectable_m'][k]):>9}{_mm(point['effect_m'][k]):>9}"
                )


def _groups(report: dict[str, Any], axes: Sequence[str]) -> Iterator[str]:
    groups = report["reliability"].get("groups", {})
    if not groups:
        return
    yield ""
    yield "Reliability (mm; - : nothing checks it)"
    yield f"{'':<52}{'axis':>4}{'r median':>10}{'least':>7}{'MDB median':>12}{'95 %':>9}{'largest':>9}{'effect':>9}"
    for key, group in groups.items():
        for k, axis in enumerate(("e", "n", "h")):
            redundancy, bias, effect = (group[part][axis] for part in ("redundancy", "detectable_m", "effect_m"))
            if redundancy is not None:
                title = f"{GROUPS.get(key, key)}, {group['count']}" if k == 0 else ""
                yield (
                    f"{title:<52}{axes[k]:>4}{_number(redundancy['median']):>10}{_number(redundancy['least']):>7}"
                    f"{_mm(bias['median']):>12}{_mm(bias['p95']):>9}{_mm(bias['greatest']):>9}"
                    f"{_mm(effect['median']):>9}"
                )
        weakest = ", ".join(member["name"] for member in group["weakest"][:5])
        yield f"  least reliable: {weakest}; not checked: {group['unchecked']}"


def _rejected(report: dict[str, Any]) -> Iterator[str]:
    dropped = report["gates"].get("image_observations", {})
    rejected = report["reliability"].get("rejected_constraints", [])
    if not dropped and not rejected:
        return
    yield ""
    if dropped:
        yield f"Rejected: {dropped['rejected']} of {dropped['tested']} image observations, and"
    for one in rejected[:_NAMED]:
        yield f"  {GROUPS.get(one['kind'], one['kind'])} {one['name']}: {one['statistic']:.1f}, dof {one['dof']}"
    if len(rejected) > _NAMED:
        yield f"  and {len(rejected) - _NAMED} more in report.json, all in adjustment_rejected.csv"
    if not rejected:
        yield "  no constraint"


def _shared(report: dict[str, Any]) -> Iterator[str]:
    section = report["reliability"]
    if section.get("shared_unknowns"):
        yield ""
        yield "Shared unknowns"
    for unknown in section.get("shared_unknowns", []):
        yield f"  {unknown['name']:<52}{unknown['value']:>14.6g} +- {unknown['sigma']:.2g} {unknown['unit']}".rstrip()
    for pair in section.get("correlations", []):
        yield f"  correlation {pair['value']:+.4f}: {pair['first']} with {pair['second']}"


def _warnings(report: dict[str, Any]) -> Iterator[str]:
    lines = attention(report)
    if lines:
        yield ""
        yield "Attention"
        yield from (f"  {line}" for line in lines)


def _number(value: float | None, digits: int = 2) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def _mm(value_m: float | None) -> str:
    return "-" if value_m is None else f"{1e3 * value_m:.1f}"
