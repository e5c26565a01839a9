"""Where an error would stay unseen: minimal detectable biases of a group of constraints in plan."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from markupsafe import Markup

from georef.report.figures import Plan, map_axes
from georef.report.svg import Drawing, round_down, round_up, short
from georef.report.wording import GROUPS

_LARGEST, _SMALLEST = 9.0, 0.8  # radius of a disc in figure units
_FEWEST, _ALIKE = 4, 1.1
_STEPS = 5  # sizes of discs, so that thousands are a few elements


def detectable_figures(groups: Mapping[str, Any], axes: Sequence[str]) -> list[Markup]:
    """One plan for each group whose members differ."""
    shown = {key: group["in_plan"] for key, group in groups.items() if _worth_showing(group["in_plan"])}
    return [_figure(GROUPS.get(key, key), members, axes) for key, members in shown.items()]


def _worth_showing(members: Sequence[Mapping[str, Any]]) -> bool:
    values = [member["detectable_m"] for member in members]
    known = [value for value in values if value is not None]
    return len(members) >= _FEWEST and (len(known) < len(values) or max(known) > _ALIKE * min(known))


def _figure(name: str, members: Sequence[Mapping[str, Any]], axes: Sequence[str]) -> Markup:
    frame = Plan.around(np.array([member["position_m"][:2] for member in members]))
    drawing = Drawing(520.0, 84.0 + float(frame.size[1]), f"{name}: minimal detectable bias in plan")
    map_axes(drawing, frame, axes)
    checked = [member for member in members if member["detectable_m"] is not None]
    full = _full(np.array([member["detectable_m"] for member in checked]))
    sizes = np.linspace(_SMALLEST, _LARGEST, _STEPS)
    for radius in sizes:
        here = [m for m in checked if _radius(m["detectable_m"], full, sizes) == radius]
        for member in here:
            title = f"{member['name']}: {1e3 * member['detectable_m']:.1f} mm"
            drawing.circle(frame.at(member["position_m"]), float(radius), "detectable", title)
    for member in members:
        if member["detectable_m"] is None:
            drawing.circle(frame.at(member["position_m"]), 2.5, "unchecked", f"{member['name']}: not checked")
    _legend(drawing, name, full)
    return drawing.render()


def _full(values: np.ndarray) -> float:
    """The bias of the largest disc: a round number near what 98 % stay below."""
    return round_up(float(np.quantile(values, 0.98))) if len(values) else 1.0


def _radius(value: float, full: float, sizes: np.ndarray) -> float:
    return float(sizes[round((_STEPS - 1) * min(1.0, value / full))])


def _legend(drawing: Drawing, name: str, full: float) -> None:
    y = drawing.height - 14.0
    drawing.text((66.0, y), name, "name")
    for k, part in enumerate((0.25, 1.0)):
        x = 330.0 + 95.0 * k
        value = round_down(part * full) if part < 1.0 else full
        drawing.circle((x, y - 4.0), _radius(value, full, np.linspace(_SMALLEST, _LARGEST, _STEPS)), "detectable")
        drawing.text((x + 14.0, y), f"{short(1e3 * value)} mm")
