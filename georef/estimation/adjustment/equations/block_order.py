"""In which order stations are eliminated, so that few blocks fill in: nested dissection against minimum degree.

George and Liu, "Computer Solution of Large Sparse Positive Definite Systems" (1981), chapters 5 and 8.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array, csc_array, csr_array, eye_array

from georef.estimation.adjustment.block import Indices

_AMALGAMATED_ZEROS = 0.25  # share of a front's factor that may be zeros, for fewer and larger fronts
_SMALL_FRONT = 4  # pivots: such fronts cost more in overhead than in zeros


@dataclass(frozen=True, eq=False)
class Front:
    """A dense part of the factor: pivots are eliminated in it, the rest is passed on to the parent.

    members: stations, pivots first, in the order of elimination; parent: index of a later front, -1 of a root.
    """

    members: Indices
    pivots: int
    parent: int


def fronts_of(stations: int, row: Indices, column: Indices) -> list[Front]:
    """Fronts of a symmetric pattern, children before parents. row, column (N,): stations of each block."""
    orders = [_minimum_degree(stations, row, column)]
    if stations > 2:
        orders.append(_nested_dissection(stations, row, column))
    return min((_fronts(row, column, order) for order in orders), key=_cost)


def _cost(fronts: list[Front]) -> float:
    """Multiplications of a factorisation, up to a constant."""
    return float(sum(front.pivots * len(front.members) ** 2 for front in fronts))


def _minimum_degree(stations: int, row: Indices, column: Indices) -> Indices:
    """SuperLU's minimum degree of A' + A, by way of a diagonally dominant matrix of the pattern."""
    from scipy.sparse.linalg import splu

    apart = row != column
    ones = np.ones(int(apart.sum()))
    half = csr_array(coo_array((ones, (row[apart], column[apart])), shape=(stations, stations)))
    graph = half + half.T
    dominant = eye_array(stations) * (float(np.max(graph.sum(axis=1), initial=0.0)) + 1.0) - graph
    options = {"SymmetricMode": True}
    factor = splu(csc_array(dominant), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options)
    return np.argsort(factor.perm_c).astype(np.int64)


def _nested_dissection(stations: int, row: Indices, column: Indices) -> Indices:
    """METIS, as GTSAM has it."""
    import gtsam

    apart = row != column
    tied, ends = np.unique(np.stack([row[apart], column[apart]]), return_inverse=True)
    alone = np.setdiff1d(np.arange(stations), tied)  # METIS writes beyond its memory for a vertex without edges
    graph, one, nothing, unit = gtsam.GaussianFactorGraph(), np.eye(1), np.zeros(1), gtsam.noiseModel.Unit.Create(1)
    for a, b in ends.reshape(2, -1).T.tolist():
        graph.add(gtsam.JacobianFactor(a, one, b, one, nothing, unit))
    order = gtsam.Ordering.MetisGaussianFactorGraph(graph) if len(tied) else gtsam.Ordering()
    return np.concatenate([alone, tied[[order.at(i) for i in range(order.size())]]]).astype(np.int64)


def _fronts(row: Indices, column: Indices, order: Indices) -> list[Front]:
    """Columns of the factor, those with like structure joined (supernodes), small ones joined with some zeros."""
    place = np.empty_like(order)
    place[order] = np.arange(len(order))
    below, parent = _structures(
        np.minimum(place[row], place[column]), np.maximum(place[row], place[column]), len(order)
    )
    pivots = [[j] for j in range(len(order))]
    zeros, absorbed, sizes = [0] * len(order), [False] * len(order), [len(b) for b in below]
    for j in range(len(order)):  # children come before parents, so that whole branches can grow upwards
        above = parent[j]
        if above < 0:
            continue
        joint = len(pivots[j]) + len(pivots[above])
        more = zeros[j] + zeros[above] + len(pivots[j]) * (len(pivots[above]) + sizes[above] - sizes[j])
        allowed = _AMALGAMATED_ZEROS * joint * (0.5 * joint + sizes[above])
        if more <= allowed or (joint <= _SMALL_FRONT and more <= joint * sizes[above]):
            pivots[above] = pivots[j] + pivots[above]
            zeros[above], absorbed[j] = more, True
    heads = [j for j in range(len(order)) if not absorbed[j]]
    index = {-1: -1} | {j: k for k, j in enumerate(heads)}
    for j in reversed(range(len(order))):  # what was joined is part of the front that its parent is part of
        if absorbed[j]:
            index[j] = index[parent[j]]
    # A head keeps its own place as the last of its pivots: what is below it comes later in the order.
    return [
        Front(
            order[np.concatenate([np.sort(np.array(pivots[j], dtype=np.int64)), below[j]])],
            len(pivots[j]),
            index[parent[j]],
        )
        for j in heads
    ]


def _structures(low: Indices, high: Indices, count: int) -> tuple[list[Indices], list[int]]:
    """Rows below the diagonal of each column of the factor, sorted, and its parent (-1: none)."""
    apart = low != high
    low, high = low[apart], high[apart]
    sorting = np.argsort(low, kind="stable")
    starts = np.searchsorted(low[sorting], np.arange(count + 1))
    own = high[sorting]
    below: list[Indices] = []
    parent: list[int] = []
    children: list[list[int]] = [[] for _ in range(count)]
    for j in range(count):
        rows = [own[starts[j] : starts[j + 1]], *(below[c][1:] for c in children[j])]
        below.append(np.unique(np.concatenate(rows)))
        parent.append(int(below[j][0]) if len(below[j]) else -1)
        if parent[j] >= 0:
            children[parent[j]].append(j)
    return below, parent
