"""How given points hang on stations, mountings and calibrations through the images that see them.

With the rays of a point whitened, D their derivatives by the point and A those by everything else, N = D'D + P is its
normal matrix (P the weight of its given coordinates) and W = A'D its coupling: a step dx of everything else moves the
point by -N^-1 (g + W' dx), g being its gradient. Points in the border are not among them.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array

from georef.estimation.adjustment.block import Block, Indices, State
from georef.estimation.adjustment.equations.eliminate import IMAGE_OBSERVATIONS, Losses, robust_weight
from georef.estimation.adjustment.equations.reduced import Layout
from georef.geometry.camera import intrinsic_derivatives
from georef.geometry.projection import Linearized, linearize
from georef.geometry.rigid import Array
from georef.geometry.triangulation import segment_sum
from georef.types.scene import Observations

Placed = tuple[Indices, Indices, Array]  # first rows (n,), first columns (n,), blocks (n, a, b)
_OPEN = 1e-12  # of the cubed trace: the determinant of a normal matrix with an open direction


@dataclass(frozen=True, eq=False)
class GivenRays:
    """What the rays of K given points say, everything else as it is.

    coupling: W in blocks (n, a, 3), from a first unknown of the reduced system to a point's place 0 ... K - 1.
    """

    normal: Array  # (K, 3, 3) D'D
    slope: Array  # (K, 3) D'r
    coupling: tuple[Placed, ...]

    @staticmethod
    def of(block: Block, state: State, layout: Layout, rows: Indices, losses: Losses | None = None) -> GivenRays:
        """rows (K,) of the point priors; losses weigh the image observations. Nothing is said of points in the
        border."""
        count, prior = len(rows), np.full(len(block.points), -1)
        free = layout.kept_point[block.point_priors.point[rows]] < 0
        prior[block.point_priors.point[rows[free]]] = np.flatnonzero(free)
        obs = block.observations.take(prior[block.observations.point] >= 0)
        at = prior[obs.point]
        lin = linearize(block.views(state), obs.view, state.points[obs.point])
        residual = (lin.pixel - obs.pixel) / obs.sigma_px[:, None]
        shown: NDArray[np.bool_] = np.asarray(np.isfinite(residual).all(axis=1))
        residual = np.where(shown[:, None], residual, 0.0)
        scale = (losses or {}).get(IMAGE_OBSERVATIONS, 0.0)
        weight = (shown * robust_weight(np.sum(np.square(residual), axis=1), scale))[:, None, None]
        turned = np.swapaxes(np.where(shown[:, None, None], lin.by_point, 0.0) / obs.sigma_px[:, None, None], 1, 2)
        slope = (turned @ (residual[:, :, None] * weight))[:, :, 0]
        coupling = tuple(_coupling(block, state, layout, obs, lin, np.swapaxes(turned, 1, 2) * weight, at))
        return GivenRays(
            segment_sum(turned @ np.swapaxes(turned, 1, 2) * weight, at, count),
            segment_sum(slope, at, count),
            coupling,
        )

    def inverse(self, information: Array) -> Array:
        """N^-1 (K, 3, 3) with the weights (K, 3, 3) of the given coordinates; zero where a direction is open."""
        normal = self.normal + information
        determined = np.linalg.det(normal) > _OPEN * np.trace(normal, axis1=1, axis2=2) ** 3
        normal[~determined] = np.eye(3)
        return np.linalg.inv(normal) * determined[:, None, None]

    def coupled(self, right: Array, size: int, group: Indices, groups: int) -> csr_array:
        """W times right (K, 3, 3), summed over the points of each group (K,): (U, 3 G) for U = size unknowns."""
        parts = [(row, 3 * group[at], blocks @ right[at]) for row, at, blocks in self.coupling]
        return sparse_sum(parts, size, 3 * groups)


def _coupling(
    block: Block, state: State, layout: Layout, obs: Observations, lin: Linearized, by_point: Array, at: Indices
) -> Iterator[Placed]:
    """A'D of each observation; by_point (n, 2, 3): whitened and weighted once, 0 where no lens shows the point."""
    edge, sigma = 6 * layout.stations, obs.sigma_px[:, None, None]
    by_pose = np.where(np.isfinite(lin.by_pose), lin.by_pose, 0.0) / sigma
    by_cam = np.swapaxes(by_pose, 1, 2) @ by_point
    mounting, calibration = block.mounting[obs.view], block.calibration[obs.view]
    by_station = np.swapaxes(state.rig_from_cam.inverse().adjoint(), 1, 2)[mounting]
    yield 6 * block.station[obs.view], at, by_station @ by_cam
    free = np.flatnonzero(layout.mounting[mounting] >= 0)
    yield edge + layout.mounting[mounting[free]], at[free], by_cam[free]
    in_cam = block.views(state).to_cam(obs.view, state.points[obs.point])
    for index in np.flatnonzero(layout.calibration >= 0):
        here = np.flatnonzero(calibration == index)
        names = block.calibrations[index].camera.estimate
        by_step = intrinsic_derivatives(state.cameras[index], in_cam[here], names) / sigma[here]
        by_step = np.where(np.isfinite(by_step), by_step, 0.0)
        first = np.full(len(here), edge + layout.calibration[index])
        yield first, at[here], np.swapaxes(by_step, 1, 2) @ by_point[here]


def sparse_sum(parts: Iterable[Placed], rows: int, columns: int) -> csr_array:
    """Sums of blocks that stand at rows and columns."""
    values, at, across = [np.zeros(0)], [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
    for row, column, blocks in parts:
        shape = blocks.shape
        values.append(blocks.ravel())
        at.append(np.broadcast_to(row[:, None, None] + np.arange(shape[1])[:, None], shape).ravel())
        across.append(np.broadcast_to(column[:, None, None] + np.arange(shape[2]), shape).ravel())
    joined = np.concatenate(values), (np.concatenate(at), np.concatenate(across))
    return csr_array(coo_array(joined, shape=(rows, columns)))
