"""Tests of groups of observations of a block against everything else, and how much each is checked.

The statistic of a group is r' Qvv^- r with Qvv = S - A Qxx A' and the rank of Qvv as degrees of freedom; its redundancy
is the trace of Qvv P. Redundancies of all observations add up to the number of observations less that of unknowns.
Baarda, "A testing procedure for use in geodetic networks" (1968); Foerstner, "Reliability analysis of parameter
estimation in linear models" (1987).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from georef.estimation.adjustment.block import KINDS_OF_POINT, KINDS_OF_POSE, Block, Indices, State
from georef.estimation.adjustment.equations.cofactors import Cofactors
from georef.estimation.adjustment.equations.constraint_terms import (
    POSE_PRIORS,
    POSITION_PRIORS,
    Term,
    constraint_terms,
    dense_columns,
    root,
)
from georef.estimation.adjustment.equations.eliminate import IMAGE_OBSERVATIONS, GivenPoints
from georef.estimation.adjustment.equations.prepared import Prepared, placed
from georef.estimation.adjustment.kernels.inverse import (
    RANK_TOLERANCE,
    Inverse,
    Tested,
    scratch_for,
    test_observations,
)
from georef.estimation.adjustment.quality.components import Component
from georef.estimation.adjustment.quality.reference_part import ReferencePart
from georef.geometry.rigid import Array

MEASURED = (POSE_PRIORS, POSITION_PRIORS)
"""Kinds that say where stations are, which automatic GCPs say as well, with the errors of their references."""


@dataclass(frozen=True, eq=False)
class ImageTests:
    """Tests of all image observations (n,), in the block's order, and the cofactors of its points."""

    statistic: Array  # (n,) NaN where no lens shows the point
    dof: NDArray[np.int8]  # (n,) 0: nothing checks it; -1: no lens shows the point
    redundancy: Array  # (n,)
    points: Array  # (P, 3, 3) NaN: rays leave a direction open, or nothing observes the point

    def rejected(self, probability: float, scale: float = 1.0) -> NDArray[np.bool_]:
        """Which fail at a probability that good ones pass, sigmas being `scale` times the stated ones. What no lens
        shows, fails."""
        limit = chi2.ppf(probability, np.array([1, 1, 2])) * scale**2
        return (self.dof < 0) | (self.statistic > limit[np.maximum(self.dof, 0)])

    @property
    def scale(self) -> float:
        """How large residuals are against their sigmas, by the median: wrong ones do not count."""
        median = chi2.ppf(0.5, np.array([1, 1, 2]))
        checked = self.dof > 0
        if not checked.any():
            return 1.0
        return float(np.sqrt(max(np.median(self.statistic[checked] / median[self.dof[checked]]), 1e-12)))


def image_tests(block: Block, state: State, found: Cofactors, prepared: Prepared | None = None) -> ImageTests:
    """Tests every image observation with the cofactors of its point, its stations and all that they share."""
    prepared = prepared or Prepared.of(block)
    count, layout = len(block.observations), found.layout
    tested = Tested(
        np.zeros(count), np.zeros(count, np.int8), np.zeros(count), np.full((len(block.points), 3, 3), np.nan)
    )
    inverse = Inverse(
        *(found.first, found.column, found.pair),
        *(found.station_border.reshape(layout.stations, 6, layout.border), found.border),
    )
    given = GivenPoints.at(block, state.points, {})
    longest = int(np.diff(prepared.tracks.start).max(initial=0))
    test_observations(
        *(prepared.tracks, prepared.images, placed(state), state.points, given.information, given.shift),
        *(inverse, tested, prepared.work(), scratch_for(longest, layout.border)),
    )
    back = np.empty_like(prepared.order)
    back[prepared.order] = np.arange(count)
    return ImageTests(tested.statistic[back], tested.rank[back], tested.redundancy[back], tested.point)


@dataclass(frozen=True, eq=False)
class TermTests:
    """Tests of K constraints of one kind, whitened residuals (K, m); what weights leave free counts for nothing."""

    name: str
    row: Indices  # (K,) place in its list of the block
    residual: Array  # (K, m)
    cofactor: Array  # (K, m, m) Qvv, whitened
    weighted: NDArray[np.bool_]  # (K, m) which have a weight
    statistic: Array  # (K,)
    dof: NDArray[np.int64]  # (K,)

    @property
    def redundancy(self) -> Array:
        """(K,)"""
        return np.trace(self.cofactor, axis1=1, axis2=2)

    def rejected(self, probability: float) -> NDArray[np.bool_]:
        """Which (K,) fail at a probability that good ones pass."""
        return self.statistic > chi2.ppf(probability, np.maximum(self.dof, 1))

    @staticmethod
    def of(
        name: str,
        row: Indices,
        residual: Array,
        fitted: Array,
        weighted: NDArray[np.bool_],
        shared: Array | float = 0.0,
    ) -> TermTests:
        """fitted: A Q A' (K, m, m), whitened; weighted (K, m): rows that have a weight; shared (K, m, m): what the
        fitted values may be off by beside that, for the statistic alone."""
        both = weighted[:, :, None] & weighted[:, None, :]
        cofactor = np.where(both, np.eye(residual.shape[1]) - fitted, 0.0)
        statistic, dof = group_statistics(residual, cofactor + np.where(both, shared, 0.0))
        return TermTests(name, row, residual, cofactor, weighted, statistic, dof)


def constraint_tests(
    block: Block, state: State, found: Cofactors, points: Array, references: ReferencePart | None = None
) -> list[TermTests]:
    """Tests every constraint of a block singly, pose priors and given points by their kind. points: cofactors
    (P, 3, 3) of `image_tests`; references: what the errors of the references move, which constraints of stations may
    differ by as well."""
    tests: list[TermTests] = []
    for term in constraint_terms(block, state, found.layout):
        whole = _term_tests(term, found, references)
        kinds = block.pose_priors.kind[term.row] if term.name == POSE_PRIORS else None
        tests += [whole] if kinds is None else _by_kind(whole, kinds, KINDS_OF_POSE)
    priors = block.point_priors
    if len(priors):
        weight = root(priors.information)
        off = np.einsum("kij,kj->ki", weight, state.points[priors.point] - priors.position)
        fitted = weight @ points[priors.point] @ np.swapaxes(weight, 1, 2)
        weighted = np.any(weight != 0.0, axis=2)
        shared = np.zeros_like(fitted)
        control = np.flatnonzero(priors.kind == KINDS_OF_POINT.index("control"))
        if references is not None and len(control):
            turned = np.swapaxes(weight[control], 1, 2)
            shared[control] = weight[control] @ references.of_given_points(block, state, control) @ turned
        whole = TermTests.of("points", np.arange(len(priors)), off, np.nan_to_num(fitted), weighted, shared)
        tests += _by_kind(whole, priors.kind, KINDS_OF_POINT)
    return tests


def _by_kind(whole: TermTests, kind: Indices, names: tuple[str, ...]) -> list[TermTests]:
    chosen = [(name, np.flatnonzero(kind == index)) for index, name in enumerate(names)]
    return [
        TermTests(
            *(name, whole.row[k], whole.residual[k], whole.cofactor[k], whole.weighted[k]),
            *(whole.statistic[k], whole.dof[k]),
        )
        for name, k in chosen
        if len(k)
    ]


def _term_tests(term: Term, found: Cofactors, references: ReferencePart | None) -> TermTests:
    weighted = np.zeros(term.residual.shape, bool)
    for first, by in term.columns:
        weighted |= np.any(by != 0.0, axis=2) & (first >= 0)[:, None]
    shared = references.of_rows(term.columns, term.residual.shape[1]) if references and term.name in MEASURED else 0.0
    return TermTests.of(term.name, term.row, term.residual, fitted_cofactor(term, found), weighted, shared)


def fitted_cofactor(term: Term, found: Cofactors) -> Array:
    """A Q A' (K, m, m), whitened, of each constraint."""
    fitted = np.zeros((*term.residual.shape, term.residual.shape[1]))
    for first, by in term.columns:
        for other, other_by in term.columns:
            between = found.between(first, by.shape[2], other, other_by.shape[2])
            fitted += by @ between @ np.swapaxes(other_by, 1, 2)
    return fitted


def group_statistics(residual: Array, cofactor: Array) -> tuple[Array, NDArray[np.int64]]:
    """r' Q^- r (K,) of whitened residuals (K, m) and cofactors (K, m, m), and the ranks (K,)."""
    values, vectors = np.linalg.eigh(cofactor)
    usable = values > RANK_TOLERANCE
    along = np.einsum("kmi,km->ki", vectors, residual)
    statistic = np.where(usable, np.square(along) / np.where(usable, values, 1.0), 0.0).sum(axis=1)
    return statistic, usable.sum(axis=1)


def joint_test(terms: list[tuple[Term, Indices]], found: Cofactors) -> tuple[float, int]:
    """Statistic and degrees of freedom of constraints tested as one group: the given rows (places in the term's
    arrays) of each term."""
    residual, design = [], []
    for term, rows in terms:
        residual.append(term.residual[rows].ravel())
        design.append(dense_columns(term.columns, rows, term.residual.shape[1], found.layout.size))
    whole = np.concatenate(design, axis=1)
    cofactor = np.eye(whole.shape[1]) - whole.T @ found.apply(whole)
    statistic, dof = group_statistics(np.concatenate(residual)[None], cofactor[None])
    return float(statistic[0]), int(dof[0])


def components(block: Block, state: State, images: ImageTests, tests: list[TermTests]) -> dict[str, Component]:
    """Variance components of image observations and of each kind of constraint that is there."""
    groups: dict[str, Component] = {}
    if len(block.observations):
        shown = images.dof >= 0
        obs = block.observations.take(shown)
        off = (block.views(state).project(obs.view, state.points[obs.point]) - obs.pixel) / obs.sigma_px[:, None]
        squares = float(np.sum(np.square(off)))
        groups[IMAGE_OBSERVATIONS] = Component(2 * len(obs), float(images.redundancy[shown].sum()), squares)
    for test in tests:
        here = groups.get(test.name, Component(0, 0.0, 0.0))
        groups[test.name] = Component(
            here.observations + int(test.weighted.sum()),
            here.redundancy + float(cast(float, test.redundancy.sum())),
            here.squares + float(np.sum(np.square(test.residual))),
        )
    return groups
