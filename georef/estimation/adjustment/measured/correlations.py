"""What of a solution the observations can hardly tell apart, the ground that was intersected included."""

from __future__ import annotations

import numpy as np

from georef.estimation.adjustment.block import Block
from georef.estimation.adjustment.equations.reduced import Layout
from georef.estimation.adjustment.measured.check import BlockCheck
from georef.estimation.adjustment.measured.solutions import Solved
from georef.estimation.adjustment.quality.correlations import (
    STRONG,
    Correlation,
    SharedUnknown,
    shared_unknowns,
    strong_correlations,
)
from georef.geometry.rigid import Array


def unknowns_of(solved: Solved) -> list[SharedUnknown]:
    """Shared unknowns with their sigmas."""
    return shared_unknowns(solved.block, solved.solution.state, solved.cofactors)


def correlations_of(solved: Solved, least: float = STRONG) -> list[Correlation]:
    """Those of shared unknowns with each other and with all stations, and of focal lengths with the height of the
    ground, that correlate by `least` or more."""
    height = ground_height_correlations(solved.block, solved.check, solved.cofactors.border)
    pairs = strong_correlations(solved.block, solved.solution.state, solved.cofactors, least)
    return [c for c in height if abs(c.value) >= least] + pairs


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
        (int(at) + c.camera.estimate.index("focal"), f"focal of {c.camera.camera_id}")
        for at, c in zip(layout.calibration, block.calibrations, strict=True)
        if at >= 0 and "focal" in c.camera.estimate
    ]
