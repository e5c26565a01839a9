"""Reliability of control, automatic GCPs, pose priors and GNSS as plain values: one by one, and a group in summary."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.stats import chi2

from georef.estimation.adjustment.quality.reliability import ALPHA0, BETA0, DELTA0, Reliability
from georef.geometry.rigid import Array

UNCHECKED = 0.01
"""Redundancy number below which next to nothing checks an observation."""
AXES = ("e", "n", "h")
_WEAKEST, _IN_PLAN = 10, 2000


def reliability_rows(found: Reliability) -> list[dict[str, Any]]:
    """Of each observation, along the axes of the CRS: redundancy numbers, w, minimal detectable biases, what one of
    that size does to the adjusted position, and its joint test. None where a component has no weight or no check."""
    return [
        {
            "redundancy": _plain(found.redundancy[k]),
            "w": _plain(found.w[k]),
            "detectable_m": _plain(found.detectable[k]),
            "effect_m": _plain(found.effect[k]),
            "statistic": float(found.statistic[k]),
            "dof": int(found.dof[k]),
            "p_value": float(chi2.sf(found.statistic[k], max(int(found.dof[k]), 1))),
        }
        for k in range(len(found))
    ]


def reliability_summary(found: Reliability) -> dict[str, Any]:
    """Ranges over a group, its weakest and most suspicious members by name; of poses the positions."""
    position = slice(-3, None)
    redundancy, detectable = found.redundancy[:, position], found.detectable[:, position]
    effect, w = found.effect[:, position], found.w[:, position]
    return {
        "count": len(found),
        "alpha0": ALPHA0,
        "beta0": BETA0,
        "delta0": DELTA0,
        "redundancy": {axis: _range(redundancy[:, k]) for k, axis in enumerate(AXES)},
        "detectable_m": {axis: _range(detectable[:, k]) for k, axis in enumerate(AXES)},
        "effect_m": {axis: _range(effect[:, k]) for k, axis in enumerate(AXES)},
        "distortion": _range(found.distortion.ravel()),
        "unchecked": int((np.nan_to_num(redundancy, nan=1.0) < UNCHECKED).any(axis=1).sum()),
        "largest_w": _largest_w(found.ids, w),
        "weakest": _weakest(found, detectable),
        "in_plan": _in_plan(found, detectable),
    }


def _largest_w(ids: tuple[str, ...], w: Array) -> dict[str, Any] | None:
    size = np.abs(np.nan_to_num(w))
    row, axis = np.unravel_index(int(np.argmax(size)), size.shape)
    if size[row, axis] == 0.0:
        return None
    return {"name": ids[int(row)], "axis": AXES[int(axis)], "w": float(w[row, axis])}


def _weakest(found: Reliability, detectable: Array) -> list[dict[str, Any]]:
    """The largest detectable biases; what nothing checks first."""
    worst = np.nanmax(np.where(np.isnan(detectable), -1.0, detectable), axis=1)
    order = np.argsort(-worst, kind="stable")[:_WEAKEST]
    return [
        {"name": found.ids[k], "detectable_m": _plain(detectable[k]), "redundancy": _plain(found.redundancy[k, -3:])}
        for k in order
    ]


def _in_plan(found: Reliability, detectable: Array) -> list[dict[str, Any]]:
    """A sample for a picture: places in world and the largest detectable bias of each; None: unchecked."""
    step = 1 + (len(found) - 1) // _IN_PLAN
    worst = np.max(np.where(np.isnan(detectable), -1.0, detectable), axis=1)
    return [
        {"name": found.ids[k], "place_m": found.place[k].tolist(), "detectable_m": _value(float(worst[k]))}
        for k in range(0, len(found), step)
    ]


def _range(values: Array) -> dict[str, float | None] | None:
    """Least, median, 95 % and greatest; None in place of what nothing checks."""
    there = values[~np.isnan(values)]
    if not len(there):
        return None
    least, median, most, greatest = np.quantile(there, [0.0, 0.5, 0.95, 1.0], method="lower").tolist()
    return {"least": _value(least), "median": _value(median), "p95": _value(most), "greatest": _value(greatest)}


def _plain(row: Array) -> list[float | None]:
    return [_value(value) for value in row.tolist()]


def _value(value: float) -> float | None:
    return value if np.isfinite(value) else None
