"""Before an adjustment starts: do two sources agree on where the block is, and if not, what is wrong?

Map (localized poses), GNSS and surveyed control each say where the same things are. Paired positions are compared,
robustly, and what separates them is named with its size and sigma, and with a remedy: heights of another kind, swapped
or reversed axes, feet, a wrong zone or false origin, an antenna offset (a constant in the vehicle's frame), a constant
shift in the world, a turn, a scale. What this drive cannot tell apart is said, and so is what it would not have shown.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from georef.estimation.datum.fine import Explained, explain
from georef.estimation.datum.gross import Gross, free_similarity, gross_relation, stands_still
from georef.estimation.datum.types import Finding, Paired
from georef.estimation.datum.wording import (
    blind_to,
    far_finding,
    gross_finding,
    height_finding,
    level_finding,
    unrelated_finding,
)
from georef.geometry.rigid import Array

__all__ = ["DatumReport", "Finding", "Paired", "compare_datums"]

_FEWEST = 4
_FAR_M = 20_000.0  # shifts beyond are those of zones and false origins
_LARGEST_TURN = 0.01  # rad, or part of one


@dataclass(frozen=True, eq=False)
class DatumReport:
    """What separates two sources; no findings: nothing that their noise does not explain.

    blind_to: faults that these positions would not show, in plain words. outliers: share of the pairs that follow
    nothing that was found.
    """

    pairs: int
    findings: tuple[Finding, ...]
    blind_to: tuple[str, ...]
    outliers: float

    @property
    def text(self) -> tuple[str, ...]:
        """All of it as lines."""
        lines = [line for f in self.findings for line in (f.text, *f.alternatives, f.remedy)]
        return (*lines, *(f"These positions would not show {what}." for what in self.blind_to))


def compare_datums(paired: Paired) -> DatumReport:
    """Findings on what separates the second source from the first."""
    n = len(paired.first)
    if n < _FEWEST:
        return DatumReport(n, (), (f"anything: there are {n} pairs, and {_FEWEST} are needed",), 0.0)
    sigma = np.sqrt(np.mean(np.square(paired.sigma_m[:, :2]), axis=1))
    fixed = gross_relation(paired.first[:, :2], paired.second[:, :2], sigma)
    level = _level(paired, fixed, sigma)
    findings = [] if level.finding is None else [level.finding]
    height = gross_relation(paired.first[:, 2:], paired.second[:, 2:], paired.sigma_m[:, 2])
    if not level.elsewhere:  # heights of another place mean nothing here
        findings += _heights(paired, height, level.inlier)
    still = stands_still(paired.first[:, :2], sigma)
    blind = blind_to(fixed, height, still=still, no_heading=paired.heading_rad is None)
    return DatumReport(n, tuple(findings), blind, 1.0 - float(level.inlier.mean()))


@dataclass(frozen=True, eq=False)
class _Level:
    """What was found of easting and northing. inlier (N,): pairs that follow it."""

    finding: Finding | None
    inlier: NDArray[np.bool_]
    elsewhere: bool = False


def _level(paired: Paired, fixed: Gross | None, sigma: Array) -> _Level:
    """A fixed map that is not the same; else small differences; else a frame that is turned, scaled or far away."""
    if fixed is not None and not fixed.same:
        return _Level(gross_finding(paired, fixed, sigma), fixed.inlier)
    if fixed is not None and _far(fixed):
        return _Level(far_finding(paired, fixed), fixed.inlier, elsewhere=True)
    small = explain(paired.second[:, :2] - paired.first[:, :2], sigma, paired.shared, _level_parts(paired))
    if small is not None and not _large(small):
        found = small.explanations
        return _Level(level_finding(paired, found) if found else None, small.inlier)
    free = free_similarity(paired.first[:, :2], paired.second[:, :2], sigma)
    if free is None:
        nothing = unrelated_finding(paired.first_name, paired.second_name, "easting and northing")
        return _Level(nothing, np.zeros(len(sigma), bool), elsewhere=True)
    if _far(free):
        return _Level(far_finding(paired, free), free.inlier, elsewhere=True)
    return _Level(gross_finding(paired, free, sigma), free.inlier)


def _far(gross: Gross) -> bool:
    return float(np.linalg.norm(gross.shift)) > _FAR_M


def _large(small: Explained) -> bool:
    """Whether a turn or scale is too large to be taken as a small one."""
    values = [
        abs(float(e.values[part][0])) for e in small.explanations[:1] for part in ("turn", "scale") if part in e.values
    ]
    return max(values, default=0.0) > _LARGEST_TURN


def _level_parts(paired: Paired) -> dict[str, Array]:
    """Derivatives (N, 2, q) of level differences by each part of an explanation."""
    n, flat = len(paired.first), paired.first[:, :2]
    parts = {"shift": np.tile(np.eye(2), (n, 1, 1))}
    if paired.heading_rad is not None:
        s, c = np.sin(paired.heading_rad), np.cos(paired.heading_rad)
        parts["antenna"] = np.stack([np.stack([c, s], axis=1), np.stack([-s, c], axis=1)], axis=1)  # right, forward
    centred = flat - np.median(flat, axis=0)
    turn = np.stack([-centred[:, 1], centred[:, 0]], axis=1)[:, :, None]
    parts["turn"] = np.concatenate([turn, parts["shift"]], axis=2)  # about a point that is not known: a shift as well
    parts["scale"] = np.concatenate([centred[:, :, None], parts["shift"]], axis=2)
    return parts


def _heights(paired: Paired, height: Gross | None, inlier: NDArray[np.bool_]) -> list[Finding]:
    """Of the pairs whose easting and northing agree."""
    if height is not None and not height.same:
        return [gross_finding(paired, height, paired.sigma_m[:, 2], heights=True)]
    difference, sigma = (paired.second[:, 2:] - paired.first[:, 2:])[inlier], paired.sigma_m[inlier, 2]
    above = paired.first[inlier, 2:] - np.median(paired.first[inlier, 2])
    found = explain(
        difference, sigma, paired.shared, {"shift": np.ones((len(sigma), 1, 1)), "scale": above[:, :, None]}
    )
    if found is None:
        return [unrelated_finding(paired.first_name, paired.second_name, "heights")]
    return [height_finding(paired, found.explanations)] if found.explanations else []
