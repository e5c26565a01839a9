"""evaluation.html: the tables and curves of an evaluation as one self-contained page, from evaluation.json alone."""

from __future__ import annotations

from typing import Any

from georef.evaluation.curves import POSITION_RANGE_M, ROTATION_RANGE_DEG
from georef.report.curve_figure import MOST_CURVES, Axis, curve_figure, legend, standalone
from georef.report.html import page_template

AXES = {
    "position_m": Axis(*POSITION_RANGE_M, "position error (m)"),
    "rotation_deg": Axis(*ROTATION_RANGE_DEG, "rotation error (deg)"),
}


def render_evaluation(evaluation: dict[str, Any]) -> str:
    """A page that needs nothing but itself: no scripts, no fonts, no network."""
    figures = {
        name: {
            "panels": [curve_figure(_of(curves, key), axis).render() for key, axis in AXES.items()],
            "legend": legend(list(curves)),
            "left_out": max(0, len(curves) - MOST_CURVES),
        }
        for name, curves in evaluation["curves"].items()
        if curves
    }
    return page_template("evaluation.html.j2").render(evaluation=evaluation, figures=figures)


def curve_pictures(evaluation: dict[str, Any]) -> dict[str, str]:
    """SVG files by their names without suffix, two for each table that has curves."""
    return {
        f"{table}-{key.split('_')[0]}": standalone(curve_figure(_of(curves, key), axis), list(curves))
        for table, curves in evaluation["curves"].items()
        for key, axis in AXES.items()
        if curves
    }


def _of(curves: dict[str, Any], key: str) -> dict[str, Any]:
    return {name: curve[key] for name, curve in curves.items()}
