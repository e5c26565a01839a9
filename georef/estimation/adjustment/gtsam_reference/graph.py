"""A block as a factor graph of GTSAM, every observation a factor: the reference that the fast way is checked against.

Clear rather than fast: for small blocks. The tangents are those of the reduced system.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray

from georef.estimation.adjustment.block import KINDS_OF_POINT, Block, State
from georef.estimation.adjustment.equations.constraint_terms import (
    CALIBRATIONS,
    DISTANCES,
    DRIFT,
    LEVER_ARMS,
    MOUNTINGS,
    POSE_PRIORS,
    POSITION_PRIORS,
    RELATIVE_POSES,
    drift_at,
)
from georef.estimation.adjustment.equations.reduced import Layout
from georef.estimation.adjustment.gtsam_reference import factors
from georef.estimation.adjustment.gtsam_reference.factors import Noise
from georef.estimation.adjustment.gtsam_reference.variables import Variables, pose3
from georef.geometry.rigid import Array

IMAGE_OBSERVATIONS = "image observations"
_STEP_TOLERANCE, _LAMBDA_INITIAL = 1e-7, 1e-6


@dataclass(frozen=True, eq=False)
class GtsamSolution:
    state: State
    cost: float  # half the sum of squared whitened residuals, losses applied
    iterations: int
    converged: bool


class BlockGraph:
    """The graph of a block at a state, its values there, and what its keys stand for.

    cauchy: scales in sigmas of Cauchy losses by kind (names of constraint_terms, IMAGE_OBSERVATIONS, KINDS_OF_POINT).
    native: use GTSAM's own factors where it has them. Image observations that the state does not show are left out;
    `shown` (n,) says which are in.
    """

    def __init__(
        self, block: Block, state: State, cauchy: Mapping[str, float] | None = None, *, native: bool = True
    ) -> None:
        self.block, self.state, self.native = block, state, native
        self._cauchy = dict(cauchy or {})
        self.variables = Variables(block, state)
        self.graph, self.values = gtsam.NonlinearFactorGraph(), self.variables.values()
        self.shown: NDArray[np.bool_] = np.ones(len(block.observations), bool)
        self._add_observations()
        self._add_given_points()
        self._add_poses()
        self._add_positions()
        self._add_distances()
        self._add_weights()

    def _robust(self, noise: Noise, kind: str) -> Noise:
        if kind not in self._cauchy:
            return noise
        return gtsam.noiseModel.Robust.Create(gtsam.noiseModel.mEstimator.Cauchy.Create(self._cauchy[kind]), noise)

    def _gaussian(self, cov: Array, kind: str) -> Noise:
        return self._robust(gtsam.noiseModel.Gaussian.Covariance(cov), kind)

    def _add_observations(self) -> None:
        block, obs = self.block, self.block.observations
        views = block.views(self.state)
        pixel = views.project(obs.view, self.state.points[obs.point])
        self.shown = np.asarray(np.isfinite(pixel).all(axis=1))
        in_cam = views.to_cam(obs.view, self.state.points[obs.point])
        depth = in_cam[:, 2] / np.maximum(np.linalg.norm(in_cam, axis=1), np.finfo(float).tiny)
        mountings = [self.variables.mounting(i) for i in range(len(block.mountings))]
        lenses = [self.variables.lens(i) for i in range(len(block.calibrations))]
        for i in np.flatnonzero(self.shown):
            image = obs.view[i]
            lens, mounting = lenses[block.calibration[image]], mountings[block.mounting[image]]
            noise = self._robust(gtsam.noiseModel.Isotropic.Sigma(2, float(obs.sigma_px[i])), IMAGE_OBSERVATIONS)
            keys = int(block.station[image]), mounting
            point = self.variables.point(int(obs.point[i]))
            if self.native and lens.key is None and factors.has_native(lens.start, float(depth[i])):
                self.graph.add(factors.native_observation(obs.pixel[i], noise, *keys, lens.start, point))
            else:
                self.graph.add(factors.custom_observation(obs.pixel[i], noise, *keys, lens, point))

    def _add_given_points(self) -> None:
        priors = self.block.point_priors
        for i in range(len(priors)):
            key = self.variables.point(int(priors.point[i]))
            difference = factors.from_vector(key, priors.position[i])
            self._add_weight(key, priors.information[i], difference, KINDS_OF_POINT[priors.kind[i]])

    def _add_poses(self) -> None:
        block, priors, measured = self.block, self.block.pose_priors, self.block.relative_poses
        for i, image in enumerate(priors.image):
            station, mounting = int(block.station[image]), self.variables.mounting(int(block.mounting[image]))
            noise = self._gaussian(priors.cov[i], POSE_PRIORS)
            self.graph.add(factors.pose_prior(pose3(priors.world_from_cam[i]), noise, station, mounting))
        for i in range(len(measured)):
            noise = self._gaussian(measured.cov[i], RELATIVE_POSES)
            ends = int(measured.a[i]), int(measured.b[i])
            self.graph.add(factors.relative_pose(pose3(measured.a_from_b[i]), noise, *ends))

    def _add_positions(self) -> None:
        block, priors = self.block, self.block.position_priors
        node, weight = drift_at(block)
        for i in range(len(priors)):
            lever_m = self.variables.antenna(int(priors.antenna[i]))
            drift = [
                (self.variables.drift(int(n)), float(w)) for n, w in zip(node[i], weight[i], strict=True) if n >= 0
            ]
            noise = self._gaussian(priors.cov[i], POSITION_PRIORS)
            station = int(priors.station[i])
            self.graph.add(factors.antenna_position(priors.position[i], noise, station, lever_m, drift))

    def _add_distances(self) -> None:
        measured = self.block.distances
        for i in range(len(measured)):
            noise = self._robust(gtsam.noiseModel.Isotropic.Sigma(1, float(measured.sigma_m[i])), DISTANCES)
            ends = self.variables.point(int(measured.a[i])), self.variables.point(int(measured.b[i]))
            self.graph.add(gtsam.RangeFactor3(*ends, float(measured.distance_m[i]), noise))

    def _add_weights(self) -> None:
        block, variables = self.block, self.variables
        for i, mounting in enumerate(block.mountings):
            if mounting.information is not None and isinstance(key := variables.mounting(i), int):
                difference = factors.from_pose(key, pose3(mounting.rig_from_cam))
                self._add_weight(key, mounting.information, difference, MOUNTINGS)
        for i, calibration in enumerate(block.calibrations):
            if (key := variables.lens(i).key) is not None:
                difference = factors.from_camera(variables.lens(i), calibration.camera)
                self._add_weight(key, calibration.information, difference, CALIBRATIONS)
        for i, antenna in enumerate(block.antennas):
            if antenna.information is not None and isinstance(key := variables.antenna(i), int):
                self._add_weight(key, antenna.information, factors.from_vector(key, antenna.lever_arm_m), LEVER_ARMS)
        for i, information in enumerate(block.drift_information):
            key = variables.drift(i)
            self._add_weight(key, information, factors.from_vector(key, np.zeros(3)), DRIFT)

    def _add_weight(self, key: int, information: Array, difference: factors.Difference, kind: str) -> None:
        factor = factors.weighted(key, information, difference, lambda noise: self._robust(noise, kind))
        if factor is not None:
            self.graph.add(factor)

    # --- results ---

    def normal_equations(self) -> tuple[Array, Array]:
        """Normal matrix (u, u) and gradient (u,) of half the squares at the state: stations, then the border as in
        the layout, then the points that are eliminated one by one (3 each)."""
        linear = self.graph.linearize(self.values)
        observed, information_vector = linear.hessian()  # of variables that a factor touches, by rising key
        place = self.variables.places()
        here = np.concatenate([place[key] for key in sorted(linear.keyVector())])
        size = sum(len(p) for p in place.values())
        matrix, gradient = np.zeros((size, size)), np.zeros(size)
        matrix[np.ix_(here, here)], gradient[here] = observed, -np.asarray(information_vector)
        return matrix, gradient

    def reduced(self) -> tuple[Array, Array]:
        """Normal matrix (n, n) and gradient (n,) of the reduced system in the order of its layout."""
        matrix, gradient = self.normal_equations()
        n = Layout.of(self.block).size
        eliminated = np.linalg.solve(matrix[n:, n:], np.column_stack([matrix[n:, :n], gradient[n:]]))
        reduced = matrix[:n, :n] - matrix[:n, n:] @ eliminated[:, :n]
        return 0.5 * (reduced + reduced.T), gradient[:n] - matrix[:n, n:] @ eliminated[:, n]

    def station_covariances(self) -> Array:
        """Posterior covariances (S, 6, 6) of stations by gtsam.Marginals, at the state."""
        marginals = gtsam.Marginals(self.graph, self.values)
        return np.array([marginals.marginalCovariance(i) for i in range(len(self.block.station_ids))])


def solve_with_gtsam(
    block: Block,
    state: State | None = None,
    *,
    cauchy: Mapping[str, float] | None = None,
    max_iterations: int = 50,
    native: bool = True,
) -> GtsamSolution:
    """Minimises the weighted squares of a block by GTSAM's Levenberg-Marquardt, from a state or its approximate values.

    Stops when no pose changes by more than 1e-7 (m, rad).
    """
    built = BlockGraph(block, state or block.start(), cauchy, native=native)
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setlambdaInitial(_LAMBDA_INITIAL)
    parameters.setLinearSolverType("MULTIFRONTAL_CHOLESKY")
    optimizer = gtsam.LevenbergMarquardtOptimizer(built.graph, built.values, parameters)
    before, converged = built.state.world_from_rig, False
    for _ in range(max_iterations):
        optimizer.iterate()
        after = built.variables.state_of(optimizer.values()).world_from_rig
        # LM's own test stops early along weak datum modes: the largest change of a pose decides.
        step = float(np.abs(before.local(after)).max(initial=0.0))
        before = after
        if step < _STEP_TOLERANCE:
            converged = True
            break
    solved = optimizer.values()
    return GtsamSolution(
        built.variables.state_of(solved), float(built.graph.error(solved)), int(optimizer.iterations()), converged
    )
