"""What the errors of the reference poses add to the covariances of an adjusted block through its automatic GCPs.

The weights of automatic GCPs know their image noise alone: a reference moves all its GCPs together, and so does a
station of references. With X the given coordinates, P their weights, N the normal matrix of a point and W its coupling
with stations and mountings: dx = Q W N^-1 P dX, dX = sum over references of B e.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.sparse import coo_array, csr_array

from georef.estimation.adjustment.block import KINDS_OF_POINT, Block, Indices, State
from georef.estimation.adjustment.cofactors import Cofactors
from georef.estimation.adjustment.problem import AutomaticGcps
from georef.estimation.adjustment.reduced import Layout
from georef.estimation.reference_errors import ReferenceErrors
from georef.geometry.projection import linearize
from georef.geometry.rigid import Array
from georef.geometry.triangulation import segment_sum


@dataclass(frozen=True, eq=False)
class ReferencePart:
    """How the errors of R references move the right-hand side of a reduced system of U unknowns."""

    by_reference: csr_array  # (U, 6 R)
    errors: ReferenceErrors

    @staticmethod
    def of(block: Block, state: State, layout: Layout, gcps: AutomaticGcps) -> ReferencePart:
        """`gcps`: the K that lead the block's point priors, in their order."""
        rays = (3 * gcps.ray_gcp, 6 * gcps.ray_reference, gcps.by_reference_pose)
        moved = _sparse([rays], 3 * len(gcps), 6 * len(gcps.reference_ids))
        coupled = _sparse(_coupling(block, state, layout, gcps), layout.size, 3 * len(gcps))
        return ReferencePart(csr_array(coupled @ moved), gcps.reference_errors)

    def cov(self, found: Cofactors, derivatives: Array) -> Array:
        """What the references add to the covariance (K, K) of K values with derivatives (U, K) by the unknowns."""
        if not len(self.errors):
            return np.zeros((derivatives.shape[1], derivatives.shape[1]))
        from_references: Any = self.by_reference.T
        gains = (from_references @ found.apply(derivatives)).reshape(-1, 6, derivatives.shape[1])
        return self.errors.propagated(np.swapaxes(gains, 1, 2))


def _coupling(
    block: Block, state: State, layout: Layout, gcps: AutomaticGcps
) -> Iterator[tuple[Indices, Indices, Array]]:
    """W N^-1 P of the automatic GCPs: first rows, first columns and blocks (n, 6, 3)."""
    of_point = np.full(len(block.points), -1)
    of_point[gcps.point] = np.arange(len(gcps))
    obs = block.observations.take(of_point[block.observations.point] >= 0)
    gcp = of_point[obs.point]
    lin = linearize(block.views(state), obs.view, state.points[obs.point])
    weight = (np.isfinite(lin.pixel).all(axis=1) / np.square(obs.sigma_px))[:, None, None]
    by_pose, by_point = np.nan_to_num(lin.by_pose), np.nan_to_num(lin.by_point)
    information = block.point_priors.information[: len(gcps)]
    assert (block.point_priors.kind[: len(gcps)] == KINDS_OF_POINT.index("automatic")).all()
    normal = information + segment_sum(np.swapaxes(by_point, 1, 2) @ by_point * weight, gcp, len(gcps))
    share = np.linalg.solve(normal, information)[gcp]
    by_cam = np.swapaxes(by_pose, 1, 2) @ by_point * weight @ share
    mounting = block.mounting[obs.view]
    by_station = np.swapaxes(state.rig_from_cam.inverse().adjoint(), 1, 2)[mounting]
    yield 6 * block.station[obs.view], 3 * gcp, by_station @ by_cam
    free = layout.mounting[mounting] >= 0
    yield 6 * layout.stations + layout.mounting[mounting[free]], 3 * gcp[free], by_cam[free]


def _sparse(parts: Any, rows: int, columns: int) -> csr_array:
    """Sums of blocks (n, a, b) that stand at rows (n,) and columns (n,)."""
    values, at, across = [], [], []
    for row, column, blocks in parts:
        shape = blocks.shape
        values.append(blocks.ravel())
        at.append(np.broadcast_to(row[:, None, None] + np.arange(shape[1])[:, None], shape).ravel())
        across.append(np.broadcast_to(column[:, None, None] + np.arange(shape[2]), shape).ravel())
    joined = np.concatenate(values), (np.concatenate(at), np.concatenate(across))
    return csr_array(coo_array(joined, shape=(rows, columns)))
