"""report.html of a block: variance components, control, GNSS, calibrations and figures, from report.json alone."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from markupsafe import Markup

from georef.report.block_figures import image_figure, plan_figure
from georef.report.html import number, page_template

_AXES = ("E", "N", "H")


def render_block(report: dict[str, Any]) -> str:
    """A page that needs nothing but itself: no scripts, no fonts, no network."""
    template = page_template("block.html.j2")
    variants = [{"title": title, **_variant(variant)} for title, variant in report["variants"].items()]
    return template.render(
        report=report, variants=variants, plans=_plans(report), images=_images(report), lenses=_lenses(report)
    )


def _variant(variant: dict[str, Any]) -> dict[str, Any]:
    """Numbers of a solution as texts of table cells."""
    return {
        **variant,
        "rows": [
            [
                row["point_id"],
                *_cells(row["residual_m"], 1e3, 1),
                *_cells(row["redundancy"], 1.0, 2),
                *_cells(row["w"], 1.0, 1),
                *_cells(row["detectable_m"], 1e3, 0),
            ]
            for row in variant["control_points"]
        ],
        "component_rows": [
            [
                name,
                number(part["observations"], 0),
                number(part["redundancy"], 1),
                number(part["factor"], 2),
                number(part["factor_sigma"], 2),
            ]
            for name, part in variant["components"].items()
        ],
        "unknown_rows": [
            [u["name"], _significant(u["value"], u["sigma"]), f"{u['sigma']:.2g}", u["unit"]]
            for u in variant["shared_unknowns"]
        ],
        "check_rows": [
            [
                row["point_id"],
                *_cells([row["de_m"], row["dn_m"], row["dh_m"]], 1e3, 1),
                *_cells(row["predicted_sigma_m"], 1e3, 1),
                number(row["nees"], 1),
                str(row["mark_count"]),
            ]
            for row in variant["check_points"]
        ],
    }


def _cells(values: Sequence[float | None] | None, factor: float, digits: int) -> list[str]:
    return [number(None if v is None else factor * v, digits) for v in values or (None,) * 3]


def _significant(value: float, sigma: float) -> str:
    """To two digits of its sigma."""
    if not sigma > 0:
        return f"{value:.6g}"
    digits = 0
    while digits < 12 and 10.0**-digits > 0.1 * sigma:
        digits += 1
    return f"{value:.{digits}f}"


def _plans(report: dict[str, Any]) -> list[dict[str, Any]]:
    plan = report["figures"]["plan"]
    out = []
    titles = {
        "control": "Residuals of control, horizontally, as declared",
        "check": "Check points, horizontally, as declared",
        "all_control": "Residuals with all surveyed points as control",
    }
    for key, title in titles.items():
        if plan[key]:
            out.append({"title": title, "figure": plan_figure(plan, key, title)})
    if any(s["gnss_residual_m"] for s in plan["shown"]):
        title = "Residuals of GNSS, horizontally, offsets taken off"
        out.append({"title": title, "figure": plan_figure(plan, "control", title, gnss=True)})
    title = "Error ellipses of the exposures"
    out.append({"title": title, "figure": plan_figure({**plan, "control": []}, "control", title, ellipses=True)})
    return out


def _images(report: dict[str, Any]) -> list[dict[str, str | Markup]]:
    return [
        {"title": f"{i['camera']}: mean residuals", "figure": image_figure(i["size_px"], i["cells"], i["camera"])}
        for i in report["figures"]["images"]
    ]


def _lenses(report: dict[str, Any]) -> list[dict[str, Any]]:
    return [
        {
            **c,
            "figure": image_figure(c["size_px"], c["map_px"], f"{c['camera']} less {c['program']}"),
            "rows": [
                [
                    p["name"],
                    _significant(p["value"], p["sigma"] or 0.0),
                    "" if p["sigma"] is None else f"{p['sigma']:.2g}",
                    _significant(p["other"], p["sigma"] or 0.0),
                ]
                for p in c["parameters"]
            ],
        }
        for c in report.get("comparisons", [])
    ]
