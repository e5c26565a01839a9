"""Cumulative curves of errors on a logarithmic axis, one colour and dash a variant."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

import numpy as np
from markupsafe import Markup

from georef.evaluation.curves import round_limits
from georef.report.svg import Drawing, Point, short

_WIDTH, _HEIGHT, _LEFT, _RIGHT, _TOP, _BOTTOM = 520.0, 330.0, 44.0, 12.0, 26.0, 46.0
COLORS = ("#0072b2", "#d55e00", "#009e73", "#7b3294", "#b8860b", "#56b4e9", "#c51b7d", "#333333")
_DASHES = ("", "7 3", "2 3", "9 3 2 3")
MOST_CURVES = len(COLORS) * len(_DASHES)


@dataclass(frozen=True)
class Axis:
    """A logarithmic axis of errors: its ends, and the factor and unit that its labels are shown in."""

    low: float
    high: float
    title: str

    def at(self, value: float) -> float:
        share = np.log10(max(value, 1e-12) / self.low) / np.log10(self.high / self.low)
        return _LEFT + (_WIDTH - _LEFT - _RIGHT) * float(np.clip(share, 0.0, 1.0))


def curve_figure(curves: Mapping[str, Mapping[str, Any]], axis: Axis) -> Drawing:
    """Curves by name, each with `errors` (rising, in the axis' unit) and `percent`; at most MOST_CURVES of them."""
    drawing = Drawing(_WIDTH, _HEIGHT, f"Share of images within an error: {axis.title}")
    _grid(drawing, axis)
    for index, curve in enumerate(list(curves.values())[:MOST_CURVES]):
        path = _steps(curve["errors"], curve["percent"], axis)
        points = " ".join(f"{x:.1f},{y:.1f}" for x, y in path)
        drawing.parts.append(f'<polyline fill="none" {stroke(index)} points="{points}"/>')
    drawing.rect((_LEFT, _TOP), (_WIDTH - _LEFT - _RIGHT, _HEIGHT - _TOP - _BOTTOM), "frame")
    drawing.text((_LEFT, 17), "images within (%)", "panel")
    drawing.text((_WIDTH - _RIGHT, _HEIGHT - 10), axis.title, anchor="end")
    return drawing


def stroke(index: int) -> str:
    """Attributes of the line of a curve."""
    dash = _DASHES[index // len(COLORS) % len(_DASHES)]
    dashed = f' stroke-dasharray="{dash}"' if dash else ""
    return f'stroke="{COLORS[index % len(COLORS)]}" stroke-width="2"{dashed}'


def legend(names: Sequence[str]) -> Markup:
    """The names of curves, each behind a piece of its line."""
    items = (
        f'<span class="entry"><svg viewBox="0 0 26 10" width="26" height="10" aria-hidden="true">'
        f'<line x1="0" y1="5" x2="26" y2="5" {stroke(index)}/></svg> {escape(name)}</span>'
        for index, name in enumerate(names[:MOST_CURVES])
    )
    return Markup(" ".join(items))


def standalone(drawing: Drawing, names: Sequence[str]) -> str:
    """The figure as a file of its own: with its styles, and the names of the curves below it."""
    shown = names[:MOST_CURVES]
    height = _HEIGHT + 18.0 * len(shown) + 6.0
    style = (
        "text{font:11.5px sans-serif;fill:#5b6570}.panel{font-size:13px;font-weight:600;fill:#1c2127}"
        ".grid{stroke:#e6e9ed}.frame{fill:none;stroke:#9aa4ae}"
    )
    lines = []
    for index, name in enumerate(shown):
        y = _HEIGHT + 18.0 * index
        lines.append(f'<line x1="{_LEFT}" y1="{y}" x2="{_LEFT + 26}" y2="{y}" {stroke(index)}/>')
        lines.append(f'<text x="{_LEFT + 34}" y="{y + 4}">{escape(name)}</text>')
    head = f'<svg viewBox="0 0 {_WIDTH:g} {height:g}" width="{_WIDTH:g}" height="{height:g}"'
    body = "".join([*drawing.parts, *lines])
    return (
        f'{head} xmlns="http://www.w3.org/2000/svg"><style>{style}</style>'
        f'<rect width="100%" height="100%" fill="#fff"/>{body}</svg>\n'
    )


def _grid(drawing: Drawing, axis: Axis) -> None:
    bottom = _HEIGHT - _BOTTOM
    for limit in round_limits(axis.low, axis.high):
        x = axis.at(limit)
        drawing.line((x, _TOP), (x, bottom), "grid")
        drawing.text((x, bottom + 15), short(limit), anchor="middle")
    for percent in range(0, 101, 20):
        drawing.line((_LEFT, _y(percent)), (_WIDTH - _RIGHT, _y(percent)), "grid")
        drawing.text((_LEFT - 5, _y(percent) + 4), str(percent), anchor="end")


def _steps(errors: Sequence[float], percent: Sequence[float], axis: Axis) -> list[Point]:
    """The corners of the staircase inside the axis."""
    points: list[Point] = []
    level = 0.0
    start = [p for e, p in zip(errors, percent, strict=True) if e <= axis.low]
    level = start[-1] if start else 0.0
    points.append((axis.at(axis.low), _y(level)))
    for error, after in zip(errors, percent, strict=True):
        if axis.low < error <= axis.high:
            points += [(axis.at(error), _y(level)), (axis.at(error), _y(after))]
            level = after
    return [*points, (axis.at(axis.high), _y(level))]


def _y(percent: float) -> float:
    return _TOP + (_HEIGHT - _TOP - _BOTTOM) * (1.0 - percent / 100.0)
