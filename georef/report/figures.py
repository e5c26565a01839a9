"""The figures of the report: a plan with horizontal residuals, one with height residuals, residuals against sigmas."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from markupsafe import Markup

from georef.geometry.rigid import Array
from georef.report.svg import Drawing, Point, round_down, short, ticks

_WIDTH, _LEFT, _RIGHT, _TOP, _BOTTOM = 520.0, 66.0, 12.0, 10.0, 64.0
_LEAST_EXTENT_M, _MARGIN = 2.0, 0.13
_LONGEST_VECTOR = 0.11  # of the width of the plan, for the vector at the 95th percentile
_NAMED_CAMERAS, _NAMED_POINTS, MOST_STATIONS, MOST_POINTS = 24, 5, 300, 400


@dataclass(frozen=True, eq=False)
class Plan:
    """The frame of a map: data metres to figure units, both axes at one scale."""

    low: Array  # (2,) data coordinates of the lower left corner
    scale: float  # figure units a metre
    size: Array  # (2,) of the map in figure units

    @staticmethod
    def around(points: Array) -> Plan:
        low, high = points.min(axis=0), points.max(axis=0)
        extent = np.maximum(high - low, _LEAST_EXTENT_M)
        middle = 0.5 * (low + high)
        extent = extent * (1 + 2 * _MARGIN)
        width = _WIDTH - _LEFT - _RIGHT
        ratio = float(np.clip(extent[1] / extent[0], 0.55, 1.25))
        size = np.array([width, width * ratio])
        scale = float(np.min(size / extent))
        return Plan(middle - 0.5 * size / scale, scale, size)

    @property
    def high(self) -> Array:
        return self.low + self.size / self.scale

    def at(self, position: Sequence[float] | Array) -> Point:
        """Where a position (E, N, ...) lies in the figure."""
        x, y = (np.asarray(position[:2], dtype=float) - self.low) * self.scale
        return _LEFT + float(x), _TOP + float(self.size[1] - y)


def plan_figures(plan: dict[str, Any], kind: str | None, axes: Sequence[str]) -> list[Markup]:
    """The plan with horizontal residuals of one kind of check point and, where there are any, one with their heights.

    kind None: stations alone.
    """
    plan = {**plan, "new": _evenly(plan["new"], MOST_STATIONS)}
    stations = [*plan["new"], *plan["reference"]]
    check = [p for p in plan["check"] if kind is not None and p["kind"] == kind]
    everything = [e["position_m"][:2] for e in [*stations, *check, *plan["control"]]]
    if not everything:
        return []
    frame = Plan.around(np.array(everything))
    with_residual = sorted(
        (p for p in check if p["residual_m"] is not None), key=lambda p: -float(np.linalg.norm(p["residual_m"]))
    )[:MOST_POINTS]
    figures = [_plan_figure(plan, check, with_residual, frame, axes, height=False)]
    if with_residual:
        figures.append(_plan_figure(plan, check, with_residual, frame, axes, height=True))
    return figures


def _plan_figure(
    plan: dict[str, Any],
    check: list[dict],
    with_residual: list[dict],
    frame: Plan,
    axes: Sequence[str],
    *,
    height: bool,
) -> Markup:
    what = f"{axes[2]} residuals" if height else "Plan with residual vectors" if with_residual else "Plan of stations"
    drawing = Drawing(_WIDTH, _TOP + float(frame.size[1]) + _BOTTOM, what)
    map_axes(drawing, frame, axes)
    _stations(drawing, plan["new"], [] if height else plan["reference"], frame, named=not height)
    for point in plan["control"]:
        x, y = frame.at(point["position_m"])
        drawing.polygon([(x - 5, y + 4), (x + 5, y + 4), (x, y - 5)], "control", f"control point {point['point_id']}")
    for point in check:
        if point["residual_m"] is None:
            drawing.circle(frame.at(point["position_m"]), 3, "missing", f"{point['point_id']}: not determined")
    factor = _residuals(drawing, with_residual, frame, height=height)
    _scale_bars(drawing, frame, factor, with_residual, height=height)
    return drawing.render()


def map_axes(drawing: Drawing, frame: Plan, axes: Sequence[str]) -> None:
    """Grid, ticks and names of the axes of a plan."""
    bottom = _TOP + float(frame.size[1])
    for value in ticks(frame.low[0], frame.high[0], 4):
        x, _ = frame.at([value, frame.low[1]])
        drawing.line((x, _TOP), (x, bottom), "grid")
        drawing.text((x, bottom + 14), short(value), anchor="middle")
    for value in ticks(frame.low[1], frame.high[1], 5):
        _, y = frame.at([frame.low[0], value])
        drawing.line((_LEFT, y), (_WIDTH - _RIGHT, y), "grid")
        drawing.text((_LEFT - 5, y + 4), short(value), anchor="end")
    drawing.rect((_LEFT, _TOP), (float(frame.size[0]), float(frame.size[1])), "frame")
    drawing.text((_WIDTH - _RIGHT, bottom + 29), f"{axes[0]} (m)", anchor="end")
    drawing.text((_LEFT + 6, _TOP + 15), f"{axes[1]} (m)")


def _evenly(entries: list[dict], most: int) -> list[dict]:
    return [entries[i] for i in np.linspace(0, len(entries) - 1, most).astype(int)] if len(entries) > most else entries


def _stations(drawing: Drawing, new: list[dict], reference: list[dict], frame: Plan, *, named: bool) -> None:
    for station in reference:
        _camera(drawing, station, frame, "reference", 9.0)
    for station in new:
        _camera(drawing, station, frame, "new", 17.0)
        if named and len(new) <= _NAMED_CAMERAS:
            _camera_name(drawing, station, frame)


def _camera(drawing: Drawing, station: dict[str, Any], frame: Plan, css: str, length: float) -> None:
    """A wedge that opens where the camera looks; a dot where it looks up or down."""
    x, y = frame.at(station["position_m"])
    ahead = np.array(station["direction"][:2]) * [1.0, -1.0]
    norm = float(np.linalg.norm(ahead))
    if norm < 0.3:
        drawing.circle((x, y), 0.3 * length, css, station["image"])
        return
    ahead = ahead / norm * length
    side = 0.45 * np.array([-ahead[1], ahead[0]])
    left, right = ahead + side, ahead - side
    drawing.polygon([(x, y), (x + left[0], y + left[1]), (x + right[0], y + right[1])], css, station["image"])
    drawing.circle((x, y), 0.13 * length, f"{css}-station")


def _camera_name(drawing: Drawing, station: dict[str, Any], frame: Plan) -> None:
    """Behind the camera, where neither its wedge nor mostly what it sees lies."""
    x, y = frame.at(station["position_m"])
    east, north = station["direction"][:2]
    anchor = "end" if east > 0.35 else "start" if east < -0.35 else "middle"
    shift = -5.0 if anchor == "end" else 5.0 if anchor == "start" else 0.0
    drawing.text((x + shift, y + 4.0 + 9.0 * north), station["image"].rsplit(".", 1)[0], "name new-name", anchor)


def _residuals(drawing: Drawing, points: list[dict], frame: Plan, *, height: bool) -> float:
    """Residual vectors, or height residuals as bars; returns figure units a metre of residual."""
    if not points:
        return 0.0
    vectors = np.array([p["residual_m"] for p in points])
    lengths = np.abs(vectors[:, 2]) if height else np.linalg.norm(vectors[:, :2], axis=1)
    longest = float(np.quantile(lengths, 0.95)) or float(lengths.max()) or 1.0
    factor = frame.scale * round_down(_LONGEST_VECTOR * float(frame.size[0]) / longest / frame.scale)
    for point, vector in zip(points, vectors, strict=True):
        x, y = frame.at(point["position_m"])
        if height:
            drawing.line((x, y), (x, y - factor * vector[2]), "up" if vector[2] >= 0 else "down")
        else:
            drawing.line((x, y), (x + factor * vector[0], y - factor * vector[1]), "vector")
        drawing.circle((x, y), 2.2, "check", _tooltip(point))
    for index in np.argsort(-lengths, kind="stable")[:_NAMED_POINTS]:
        x, y = frame.at(points[index]["position_m"])
        below = vectors[index, 2 if height else 1] > 0
        drawing.text((x, y + (14.0 if below else -6.0)), points[index]["point_id"], "name", "middle")
    return factor


def _tooltip(point: dict[str, Any]) -> str:
    return f"{point['point_id']}: " + ", ".join(f"{1e3 * v:+.1f}" for v in point["residual_m"]) + " mm"


def _scale_bars(drawing: Drawing, frame: Plan, factor: float, points: list[dict], *, height: bool) -> None:
    y = drawing.height - 8
    ground = round_down(0.2 * float(frame.size[0]) / frame.scale)
    _bar(drawing, (_LEFT, y), ground * frame.scale, f"{short(ground)} m on the ground", "ground-bar")
    if points:
        residual = round_down(0.2 * float(frame.size[0]) / factor)
        text = f"{short(1e3 * residual)} mm residual (\N{MULTIPLICATION SIGN}{short(factor / frame.scale)})"
        middle = (_LEFT + 0.5 * float(frame.size[0]), y)
        _bar(drawing, middle, residual * factor, text, "up" if height else "vector")


def _bar(drawing: Drawing, at: Point, length: float, text: str, css: str) -> None:
    x, y = at
    drawing.line((x, y), (x + length, y), css)
    for end in (x, x + length):
        drawing.line((end, y - 3), (end, y + 3), css)
    drawing.text((x, y - 6), text)
