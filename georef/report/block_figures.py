"""Figures of a block: a plan with residual vectors and error ellipses, and vectors over the image of each camera."""

from __future__ import annotations

from typing import Any

import numpy as np
from markupsafe import Markup

from georef.report.svg import Drawing, round_down, short, ticks

_WIDTH, _HEIGHT, _MARGIN = 720.0, 520.0, 44.0
_IMAGE_WIDTH = 340.0
_LONGEST = 46.0  # of the vectors of a figure, in its units


class _Frame:
    """Metres of the plan to units of the figure, at one scale for both axes."""

    def __init__(self, places: np.ndarray) -> None:
        low, high = places.min(axis=0), places.max(axis=0)
        span = np.maximum(np.asarray(high - low), 1.0)
        wide, tall = (_WIDTH - 2 * _MARGIN) / float(span[0]), (_HEIGHT - 2 * _MARGIN) / float(span[1])
        self.scale = wide if wide < tall else tall
        self.low, self.high = low, high
        self.height = float(span[1]) * self.scale + 2 * _MARGIN

    def at(self, place: Any) -> tuple[float, float]:
        x = _MARGIN + (float(place[0]) - self.low[0]) * self.scale
        return x, self.height - _MARGIN - (float(place[1]) - self.low[1]) * self.scale


def plan_figure(plan: dict[str, Any], points: str, what: str, *, gnss: bool = False, ellipses: bool = False) -> Markup:
    """East and north of stations and points; vectors are residuals of `points` ("control", "all_control", "check"), and
    of GNSS where asked; ellipses of stations where asked. what: the figure in words."""
    stations, rows = plan["shown"], plan[points]
    places = np.array([row["position_m"][:2] for row in (*stations, *rows)])
    frame = _Frame(places)
    drawing = Drawing(_WIDTH, frame.height + 26.0, what)
    _grid(drawing, frame)
    vectors = [(row["position_m"], _horizontal(row["residual_m"])) for row in rows]
    if gnss:
        vectors = [(s["position_m"], s["gnss_residual_m"][:2]) for s in stations if s["gnss_residual_m"]]
    if ellipses:
        _ellipses(drawing, frame, stations)
    drawing.dots([frame.at(s["position_m"]) for s in stations], "stations")
    longest = max((float(np.hypot(v[0], v[1])) for _, v in vectors), default=0.0)
    factor = _LONGEST / longest if longest > 0 else 0.0
    for place, vector in vectors:
        x, y = frame.at(place)
        drawing.line((x, y), (x + factor * vector[0], y - factor * vector[1]), "fine-vector" if gnss else "vector")
    for row in rows:
        _point(drawing, frame, row, "check" if points == "check" else "control")
    if factor > 0:
        _key(drawing, frame.height + 14.0, factor, longest)
    return drawing.render()


def _point(drawing: Drawing, frame: _Frame, row: dict[str, Any], css: str) -> None:
    x, y = frame.at(row["position_m"])
    drawing.circle((x, y), 3.4, css, _title(row))
    drawing.text((x + 6.0, y + 12.0), row["point_id"], "name")


def _title(row: dict[str, Any]) -> str:
    east, north, up = ("-" if v is None else f"{100 * v:+.2f}" for v in row["residual_m"])
    return f"{row['point_id']}: E {east}, N {north}, H {up} cm"


def _horizontal(residual: list[float | None]) -> list[float]:
    return [0.0 if v is None else float(v) for v in residual[:2]]


def _grid(drawing: Drawing, frame: _Frame) -> None:
    low, high = frame.at(frame.low), frame.at(frame.high)
    drawing.rect((low[0], high[1]), (high[0] - low[0], low[1] - high[1]), "frame")
    for value in ticks(frame.low[0], frame.high[0], 6):
        x, _ = frame.at((value, frame.low[1]))
        drawing.line((x, low[1]), (x, high[1]), "grid")
        drawing.text((x, low[1] + 16.0), short(value), anchor="middle")
    for value in ticks(frame.low[1], frame.high[1], 5):
        _, y = frame.at((frame.low[0], value))
        drawing.line((low[0], y), (high[0], y), "grid")
        drawing.text((low[0] - 6.0, y + 4.0), short(value), anchor="end")


def _key(drawing: Drawing, y: float, factor: float, longest: float) -> None:
    size = round_down(longest)
    drawing.line((_MARGIN, y), (_MARGIN + factor * size, y), "vector")
    drawing.text((_MARGIN + factor * size + 8.0, y + 4.0), f"{short(1e3 * size)} mm")


def _ellipses(drawing: Drawing, frame: _Frame, stations: list[dict[str, Any]]) -> None:
    """One-sigma ellipses of the horizontal position, of every tenth station where there are many."""
    chosen = stations[:: max(len(stations) // 80, 1)]
    covs = np.array([[[s["cov_m2"][0], s["cov_m2"][1]], [s["cov_m2"][1], s["cov_m2"][2]]] for s in chosen])
    values, vectors = np.linalg.eigh(covs)
    axes = vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]
    largest = float(np.sqrt(values.max(initial=0.0)))
    if largest <= 0:
        return
    size = round_down(largest)
    factor, turn = 18.0 / size, np.linspace(0.0, 2.0 * np.pi, 25)[:-1]
    for station, axis in zip(chosen, axes, strict=True):
        x, y = frame.at(station["position_m"])
        outline = factor * (axis @ np.stack([np.cos(turn), np.sin(turn)]))
        drawing.polygon([(x + a, y - b) for a, b in outline.T], "ellipse", station["station"])
    y = frame.height + 14.0
    drawing.circle((_WIDTH - 150.0, y), 9.0, "ellipse")
    drawing.text((_WIDTH - 134.0, y + 4.0), f"radius {short(1e3 * size / 2.0)} mm, 1-sigma")


def image_figure(size_px: list[int], rows: list[list[float]], what: str) -> Markup:
    """Vectors (columns x, y, dx, dy; px) over the image of a camera."""
    scale = _IMAGE_WIDTH / size_px[0]
    height = size_px[1] * scale
    drawing = Drawing(_IMAGE_WIDTH + 12.0, height + 34.0, what)
    drawing.rect((6.0, 6.0), (_IMAGE_WIDTH, height), "frame")
    longest = max((float(np.hypot(row[2], row[3])) for row in rows), default=0.0)
    factor = 24.0 / longest if longest > 0 else 0.0
    for x, y, dx, dy, *_ in rows:
        at = 6.0 + scale * x, 6.0 + scale * y
        drawing.line(at, (at[0] + factor * dx, at[1] + factor * dy), "fine-vector")
        drawing.circle(at, 1.2, "stations")
    if factor > 0:
        size = round_down(longest)
        drawing.line((6.0, height + 22.0), (6.0 + factor * size, height + 22.0), "vector")
        drawing.text((14.0 + factor * size, height + 26.0), f"{short(size)} px")
    return drawing.render()
