"""report.html: the report as one self-contained page, rendered from report.json alone."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined, Template

from georef.report.detectable_figure import detectable_figures
from georef.report.figures import MOST_POINTS, MOST_STATIONS, plan_figures
from georef.report.page import page_values
from georef.report.residual_figure import residual_figures

_MISSING = "\N{EN DASH}"
_SPACE, _MINUS = "\N{NARROW NO-BREAK SPACE}", "\N{MINUS SIGN}"


def render_html(report: dict[str, Any]) -> str:
    """A page that needs nothing but itself: no scripts, no fonts, no network. Long tables are cut, and say so."""
    values = page_values(report)
    for kind in values["kinds"]:
        kind["plans"] = plan_figures(report["plan"], kind["name"], values["axes"])
        kind["residual_figures"] = residual_figures(kind["all_points"], values["axes"])
    stations = [] if values["kinds"] else plan_figures(report["plan"], None, values["axes"])
    detectable = detectable_figures(report.get("reliability", {}).get("groups", {}), values["axes"])
    limits = {"detectable_figures": detectable, "most_stations": MOST_STATIONS, "most_points": MOST_POINTS}
    return page_template("report.html.j2").render(report=report, stations=stations, **limits, **values)


@cache
def page_template(name: str) -> Template:
    """A page of the folder `templates`, with the filters for numbers."""
    environment = Environment(
        loader=PackageLoader("georef.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"mm": millimetres, "number": number, "whole": whole, "span": span, "signed_mm": signed_mm}
    return environment.get_template(name)


def number(value: float | None, digits: int = 1) -> str:
    """A decimal number, thousands set apart; a dash for what is unknown."""
    if value is None:
        return _MISSING
    text = f"{value:,.{digits}f}"
    if float(text.replace(",", "")) == 0:
        text = text.removeprefix("-")
    return text.replace(",", _SPACE).replace("-", _MINUS)


def whole(value: float | None) -> str:
    """A count."""
    return number(value, 0)


def millimetres(value_m: float | None, digits: int = 1) -> str:
    """Metres as millimetres."""
    return number(None if value_m is None else 1e3 * value_m, digits)


def signed_mm(value_m: float | None) -> str:
    """A residual in metres as millimetres, with its sign."""
    text = millimetres(value_m)
    return text if value_m is None or text.startswith(_MINUS) or text == "0.0" else f"+{text}"


def span(interval_m: Sequence[float | None] | None) -> str:
    """An interval in metres as millimetres."""
    if interval_m is None:
        return _MISSING
    return f"{millimetres(interval_m[0])} to {millimetres(interval_m[1])}"
