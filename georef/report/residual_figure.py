"""Residuals of check points against the sigmas that were predicted for them, one panel an axis."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from markupsafe import Markup

from georef.geometry.rigid import Array
from georef.report.svg import Drawing, short, ticks

_WIDTH, _HEIGHT, _LEFT, _RIGHT, _TOP, _BOTTOM = 340.0, 250.0, 44.0, 8.0, 26.0, 34.0
_MOST_STEPS = 120
_KEYS = ("de_m", "dn_m", "dh_m")


def residual_figures(points: Sequence[dict[str, Any]], axes: Sequence[str]) -> list[Markup]:
    """One panel for each axis, all at one scale: dots are residuals, the bands +-1 and +-2 predicted sigmas.

    Points stand in the order of their predicted sigma. No panels without predicted sigmas.
    """
    usable = [p for p in points if p["predicted_sigma_m"] is not None and None not in p["predicted_sigma_m"]]
    if not usable:
        return []
    residuals = 1e3 * np.array([[p[key] for key in _KEYS] for p in usable], dtype=float)
    sigmas = 1e3 * np.array([p["predicted_sigma_m"] for p in usable], dtype=float)
    limit = 1.08 * max(float(np.abs(residuals).max()), float(np.quantile(2.0 * sigmas, 0.9)))
    return [_panel(residuals[:, i], sigmas[:, i], limit, axis) for i, axis in enumerate(axes)]


def _panel(residual: Array, sigma: Array, limit: float, axis: str) -> Markup:
    order = np.argsort(-sigma, kind="stable")
    residual, sigma = residual[order], sigma[order]
    drawing = Drawing(_WIDTH, _HEIGHT, f"d{axis} residuals against predicted sigmas")
    width, height = _WIDTH - _LEFT - _RIGHT, _HEIGHT - _TOP - _BOTTOM
    x = _LEFT + width * (np.arange(len(residual)) + 0.5) / len(residual)
    step = 0.5 * width / len(residual)

    def y(value: float) -> float:
        return _TOP + 0.5 * height * (1.0 - float(np.clip(value / limit, -1.0, 1.0)))

    shown = np.unique(np.linspace(0, len(x) - 1, _MOST_STEPS).astype(int))  # of the bands, which fall steadily
    edges = np.append(x[shown] - step, _WIDTH - _RIGHT)
    for times, css in ((2.0, "band-2"), (1.0, "band-1")):
        steps = [(float(e), times * v) for i, v in enumerate(sigma[shown]) for e in edges[i : i + 2]]
        drawing.polygon([*[(e, y(v)) for e, v in steps], *[(e, y(-v)) for e, v in reversed(steps)]], css)
    for value in ticks(-limit, limit, 5):
        drawing.line((_LEFT, y(value)), (_WIDTH - _RIGHT, y(value)), "zero" if value == 0 else "grid")
        drawing.text((_LEFT - 5, y(value) + 4), short(value), anchor="end")
    drawing.dots(
        [(float(xi), y(v)) for xi, v in zip(x, residual, strict=True)], "dots" if len(x) <= 150 else "dots fine"
    )
    drawing.rect((_LEFT, _TOP), (width, height), "frame")
    drawing.text((_LEFT, 17), f"d{axis} (mm)", "panel")
    inside = int(np.sum(np.abs(residual) <= sigma))
    drawing.text((_WIDTH - _RIGHT, 17), f"{inside} of {len(x)} within \N{PLUS-MINUS SIGN}1 sigma", anchor="end")
    drawing.text((_LEFT, _HEIGHT - 14), "large predicted sigma")
    drawing.text((_WIDTH - _RIGHT, _HEIGHT - 14), "small", anchor="end")
    return drawing.render()
