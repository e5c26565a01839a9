"""What the errors of the reference poses add to the covariances of an adjusted block through its automatic GCPs.

The weights of automatic GCPs know their image noise alone: a reference moves all its GCPs together, and so does a
station of references. With X the given coordinates, P their weights, N the normal matrix of a point and W its coupling
with stations and mountings: dx = Q W N^-1 P dX, dX = sum over references of B e.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.sparse import coo_array, csr_array

from georef.estimation.adjustment.block import Block, Indices, State
from georef.estimation.adjustment.cofactors import Cofactors
from georef.estimation.adjustment.constraint_terms import Columns, dense_columns
from georef.estimation.reference_errors import ReferenceErrors
from georef.geometry.projection import linearize
from georef.geometry.rigid import Array
from georef.geometry.triangulation import segment_sum

_CHUNK = 600  # columns solved for at a time
Placed = tuple[Indices, Indices, Array]  # first rows (n,), first columns (n,), blocks (n, a, b)


@dataclass(frozen=True, eq=False)
class ReferencePart:
    """How the errors of R references move the unknowns of a reduced system: Q times this."""

    found: Cofactors
    by_reference: csr_array  # (U, 6 R)
    errors: ReferenceErrors

    @staticmethod
    def of(block: Block, state: State, found: Cofactors) -> ReferencePart | None:
        """None for a block whose points owe nothing to references."""
        rays, priors = block.reference_rays, block.point_priors
        if rays is None or not len(priors):
            return None
        row = np.full(len(block.points), -1)
        row[priors.point] = np.arange(len(priors))
        row = row[rays.point]
        kept = row >= 0
        size = 3 * len(priors), 6 * len(rays.errors)
        moved = _sparse([(3 * row[kept], 6 * rays.reference[kept], rays.by_reference_pose[kept])], *size)
        coupled = _sparse(_coupling(block, state, found, priors.information), found.layout.size, size[0])
        return ReferencePart(found, csr_array(coupled @ moved), rays.errors)

    def cov(self, derivatives: Array) -> Array:
        """What the references add to the covariance (K, K) of K values with derivatives (U, K) by the unknowns."""
        return self.errors.propagated(self._gains(derivatives))

    def of_rows(self, columns: Columns, width: int) -> Array:
        """The same for K groups of m values (K, m, m): columns as those of a `Term`."""
        size = self.found.layout.size
        return self._in_chunks(lambda rows: dense_columns(columns, rows, width, size), len(columns[0][0]), width)

    def of_given_points(self, block: Block, state: State, rows: Indices) -> Array:
        """What the references add to the covariances (K, 3, 3) of given points: rows of the point priors."""
        every = np.tile(np.eye(3), (len(block.point_priors), 1, 1))
        shape = self.found.layout.size, 3 * len(every)
        by_unknown: Any = _sparse(_coupling(block, state, self.found, every), *shape)

        def derivatives(chosen: Indices) -> Array:
            return by_unknown[:, (3 * rows[chosen][:, None] + np.arange(3)).ravel()].toarray()

        return self._in_chunks(derivatives, len(rows), 3)

    def _in_chunks(self, derivatives: Callable[[Indices], Array], count: int, width: int) -> Array:
        """Covariances (K, m, m) of groups, whose derivatives (U, k m) are made for a few at a time."""
        out = np.zeros((count, width, width))
        for rows in np.array_split(np.arange(count), 1 + count * width // _CHUNK):
            gains = self._gains(derivatives(rows))
            for k, row in enumerate(rows):
                out[row] = self.errors.propagated(gains[:, k * width : (k + 1) * width])
        return out

    def _gains(self, derivatives: Array) -> Array:
        """Derivatives (R, K, 6) of the values by the errors of the references."""
        from_references: Any = self.by_reference.T
        gains = (from_references @ self.found.apply(derivatives)).reshape(-1, 6, derivatives.shape[1])
        return np.swapaxes(gains, 1, 2)


def _coupling(block: Block, state: State, found: Cofactors, right: Array) -> Iterator[Placed]:
    """W N^-1 times right (K, 3, 3) of the K given points, which nothing keeps in the border."""
    priors, layout = block.point_priors, found.layout
    row = np.full(len(block.points), -1)
    row[priors.point] = np.arange(len(priors))
    obs = block.observations.take(row[block.observations.point] >= 0)
    prior = row[obs.point]
    lin = linearize(block.views(state), obs.view, state.points[obs.point])
    weight = (np.isfinite(lin.pixel).all(axis=1) / np.square(obs.sigma_px))[:, None, None]
    by_pose, by_point = np.nan_to_num(lin.by_pose), np.nan_to_num(lin.by_point)
    normal = segment_sum(np.swapaxes(by_point, 1, 2) @ by_point * weight, prior, len(priors)) + priors.information
    determined = np.linalg.cond(normal) < 1e12
    normal[~determined] = np.eye(3)
    share = (np.linalg.solve(normal, right) * determined[:, None, None])[prior]
    by_cam = np.swapaxes(by_pose, 1, 2) @ by_point * weight @ share
    mounting = block.mounting[obs.view]
    by_station = np.swapaxes(state.rig_from_cam.inverse().adjoint(), 1, 2)[mounting]
    yield 6 * block.station[obs.view], 3 * prior, by_station @ by_cam
    free = layout.mounting[mounting] >= 0
    yield 6 * layout.stations + layout.mounting[mounting[free]], 3 * prior[free], by_cam[free]


def _sparse(parts: Iterable[Placed], rows: int, columns: int) -> csr_array:
    """Sums of blocks that stand at rows and columns."""
    values, at, across = [], [], []
    for row, column, blocks in parts:
        shape = blocks.shape
        values.append(blocks.ravel())
        at.append(np.broadcast_to(row[:, None, None] + np.arange(shape[1])[:, None], shape).ravel())
        across.append(np.broadcast_to(column[:, None, None] + np.arange(shape[2]), shape).ravel())
    joined = np.concatenate(values), (np.concatenate(at), np.concatenate(across))
    return csr_array(coo_array(joined, shape=(rows, columns)))
