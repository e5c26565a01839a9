"""Normal equations of a block at a state: points eliminated one by one, constraints added, losses as weights."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import cast

import numpy as np
from numpy.typing import NDArray

from georef.estimation.adjustment.block import KINDS_OF_POINT, Block, Indices, State
from georef.estimation.adjustment.equations.constraint_terms import Term, constraint_terms, root
from georef.estimation.adjustment.equations.prepared import Prepared, placed
from georef.estimation.adjustment.equations.reduced import Layout, Reduced
from georef.estimation.adjustment.kernels.batches import Back, Work
from georef.estimation.adjustment.kernels.elimination import Sums, eliminate_points
from georef.estimation.adjustment.kernels.moves import all_cost
from georef.geometry.rigid import Array

IMAGE_OBSERVATIONS = "image observations"
Losses = Mapping[str, float]
"""Scale in sigmas of the Cauchy loss of each group that has one: IMAGE_OBSERVATIONS, a kind of constraint_terms, or one
of KINDS_OF_POINT. It applies to the norm of an observation's whitened residual."""


@dataclass(frozen=True, eq=False)
class Linearized:
    """Normal equations at a state and what else one pass over the observations tells.

    diagonal: of the normal matrix of stations and border before elimination, which damping goes by. cost: half the sum
    of squared whitened residuals, losses applied. hidden: image observations whose point the lens does not show, which
    take no part. undetermined: points that their rays leave free in some direction; held there. gain: by how much the
    cost of the linear model, damping of points included, falls if stations and border stay and points alone move.
    """

    reduced: Reduced
    diagonal: Array  # (6 S + B,)
    cost: float
    hidden: int
    undetermined: int
    gain: float


@dataclass(frozen=True, eq=False)
class GivenPoints:
    """Point priors as kernels take them, their loss applied at a state."""

    information: Array  # (K, 3, 3)
    shift: Array  # (K, 3) information times position
    square: Array  # (K,) squared whitened residuals, no loss

    @staticmethod
    def at(block: Block, points: Array, losses: Losses) -> GivenPoints:
        priors = block.point_priors
        square = given_squares(block, points)
        weight = robust_weight(square, _point_scales(block, losses))
        information = np.ascontiguousarray(priors.information * weight[:, None, None])
        return GivenPoints(information, np.einsum("kij,kj->ki", information, priors.position), square)


def normal_equations(
    block: Block,
    state: State,
    *,
    losses: Losses | None = None,
    damping: float = 0.0,
    prepared: Prepared | None = None,
    work: Work | None = None,
    back: Back | None = None,
) -> Linearized:
    """Linearises a block at a state. damping is relative to the diagonal, of points only: that of the reduced system is
    left to the caller. prepared and work, made once for a block, save time; back is filled for `move_points`."""
    losses, prepared = losses or {}, prepared or Prepared.of(block)
    layout = prepared.layout
    sums = _empty_sums(prepared)
    given = GivenPoints.at(block, state.points, losses)
    cost, hidden, undetermined, gain = eliminate_points(
        *(prepared.tracks, prepared.images, placed(state), state.points, given.information, given.shift),
        *(damping, losses.get(IMAGE_OBSERVATIONS, 0.0), prepared.pairs, sums),
        *(back or Back.empty(0, 0), work or prepared.work()),
    )
    cost += cost_of_squares(given.square, _point_scales(block, losses))
    for term in [*constraint_terms(block, state, layout), *_kept_priors(block, state, layout)]:
        square = np.sum(np.square(term.residual), axis=1)
        scale = term_scales(block, term, losses)
        cost += 0.0 if term.name in KINDS_OF_POINT else cost_of_squares(square, scale)
        _add(weighted(term, robust_weight(square, scale)), layout, sums)
    sums.block[:] = _whole_diagonals(sums)
    corner = sums.corner + sums.corner.T - np.diag(np.diag(sums.corner))
    border = sums.border.reshape(6 * layout.stations, layout.border)
    reduced = Reduced(layout, prepared.first, prepared.column, sums.block, border, corner, sums.gradient)
    return Linearized(reduced, sums.diagonal, float(cost), int(hidden), int(undetermined), float(gain))


def total_cost(
    block: Block,
    state: State,
    *,
    losses: Losses | None = None,
    prepared: Prepared | None = None,
    hidden_square: float = 0.0,
) -> tuple[float, int]:
    """Cost of a state as in `Linearized`, with hidden_square for the squared residual of each image observation whose
    point the lens does not show; how many those are."""
    losses, prepared = losses or {}, prepared or Prepared.of(block)
    scale = losses.get(IMAGE_OBSERVATIONS, 0.0)
    cost, hidden = all_cost(*(prepared.tracks, prepared.images, placed(state), state.points, scale, hidden_square))
    return float(cost) + constraint_cost(block, state, prepared.layout, losses), int(hidden)


def constraint_cost(block: Block, state: State, layout: Layout, losses: Losses) -> float:
    """Cost of all that is not an image observation."""
    cost = cost_of_squares(given_squares(block, state.points), _point_scales(block, losses))
    for term in constraint_terms(block, state, layout):
        cost += cost_of_squares(np.sum(np.square(term.residual), axis=1), term_scales(block, term, losses))
    return cost


def given_squares(block: Block, points: Array) -> Array:
    """Squared whitened residuals (K,) of the point priors."""
    priors = block.point_priors
    off = points[priors.point] - priors.position
    return cast(Array, np.einsum("ki,kij,kj->k", off, priors.information, off))


def robust_weight(square: Array, scale: Array | float) -> Array:
    """Weights of Cauchy's loss; 1 where the scale is 0."""
    scale = np.broadcast_to(scale, square.shape)
    return np.where(scale > 0.0, 1.0 / (1.0 + square / np.where(scale > 0.0, scale, 1.0) ** 2), 1.0)


def cost_of_squares(square: Array, scale: Array | float) -> float:
    """Cost of squared whitened norms under Cauchy's loss; half of them where the scale is 0."""
    scale = np.broadcast_to(scale, square.shape)
    safe = np.where(scale > 0.0, scale, 1.0) ** 2
    return float(0.5 * np.sum(np.where(scale > 0.0, safe * np.log1p(square / safe), square)))


def term_scales(block: Block, term: Term, losses: Losses) -> Array | float:
    if term.name in KINDS_OF_POINT:
        return _point_scales(block, losses)[term.row]
    return losses.get(term.name, 0.0)


def weighted(term: Term, weight: Array) -> Term:
    """The same constraints with weights (K,) applied."""
    factor = np.sqrt(weight)
    columns = tuple((first, by * factor[:, None, None]) for first, by in term.columns)
    return replace(term, residual=term.residual * factor[:, None], columns=columns)


def _point_scales(block: Block, losses: Losses) -> Array:
    return np.array([losses.get(kind, 0.0) for kind in KINDS_OF_POINT])[block.point_priors.kind]


def _empty_sums(prepared: Prepared) -> Sums:
    layout, zero = prepared.layout, np.zeros
    return Sums(
        *(prepared.first, prepared.column, zero((len(prepared.column), 6, 6))),
        *(zero((layout.stations, 6, layout.border)), zero((layout.border, layout.border))),
        *(zero(layout.size), zero(layout.size)),
    )


def _kept_priors(block: Block, state: State, layout: Layout) -> list[Term]:
    """Given coordinates of points that stay in the border."""
    priors = block.point_priors
    first = layout.kept_point[priors.point]
    row = np.flatnonzero(first >= 0)
    if not len(row):
        return []
    weight = root(priors.information[row])
    off = state.points[priors.point[row]] - priors.position[row]
    residual = np.einsum("kij,kj->ki", weight, off)
    return [Term(KINDS_OF_POINT[0], residual, ((6 * layout.stations + first[row], weight),), row)]


def _whole_diagonals(sums: Sums) -> Array:
    """All blocks, the diagonal ones, of which only upper triangles are summed, made whole."""
    own = sums.first[:-1]
    upper = np.triu(sums.block[own])
    sums.block[own] = upper + np.swapaxes(np.triu(upper, 1), 1, 2)
    return sums.block


def _add(term: Term, layout: Layout, sums: Sums) -> None:
    """Adds J'J and J'r of weighted constraints."""
    for i, (first, by) in enumerate(term.columns):
        rows = np.flatnonzero(first >= 0)
        at = first[rows][:, None] + np.arange(by.shape[2])
        np.add.at(sums.gradient, at, np.einsum("kmi,km->ki", by[rows], term.residual[rows]))
        np.add.at(sums.diagonal, at, np.sum(np.square(by[rows]), axis=1))
        for other, other_by in term.columns[: i + 1]:
            _add_product(first, by, other, other_by, layout, sums)


def _add_product(first: Indices, by: Array, other: Indices, other_by: Array, layout: Layout, sums: Sums) -> None:
    """Adds by' other_by (K, s, t) where both are unknown, once for each unordered pair of unknowns."""
    stations = 6 * layout.stations
    product, same = np.swapaxes(by, 1, 2) @ other_by, by is other_by
    here, there = first < stations, other < stations
    known = (first >= 0) & (other >= 0)
    _add_to_stations(first, other, product, known & here & there, sums)
    for rows, a, b, blocks in (
        (known & here & ~there, first, other, product),
        (known & ~here & there, other, first, np.swapaxes(product, 1, 2)),
    ):
        a_rows = a[rows][:, None] + np.arange(blocks.shape[1])
        b_rows = b[rows][:, None] - stations + np.arange(blocks.shape[2])
        flat = sums.border.reshape(stations, layout.border)
        np.add.at(flat, (a_rows[:, :, None], b_rows[:, None, :]), blocks[rows])
    rows = known & ~here & ~there
    once = np.tril(product[rows]) if same else product[rows]
    a_rows = first[rows][:, None] - stations + np.arange(product.shape[1])
    b_rows = other[rows][:, None] - stations + np.arange(product.shape[2])
    np.add.at(sums.corner, (a_rows[:, :, None], b_rows[:, None, :]), once)


def _add_to_stations(first: Indices, other: Indices, product: Array, rows: NDArray[np.bool_], sums: Sums) -> None:
    if not rows.any():
        return
    a, b, blocks = first[rows] // 6, other[rows] // 6, product[rows]
    turned = a > b
    blocks[turned] = np.swapaxes(blocks[turned], 1, 2)
    low, high = np.minimum(a, b), np.maximum(a, b)
    count = len(sums.first) - 1
    keys = np.repeat(np.arange(count), np.diff(sums.first)) * count + sums.column
    np.add.at(sums.block, np.searchsorted(keys, low * count + high), blocks)
