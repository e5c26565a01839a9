"""What the figures of a block are drawn from, as plain values: where everything lies, and residuals over the images."""

from __future__ import annotations

from typing import Any

import numpy as np

from georef.estimation.adjustment.equations.constraint_terms import drift_at
from georef.estimation.adjustment.measured.solutions import Solved, residuals_px
from georef.geometry.rigid import Array
from georef.stages.block_survey import BlockSurvey

MOST_STATIONS = 1500
_ACROSS = 12  # cells over the width of an image


def picture_numbers(survey: BlockSurvey, declared: Solved, every: Solved | None) -> dict[str, Any]:
    """plan: stations with residuals of GNSS and covariances, points of the declared solution and with all control.

    images: mean residuals in cells of the image plane of each camera.
    """
    return {"plan": _plan(survey, declared, every), "images": image_residuals(declared)}


def _plan(survey: BlockSurvey, declared: Solved, every: Solved | None) -> dict[str, Any]:
    state, block = declared.solution.state, declared.block
    count = len(block.station_ids)
    shown = np.unique(np.linspace(0, count - 1, min(count, MOST_STATIONS)).astype(np.int64))
    rotation = state.world_from_rig.rotation[shown]
    covs = rotation @ declared.cofactors.stations[shown][:, 3:, 3:] @ np.swapaxes(rotation, 1, 2)
    off = _gnss_residuals(declared)
    places, given = state.world_from_rig.translation, {p.point_id: p.point_in_world for p in survey.surveyed}
    return {
        "stations": count,
        "shown": [
            {
                "station": block.station_ids[i],
                "position_m": _short(places[i]),
                "cov_m2": [float(covs[k, 0, 0]), float(covs[k, 0, 1]), float(covs[k, 1, 1])],
                "sigma_up_m": float(np.sqrt(covs[k, 2, 2])),
                "gnss_residual_m": _short(off[i]) if i in off else None,
            }
            for k, i in enumerate(shown.tolist())
        ],
        "control": _control(declared),
        "all_control": [] if every is None else _control(every),
        "check": [
            {"point_id": e.point_id, "position_m": _short(given[e.point_id]), "residual_m": _short(e.difference_m)}
            for e in declared.check.errors.determined
        ],
    }


def _control(found: Solved) -> list[dict[str, Any]]:
    priors, points = found.block.point_priors, found.solution.state.points
    known = np.abs(np.diagonal(priors.information, axis1=1, axis2=2)) > 0.0
    return [
        {
            "point_id": name,
            "position_m": _short(priors.position[k]),
            "residual_m": [float(v) if there else None for v, there in zip(row, known[k], strict=True)],
        }
        for k, (name, row) in enumerate(zip(priors.point_ids, points[priors.point] - priors.position, strict=True))
    ]


def _gnss_residuals(found: Solved) -> dict[int, Array]:
    """Adjusted less measured position (3,) by station, the drift taken off."""
    priors, state = found.block.position_priors, found.solution.state
    if not len(priors):
        return {}
    antenna = state.world_from_rig.take(priors.station).apply(state.lever_arms_m[priors.antenna])
    if len(state.drift_m):
        node, weight = drift_at(found.block)
        antenna = antenna + np.einsum("kn,kni->ki", weight, state.drift_m[node])
    return dict(zip(priors.station.tolist(), antenna - priors.position, strict=True))


def image_residuals(found: Solved) -> list[dict[str, Any]]:
    """Of each camera the mean residual of tie points, projected less measured, in square cells of its image: columns
    x, y (centre), mean x, mean y, root mean square (px), and their number."""
    obs, block = found.block.observations, found.block
    off = residuals_px(block, found.solution.state, obs)
    out: list[dict[str, Any]] = []
    for index, calibration in enumerate(block.calibrations):
        camera = calibration.camera
        here = np.flatnonzero((block.calibration[obs.view] == index) & np.isfinite(off).all(axis=1))
        side = camera.width / _ACROSS
        columns, rows = _ACROSS, max(int(np.ceil(camera.height / side)), 1)
        cell = np.clip((obs.pixel[here] / side).astype(np.int64), 0, [columns - 1, rows - 1])
        number = cell[:, 1] * columns + cell[:, 0]
        count = np.bincount(number, minlength=columns * rows)
        sums = [
            np.bincount(number, weights=v, minlength=columns * rows) for v in (*off[here].T, (off[here] ** 2).sum(1))
        ]
        seen = np.flatnonzero(count)
        x, y, square = (total[seen] / count[seen] for total in sums)
        centre = (np.stack(np.divmod(seen, columns)[::-1], axis=1) + 0.5) * side
        table = np.column_stack([centre, x, y, np.sqrt(square), count[seen]])
        out.append(
            {
                "camera": camera.camera_id,
                "size_px": [camera.width, camera.height],
                "cell_px": side,
                "cells": table.round(4).tolist(),
            }
        )
    return out


def _short(values: Array) -> list[float]:
    return [round(float(v), 5) for v in values]
