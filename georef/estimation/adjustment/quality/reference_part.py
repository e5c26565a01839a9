"""What the errors of the reference poses add to the covariances of an adjusted block through its automatic GCPs.

The weights of automatic GCPs know their image noise alone: a reference moves all its GCPs together, and so does a
station of references. With X the given coordinates, P their weights, N the normal matrix of a point and W its coupling
with stations and all that they share: dx = Q W N^-1 P dX, dX = sum over references of B e.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.sparse import csr_array

from georef.estimation.adjustment.block import Block, Indices, State
from georef.estimation.adjustment.equations.cofactors import Cofactors
from georef.estimation.adjustment.equations.constraint_terms import Columns, dense_columns
from georef.estimation.adjustment.equations.given_points import GivenRays, sparse_sum
from georef.estimation.reference_errors import ReferenceErrors
from georef.geometry.rigid import Array

_CHUNK = 600  # columns solved for at a time
_POINTS = 20_000  # given points looked at together


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
        placed = [(3 * row[kept], 6 * rays.reference[kept], rays.by_reference_pose[kept])]
        moved: Any = sparse_sum(placed, 3 * len(priors), 6 * len(rays.errors))
        total: Any = sparse_sum([], found.layout.size, 6 * len(rays.errors))
        for rows in np.array_split(np.arange(len(priors)), 1 + len(priors) // _POINTS):
            seen = GivenRays.of(block, state, found.layout, rows)
            gain = seen.inverse(priors.information[rows]) @ priors.information[rows]
            coupled = seen.coupled(gain, found.layout.size, np.arange(len(rows)), len(rows))
            total = total + coupled @ moved[3 * rows[0] : 3 * rows[-1] + 3]
        return ReferencePart(found, csr_array(total), rays.errors)

    def cov(self, derivatives: Array) -> Array:
        """What the references add to the covariance (K, K) of K values with derivatives (U, K) by the unknowns."""
        return self.errors.propagated(self._gains(derivatives))

    def of_rows(self, columns: Columns, width: int) -> Array:
        """The same for K groups of m values (K, m, m): columns as those of a `Term`."""
        size = self.found.layout.size
        return self._in_chunks(lambda rows: dense_columns(columns, rows, width, size), len(columns[0][0]), width)

    def of_given_points(self, block: Block, state: State, rows: Indices) -> Array:
        """What the references add to the covariances (K, 3, 3) of given points: rows of the point priors."""
        seen = GivenRays.of(block, state, self.found.layout, rows)
        inverse = seen.inverse(block.point_priors.information[rows])
        by_unknown: Any = seen.coupled(inverse, self.found.layout.size, np.arange(len(rows)), len(rows))

        def derivatives(chosen: Indices) -> Array:
            return by_unknown[:, (3 * chosen[:, None] + np.arange(3)).ravel()].toarray()

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
