"""Errors over the sigmas that were predicted of them, both on logarithmic axes, with the lines of a true prediction."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from georef.evaluation.curves import round_limits
from georef.report.svg import Drawing, Point, short

_SIDE, _LEFT, _RIGHT, _TOP, _BOTTOM = 380.0, 52.0, 14.0, 28.0, 44.0
_QUANTILES = (0.025, 0.5, 0.975)
_STYLE = (
    "text{font:11.5px sans-serif;fill:#5b6570}.panel{font-size:13px;font-weight:600;fill:#1c2127}"
    ".grid{stroke:#e6e9ed}.frame{fill:none;stroke:#9aa4ae}.middle{stroke:#1c2127}"
    ".limit{stroke:#1c2127;stroke-dasharray:4 4}.image{fill:#0072b2;fill-opacity:.75}"
)


@dataclass(frozen=True)
class Panel:
    """One kind of error: names, predicted sigmas (all axes together) and errors of images, in one unit."""

    title: str
    unit: str
    names: Sequence[str]
    sigmas: Sequence[float]
    errors: Sequence[float]


def reliability_figure(panels: Sequence[Panel]) -> str:
    """An SVG file. The lines are quantiles of the length of an error that is equally uncertain in three axes."""
    width = _SIDE * len(panels)
    parts = []
    for index, panel in enumerate(panels):
        drawing = _panel(panel)
        parts.append(f'<g transform="translate({_SIDE * index:g} 0)">{"".join(drawing.parts)}</g>')
    return (
        f'<svg viewBox="0 0 {width:g} {_SIDE:g}" width="{width:g}" height="{_SIDE:g}" '
        f'xmlns="http://www.w3.org/2000/svg"><style>{_STYLE}</style><rect width="100%" height="100%" fill="#fff"/>'
        f"{''.join(parts)}</svg>\n"
    )


def _panel(panel: Panel) -> Drawing:
    drawing = Drawing(_SIDE, _SIDE, f"{panel.title}: error over predicted sigma")
    low, high = _range([*panel.sigmas, *panel.errors])
    scale = (_SIDE - _LEFT - _RIGHT) / np.log10(high / low)

    def at(sigma: float, error: float) -> Point:
        x, y = (float(np.log10(np.clip(v, low, high) / low)) for v in (sigma, error))
        return _LEFT + scale * x, _SIDE - _BOTTOM - (_SIDE - _TOP - _BOTTOM) / (_SIDE - _LEFT - _RIGHT) * scale * y

    for limit in round_limits(low, high):
        (x, bottom), (left, y) = at(limit, low), at(low, limit)
        drawing.line((x, _TOP), (x, bottom), "grid")
        drawing.line((left, y), (_SIDE - _RIGHT, y), "grid")
        drawing.text((x, bottom + 15), short(limit), anchor="middle")
        drawing.text((left - 5, y + 4), short(limit), anchor="end")
    for quantile in _QUANTILES:
        factor = float(np.sqrt(chi2.ppf(quantile, 3) / 3.0))
        start, end = max(low, low / factor), min(high, high / factor)
        drawing.line(at(start, factor * start), at(end, factor * end), "middle" if quantile == 0.5 else "limit")
    for name, sigma, error in zip(panel.names, panel.sigmas, panel.errors, strict=True):
        drawing.circle(at(sigma, error), 4.0, "image", f"{name}: {error:.3g} {panel.unit}, predicted {sigma:.3g}")
    drawing.rect((_LEFT, _TOP), (_SIDE - _LEFT - _RIGHT, _SIDE - _TOP - _BOTTOM), "frame")
    drawing.text((_LEFT, 18), f"{panel.title} ({panel.unit}): error", "panel")
    drawing.text((_SIDE - _RIGHT, _SIDE - 9), "predicted sigma, all axes; lines: 2.5, 50 and 97.5 %", anchor="end")
    return drawing


def _range(values: Sequence[float]) -> tuple[float, float]:
    """Ends of an axis for positive values, with some room; at least a decade."""
    known = [value for value in values if value > 0] or [1.0]
    low, high = 0.7 * min(known), 1.4 * max(known)
    return (low, high) if high > 10.0 * low else (low, 10.0 * low)
