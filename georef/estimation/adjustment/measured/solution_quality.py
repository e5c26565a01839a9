"""The geodetic quality of a solution in numbers: variance components, control point by point, GNSS as a whole."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from georef.estimation.adjustment.block import Indices
from georef.estimation.adjustment.equations.constraint_terms import POSITION_PRIORS
from georef.estimation.adjustment.equations.eliminate import IMAGE_OBSERVATIONS
from georef.estimation.adjustment.measured.solutions import Solved, residuals_px
from georef.estimation.adjustment.quality.components import Component
from georef.estimation.adjustment.quality.group_tests import TermTests
from georef.estimation.adjustment.quality.reliability import Reliability, reliability
from georef.geometry.rigid import Array

TIE_POINTS, MARKS, CONTROL = "tie points", "marks of control", "control"


@dataclass(frozen=True, eq=False)
class Given:
    """How well K given coordinates are checked: reliability by coordinate (east, north, up), and their joint tests."""

    coordinates: Reliability
    statistic: Array  # (K,)
    dof: Indices  # (K,)


@dataclass(frozen=True)
class Positions:
    """K GNSS positions as a whole; redundancy numbers and biases by coordinate (east, north, up).

    largest_w: of all, and whose it is; detectable_m: smallest, median and largest minimal detectable bias.
    """

    count: int
    residual_rms_m: tuple[float, float, float]
    redundancy_median: tuple[float, float, float]
    largest_w: float
    largest_w_of: str
    detectable_m: tuple[tuple[float, float, float], ...]  # (3) of smallest, median, largest


def variance_components(found: Solved) -> dict[str, Component]:
    """By group; image observations apart by tie points and marks of control."""
    groups = dict(found.quality.components)
    if IMAGE_OBSERVATIONS not in groups:
        return groups
    del groups[IMAGE_OBSERVATIONS]
    obs, images = found.block.observations, found.quality.images
    off = residuals_px(found.block, found.solution.state, obs) / obs.sigma_px[:, None]
    squares = np.sum(np.square(off), axis=1)
    of_control = np.zeros(len(found.block.points), bool)
    of_control[found.block.point_priors.point] = True
    shown, mark = images.dof >= 0, of_control[obs.point]
    for name, here in ((TIE_POINTS, shown & ~mark), (MARKS, shown & mark)):
        if here.any():
            part = Component(2 * int(here.sum()), float(images.redundancy[here].sum()), float(squares[here].sum()))
            groups = {name: part, **groups}
    return groups


def control_quality(found: Solved) -> Given | None:
    """Of the control points that took part; None without any."""
    return _given(found, CONTROL)


def position_quality(found: Solved) -> Positions | None:
    """Of the GNSS positions that took part; None without any."""
    given = _given(found, POSITION_PRIORS)
    if given is None:
        return None
    table = given.coordinates
    w = np.abs(np.nan_to_num(table.w))
    worst = int(np.argmax(w.max(axis=1)))
    finite = np.where(np.isfinite(table.detectable), table.detectable, np.nan)
    return Positions(
        len(table.ids),
        _three(np.sqrt(np.mean(np.square(table.residual), axis=0))),
        _three(np.median(table.redundancy, axis=0)),
        float(w.max()),
        table.ids[worst],
        tuple(_three(pick(finite, axis=0)) for pick in (np.nanmin, np.nanmedian, np.nanmax)),
    )


def _given(found: Solved, name: str) -> Given | None:
    test: TermTests | None = next((t for t in found.quality.constraints if t.name == name), None)
    if test is None or not len(test.row):
        return None
    return Given(reliability(found.block, found.solution.state, test), test.statistic, test.dof)


def _three(values: Array) -> tuple[float, float, float]:
    east, north, up = (float(v) for v in values)
    return east, north, up
