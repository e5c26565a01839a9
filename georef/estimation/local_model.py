"""The local model of a query image: its keypoints triangulated from the reference images that they match."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from georef.estimation.guided import PosedFeatures
from georef.geometry.projection import Views
from georef.geometry.rigid import Array
from georef.geometry.triangulation import triangulate
from georef.types.features import Matches
from georef.types.scene import Observations

_ROUNDS = 4
_MAX_RELATIVE_DEPTH_SIGMA = 0.05


@dataclass(frozen=True, eq=False)
class LocalModel:
    """P points, each the match of one query keypoint, triangulated from reference images held at their poses."""

    keypoint: NDArray[np.int64]  # (P,) query keypoint
    points: Array  # (P, 3) in world
    cov: Array  # (P, 3, 3) of the image noise
    views: Views  # of the references
    observations: Observations  # in the references; view indexes `views`

    def __len__(self) -> int:
        return len(self.points)

    def take(self, selection: NDArray[np.bool_]) -> LocalModel:
        """The selected points with their observations."""
        renumber = np.cumsum(selection) - 1
        kept = self.observations.take(selection[self.observations.point])
        return LocalModel(
            self.keypoint[selection],
            self.points[selection],
            self.cov[selection],
            self.views,
            kept.with_points(renumber[kept.point]),
        )


def query_centred_model(
    references: Sequence[PosedFeatures], matches: Sequence[Matches], keypoint_sigma: float, gate: float = 3.5
) -> LocalModel:
    """Triangulates every query keypoint that at least two references agree on.

    matches[i] pairs query keypoints with those of references[i]. `gate` is the largest residual of an observation in
    sigmas; the worst observation of a point goes first.
    """
    keypoint, observations = _gather(references, matches, keypoint_sigma)
    views = Views.of([r.world_from_cam for r in references], [r.camera for r in references])
    return triangulate_consistent(views, keypoint, observations, gate)


def triangulate_consistent(
    views: Views, keypoint: NDArray[np.int64], observations: Observations, gate: float
) -> LocalModel:
    """Points from their consistent observations: inconsistent ones are dropped, the worst of each point first."""
    count = len(keypoint)
    obs, worst = observations, np.zeros(count)
    for _ in range(_ROUNDS):
        obs = obs.take(np.bincount(obs.point, minlength=count)[obs.point] >= 2)
        solved = triangulate(views, obs.point, obs.view, obs.pixel, obs.sigma_px, count)
        distance = np.linalg.norm(solved.residual_px, axis=1) / obs.sigma_px
        distance = np.where(np.isfinite(distance), distance, np.inf)
        worst = np.zeros(count)
        np.maximum.at(worst, obs.point, distance)
        bad = (distance > gate) & (distance >= worst[obs.point])
        if not bad.any():
            break
        obs = obs.take(~bad)
    else:
        obs = obs.take((np.bincount(obs.point, minlength=count)[obs.point] >= 2) & (worst[obs.point] <= gate))
        solved = triangulate(views, obs.point, obs.view, obs.pixel, obs.sigma_px, count)
    model = LocalModel(keypoint, solved.points, solved.cov, views, obs)
    return model.take(well_determined(model))


def _gather(
    references: Sequence[PosedFeatures], matches: Sequence[Matches], keypoint_sigma: float
) -> tuple[NDArray[np.int64], Observations]:
    """Query keypoints with a match, and all reference observations of them."""
    nothing = np.zeros((0, 2), np.int64)
    pairs = np.concatenate([m.indices for m in matches] or [nothing]).astype(np.int64)
    view = np.repeat(np.arange(len(matches)), [len(m) for m in matches])
    both = list(zip(references, (m.indices[:, 1] for m in matches), strict=True))
    pixel = np.concatenate([r.pixels[k] for r, k in both] or [nothing.astype(float)])
    scale = np.concatenate([r.features.scales_px[k] for r, k in both] or [np.zeros(0)]).astype(np.float64)
    keypoint, point = np.unique(pairs[:, 0], return_inverse=True)
    return keypoint, Observations(point, view, pixel, keypoint_sigma * scale, pairs[:, 1])


def well_determined(model: LocalModel) -> NDArray[np.bool_]:
    """Points whose distance from the references is known to a few per cent."""
    finite = np.asarray(np.isfinite(model.points).all(axis=1) & np.isfinite(model.cov).all(axis=(1, 2)))
    obs = model.observations
    distance = np.full(len(model), np.inf)
    to_points = np.linalg.norm(model.points[obs.point] - model.views.centres[obs.view], axis=1)
    np.minimum.at(distance, obs.point, np.nan_to_num(to_points, nan=np.inf))
    largest = np.sqrt(np.maximum(np.linalg.eigvalsh(np.where(finite[:, None, None], model.cov, np.eye(3)))[:, -1], 0))
    seen = np.bincount(obs.point, minlength=len(model)) >= 2
    return finite & seen & (largest <= _MAX_RELATIVE_DEPTH_SIGMA * distance)
