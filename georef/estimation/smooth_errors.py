"""What neighbouring reference images share of their errors, told apart from what each has of its own.

A network of all images finds the residuals of their given orientations; where these follow each other smoothly from
image to image (a bent block, a camera that is held a little wrong), neighbours are better relative to each other than
the residuals say. A new image rests on neighbours and moves with them: for it only an image's own error counts.

Residuals v of given orientations with errors e (covariance S) are v = (I - Q P) e - Q A' P_l l, with Q the cofactors
and P the weights of the adjustment, and l the image noise: their covariance is known for any S. S = own + smooth, where
the smooth part of two images is correlated by exp(-h^2 / 2 r^2) with h^2 = (distance / D)^2 + (angle / T)^2, and D and
T the usual distance and angle of an image to those it shares most with. Variances by maximum likelihood (Mardia and
Marshall, Biometrika 1984).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import minimize
from scipy.stats import chi2

from georef.estimation.adjustment.block import Block, State
from georef.estimation.adjustment.equations.cofactors import Cofactors
from georef.geometry.rigid import Array
from georef.types.results import ReferenceNoise

_NEAREST = 4  # images that one shares most points with
# Of the correlation, in usual distances to those: well beyond the ten images that a localization rests on, or what is
# left of the smooth part among them is missing. The likelihood tells reaches from 1 to 4 hardly apart; with this one
# references that are left out are as far off as predicted (castle: NEES 0.9 per degree of freedom; with 2, 1.7).
_REACH = 3.0
_OBSERVABLE = 0.05  # least redundancy of a combination of residuals
_PROBABILITY = 0.999  # with which the smooth part must improve the likelihood
_LEAST_SHARE = 0.2  # of the total sigma: what so few images can tell of an image's own error


@dataclass(frozen=True)
class SmoothErrors:
    """1-sigma an axis of what neighbours share, and of what an image has of its own."""

    position_m: float
    rotation_rad: float
    own_position_m: float
    own_rotation_rad: float
    reach_m: float  # distance over which the shared part stays alike
    reach_rad: float  # and angle


@dataclass(frozen=True, eq=False)
class Residuals:
    """Residuals of M given orientations in units of their sigmas, world axes: rotation, then position of each image."""

    values: Array  # (6M,) given minus adjusted
    cofactors: Array  # (6M, 6M) of the adjusted poses, in the same units
    distance: Array  # (M, M) m, between the images
    angle: Array  # (M, M) rad, between their attitudes
    shared: NDArray[np.integer]  # (M, M) points that both see

    @staticmethod
    def of(block: Block, state: State, cofactors: Cofactors, noise: ReferenceNoise) -> Residuals:
        """Of a network of images that are stations by themselves, each with a given orientation of this noise."""
        count, poses = len(block.image_ids), block.world_from_cam(state)
        to_units = np.zeros((count, 6, 6))
        to_units[:, :3, :3] = poses.rotation / np.array(noise.rotation_sigma_rad)[:, None]
        to_units[:, 3:, 3:] = poses.rotation / np.array(noise.position_sigma_m)[:, None]
        given = block.pose_priors.world_from_cam.take(np.argsort(block.pose_priors.image))
        joint = cofactors.joint_stations(block.station).reshape(count, 6, count, 6)
        in_units = np.einsum("aij,ajbk,blk->aibl", to_units, joint, to_units, optimize=True)
        trace = np.einsum("aij,bij->ab", poses.rotation, poses.rotation)
        return Residuals(
            np.einsum("aij,aj->ai", to_units, poses.local(given)).ravel(),
            in_units.reshape(6 * count, 6 * count),
            np.linalg.norm(poses.translation[:, None] - poses.translation, axis=2),
            np.arccos(np.clip((trace - 1.0) / 2.0, -1.0, 1.0)),
            _shared_points(block),
        )

    def usual(self, between: Array) -> float:
        """The median of a quantity (M, M) between an image and those it shares most with."""
        nearest = np.argsort(-self.shared, axis=1, kind="stable")[:, :_NEAREST]
        some = np.take_along_axis(self.shared, nearest, axis=1) > 0
        return float(np.median(np.take_along_axis(between, nearest, axis=1)[some]))


def _shared_points(block: Block) -> NDArray[np.integer]:
    """How many points each two images (M, M) both see."""
    obs = block.observations
    seen = np.zeros((len(block.image_ids), len(block.points)), np.int32)
    seen[obs.view, obs.point] = 1
    shared = seen @ seen.T
    np.fill_diagonal(shared, 0)
    return shared


def smooth_errors(residuals: Residuals, position_sigma_m: float, rotation_sigma_rad: float) -> SmoothErrors | None:
    """The two parts of the errors, for the sigmas that the residuals are in units of; None where all errors are the
    images' own as far as can be told."""
    if len(residuals.distance) <= _NEAREST or not residuals.shared.any():
        return None
    reach_m, reach_rad = _REACH * residuals.usual(residuals.distance), _REACH * residuals.usual(residuals.angle)
    if reach_m <= 0.0 or reach_rad <= 0.0:
        return None
    alike = np.exp(-0.5 * ((residuals.distance / reach_m) ** 2 + (residuals.angle / reach_rad) ** 2))
    likelihood = _Likelihood.of(residuals, alike)
    alone, _ = likelihood.best([0.0, 0.0])
    both, variances = likelihood.best([-1.0, -1.0, -0.5, -0.5])
    if 2.0 * (alone - both) < chi2.ppf(_PROBABILITY, 2):
        return None
    own_rotation, own_position, rotation, position = (float(v) for v in np.sqrt(variances))
    return SmoothErrors(
        position * position_sigma_m,
        rotation * rotation_sigma_rad,
        max(own_position, _LEAST_SHARE) * position_sigma_m,
        max(own_rotation, _LEAST_SHARE) * rotation_sigma_rad,
        reach_m,
        reach_rad,
    )


@dataclass(frozen=True, eq=False)
class _Likelihood:
    """Of variances of own rotation, own position, smooth rotation and smooth position, in units of the sigmas."""

    values: Array  # (n,) observable combinations of residuals
    by_image: Array  # (n, n) covariance that the images' noise gives them
    by_variance: Array  # (4, n, n) derivatives of their covariance

    @staticmethod
    def of(residuals: Residuals, alike: Array) -> _Likelihood:
        size = len(residuals.values)
        checked = np.eye(size) - residuals.cofactors
        values, vectors = np.linalg.eigh(checked)
        basis = vectors[:, values > _OBSERVABLE].T
        by_error = basis @ checked
        is_position = np.tile(np.repeat([0.0, 1.0], 3), len(alike))
        every = np.kron(alike, np.eye(6))
        kinds = (1.0 - is_position, is_position)
        parts = [by_error @ (part * kind) @ by_error.T for part in (np.eye(size), every) for kind in kinds]
        by_image = basis @ (residuals.cofactors @ checked) @ basis.T
        return _Likelihood(basis @ residuals.values, by_image, np.array(parts))

    def best(self, start: list[float]) -> tuple[float, Array]:
        """The least negative log likelihood over the first variances, and these; start: their logarithms."""
        found = minimize(self._negative, start, method="Nelder-Mead", options={"xatol": 0.02, "fatol": 0.05})
        return float(found.fun), np.exp(found.x)

    def _negative(self, logarithms: Array) -> float:
        variances = np.exp(np.clip(logarithms, -20.0, 20.0))
        cov = self.by_image + np.tensordot(variances, self.by_variance[: len(variances)], axes=1)
        try:
            factor = cho_factor(cov, lower=True)
        except np.linalg.LinAlgError:
            return float("inf")
        logarithm = float(np.log(np.diag(cast(Array, factor[0]))).sum())
        return logarithm + 0.5 * float(self.values @ cho_solve(factor, self.values))
