"""Shared unknowns of a solution with their sigmas, and which of them the observations can hardly tell apart."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from georef.estimation.adjustment.block import Block
from georef.estimation.adjustment.block_check import BlockCheck
from georef.estimation.adjustment.block_solutions import Solved
from georef.estimation.adjustment.reduced import Layout
from georef.geometry.rigid import Array

STRONG = 0.9
_EAST_NORTH_UP = ("east", "north", "up")


@dataclass(frozen=True)
class SharedUnknown:
    """An unknown of the border: its value and 1-sigma in its own unit (px, m, rad, or none)."""

    name: str
    value: float
    sigma: float
    unit: str


@dataclass(frozen=True)
class Correlation:
    first: str
    second: str
    value: float


def shared_unknowns(solved: Solved) -> list[SharedUnknown]:
    """Calibrations, lever arms and GNSS offsets that are estimated."""
    sigmas = np.sqrt(np.diag(solved.cofactors.border))
    return [
        SharedUnknown(name, value, float(sigmas[at]) * per_step, unit)
        for at, name, value, per_step, unit in _entries(solved)
    ]


def strong_correlations(solved: Solved, least: float = STRONG) -> list[Correlation]:
    """Pairs of shared unknowns, and focal lengths with the height of the ground, that correlate strongly."""
    entries = list(_entries(solved))
    rows = [at for at, *_ in entries]
    names = [name for _, name, *_ in entries]
    cov = solved.cofactors.border[np.ix_(rows, rows)]
    sigma = np.sqrt(np.diag(cov))
    values = cov / np.outer(sigma, sigma) if rows else cov
    pairs = [
        Correlation(names[i], names[j], float(values[i, j]))
        for i in range(len(names))
        for j in range(i + 1, len(names))
        if abs(values[i, j]) >= least
    ]
    height = ground_height_correlations(solved.block, solved.check, solved.cofactors.border)
    return pairs + [c for c in height if abs(c.value) >= least]


def ground_height_correlations(block: Block, check: BlockCheck, border: Array) -> list[Correlation]:
    """How the mean height of the points that were intersected moves with each estimated focal length.

    At one flying height over flat ground the two trade off: a longer focal length and a lower ground look the same.
    """
    points = check.solved.shape[1] // 3
    if not points:
        return []
    up = np.zeros(3 * points)
    up[2::3] = 1.0 / points
    variance = float(up @ (check.by_unknowns @ check.solved) @ up)
    edge = check.solved.shape[0] - len(border)
    out = []
    for at, name in _focal_lengths(block):
        covariance = float(check.solved[edge + at] @ up)
        out.append(Correlation(name, "mean height of the ground", covariance / np.sqrt(variance * border[at, at])))
    return out


def _focal_lengths(block: Block) -> list[tuple[int, str]]:
    layout = Layout.of(block)
    return [
        (int(at) + c.camera.estimate.index("focal"), f"{c.camera.camera_id} focal")
        for at, c in zip(layout.calibration, block.calibrations, strict=True)
        if at >= 0 and "focal" in c.camera.estimate
    ]


def _entries(solved: Solved) -> list[tuple[int, str, float, float, str]]:
    """Place in the border, name, value, what a step changes the value by, unit; mountings and kept points left out."""
    layout, state = solved.cofactors.layout, solved.solution.state
    out: list[tuple[int, str, float, float, str]] = []
    for at, camera in zip(layout.calibration, state.cameras, strict=True):
        for k, name in enumerate(camera.estimate if at >= 0 else ()):
            unit = "px" if name in ("focal", "cx", "cy") else ""
            out.append((int(at) + k, f"{camera.camera_id} {name}", camera.value(name), camera.unit(name), unit))
    groups = (
        ("lever arm", layout.antenna, state.lever_arms_m, ("x", "y", "z")),
        ("GNSS offset", layout.drift, state.drift_m, _EAST_NORTH_UP),
    )
    for what, starts, values, axes in groups:
        for at, row in zip(starts, values, strict=True):
            if at >= 0:
                out += [(int(at) + k, f"{what} {axis}", float(row[k]), 1.0, "m") for k, axis in enumerate(axes)]
    return out
