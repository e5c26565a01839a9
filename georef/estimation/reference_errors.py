"""The errors of reference poses, and what they do to whatever is estimated from several references.

Reference images of one exposure, the heads of a panorama or the cameras of a rig, share one error: they move as one
rigid body. An error e of a station is Ad(view_from_station) e of each of its views, so that what the views of a station
do to an estimate adds up before it is squared.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from georef.estimation.local_model import LocalModel
from georef.geometry.covariance import symmetric
from georef.geometry.projection import linearize
from georef.geometry.rigid import Array, Rigid3
from georef.geometry.triangulation import segment_sum


@dataclass(frozen=True, eq=False)
class ReferenceErrors:
    """Errors (right perturbations of world_from_cam) of R reference views that belong to S stations."""

    station: NDArray[np.int64]  # (R,) of each view
    by_station: Array  # (R, 6, 6) error of a view by the error of its station
    covs: Array  # (S, 6, 6) of the errors of the stations, which are independent

    def __len__(self) -> int:
        return len(self.station)

    @classmethod
    def independent(cls, covs: Sequence[Array] | Array) -> Self:
        """Views (R,) with errors of their own, of covariances (R, 6, 6)."""
        every = np.asarray(covs, dtype=np.float64).reshape(-1, 6, 6)
        return cls(np.arange(len(every)), np.tile(np.eye(6), (len(every), 1, 1)), every)

    @classmethod
    def of_stations(
        cls, world_from_cams: Sequence[Rigid3], covs: Sequence[Array], names: Sequence[object | None]
    ) -> Self:
        """Views with poses and their covariances (6, 6), by the names of their stations; None: a view by itself.

        The frame of a station is that of its first view, whose covariance is the station's.
        """
        first: dict[object, int] = {}
        station, by_station = [], []
        for view, (pose, name) in enumerate(zip(world_from_cams, names, strict=True)):
            leader = first.setdefault(object() if name is None else name, view)
            station.append(leader)
            by_station.append((pose.inverse() @ world_from_cams[leader]).adjoint())
        leaders, index = np.unique(np.array(station, dtype=np.int64), return_inverse=True)
        chosen = np.array([covs[i] for i in leaders], dtype=np.float64).reshape(-1, 6, 6)
        return cls(index.astype(np.int64), np.array(by_station).reshape(-1, 6, 6), chosen)

    def propagated(self, gains: Array) -> Array:
        """Covariance (K, K) that the errors bring to K unknowns, which follow them by gains (R, K, 6)."""
        by_station = segment_sum(gains @ self.by_station, self.station, len(self.covs))  # (S, K, 6)
        wide = np.swapaxes(by_station, 0, 1).reshape(gains.shape[1], -1)
        weighted = np.swapaxes(by_station @ self.covs, 0, 1).reshape(gains.shape[1], -1)
        return symmetric(weighted @ wide.T)

    def draw(self, rng: np.random.Generator) -> Array:
        """Errors (R, 6) of the views: what the model says of them, at random."""
        factors = np.linalg.cholesky(self.covs)
        errors = np.einsum("sij,sj->si", factors, rng.normal(size=(len(self.covs), 6)))
        return np.einsum("rij,rj->ri", self.by_station, errors[self.station])


def point_by_reference_pose(model: LocalModel) -> Array:
    """Derivatives (n, 3, 6) of a model's points by the poses of the references in its n observations.

    A reference pose error e moves a point by -N^-1 A' W B e, with A and B the derivatives of its observation by point
    and pose, and N^-1 the covariance of the point.
    """
    obs = model.observations
    lin = linearize(model.views, obs.view, model.points[obs.point])
    pull = np.einsum("nki,nkj->nij", lin.by_point, lin.by_pose) / np.square(obs.sigma_px)[:, None, None]
    return -model.cov[obs.point] @ pull


def reference_gains(model: LocalModel, unknowns_by_point: Array) -> Array:
    """Derivatives (R, K, 6) of K unknowns by the poses of the model's R views.

    unknowns_by_point (P, K, 3): how the unknowns follow the model's points. Where several images are estimated
    together, each has its model and its share in the K unknowns; models of the same views add up.
    """
    obs = model.observations
    return segment_sum(unknowns_by_point[obs.point] @ point_by_reference_pose(model), obs.view, len(model.views))
