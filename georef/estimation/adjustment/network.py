"""Images with given exterior orientations adjusted so that the orientations are judged, not gated.

Every image is a station by itself. Image observations have their loss and gate; the orientations are weighted
observations that stay whatever they say, so that their residuals tell what sigmas they deserve.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from georef.config import AdjustConfig
from georef.estimation.adjustment.adjust_block import SETTLED_SHARE, Quality, quality
from georef.estimation.adjustment.block import KINDS_OF_POSE, Block, Calibration, PosePriors, RigCamera, State
from georef.estimation.adjustment.equations.eliminate import IMAGE_OBSERVATIONS
from georef.estimation.adjustment.equations.prepared import Prepared
from georef.estimation.adjustment.quality.components import Component
from georef.estimation.adjustment.quality.group_tests import TermTests
from georef.estimation.adjustment.solver import SolverOptions, solve_block
from georef.geometry.camera import Camera
from georef.geometry.poses import Poses
from georef.geometry.rigid import Array, Rigid3
from georef.types.scene import Observations

ORIENTATION = KINDS_OF_POSE[1]
_GATE_ROUNDS, _ROBUST_ROUNDS = 3, 2
_ROBUST_COST_TOLERANCE = 1e-5
_FAR_OFF = 1.25  # of a sigma against its residuals
_FACTOR_TOLERANCE = 0.01
_GROSS = 1e-3  # share of the false alarms of a gate that the first one may give: a robust solution is not the best one


@dataclass(frozen=True, eq=False)
class AdjustedNetwork:
    """A network that was solved: what passed the gate, with image sigmas scaled by their variance component.

    sigma_scale: of the image observations, against the network as it was given.
    """

    block: Block
    state: State
    quality: Quality
    sigma_scale: float

    @property
    def components(self) -> dict[str, Component]:
        """Variance components of positions and rotations of the orientations, each for itself, and of the images."""
        images = self.quality.components[IMAGE_OBSERVATIONS]
        return {**orientation_components(self.quality), "image_observations": images}


def orientation_components(found: Quality) -> dict[str, Component]:
    """Variance components of positions and of rotations of given orientations whose covariances do not mix them."""
    rotation, position = (_part(_orientations(found), part) for part in (slice(3), slice(3, 6)))
    return {"reference_position": position, "reference_rotation": rotation}


def worst_orientation(block: Block, found: Quality, probability: float) -> int | None:
    """The image whose given orientation contradicts the rest most; None if all pass at a probability that good ones
    pass."""
    test = _orientations(found)
    statistic = np.where(test.rejected(probability), test.statistic, -np.inf)
    worst = int(np.argmax(statistic))
    return int(block.pose_priors.image[test.row[worst]]) if np.isfinite(statistic[worst]) else None


def _orientations(found: Quality) -> TermTests:
    return next(test for test in found.constraints if test.name == ORIENTATION)


def network_block(
    cameras: Sequence[Camera], world_from_cams: Sequence[Rigid3], covs: Array, points: Array, observations: Observations
) -> Block:
    """The block of M images at their given exterior orientations with covariances (M, 6, 6); cameras are held."""
    ids, every = tuple(str(i) for i in range(len(cameras))), np.arange(len(cameras))
    different = list(dict.fromkeys(cameras))
    given, kind = Poses.of(world_from_cams), np.full(len(cameras), KINDS_OF_POSE.index(ORIENTATION))
    return Block(
        station_ids=ids,
        image_ids=ids,
        station=every,
        mounting=np.zeros(len(cameras), np.int64),
        calibration=np.array([different.index(camera) for camera in cameras], dtype=np.int64),
        mountings=(RigCamera("alone", Rigid3.identity()),),
        calibrations=tuple(Calibration.held(camera) for camera in different),
        world_from_rig=given,
        points=points,
        observations=observations,
        pose_priors=PosePriors(every, given, covs, kind),
    )


def adjust_network(block: Block, config: AdjustConfig) -> AdjustedNetwork:
    """Solves a network with a gate for image observations alone; raises GeorefError where the datum is open.

    The image sigmas are scaled by their own variance component; those of the orientations stay.
    """
    given, options = len(block.observations), SolverOptions(max_iterations=config.max_iterations)
    network = _robust(block, config, options)
    network = _solved(_gated(network, 1.0 - _GROSS * (1.0 - config.gate_probability)), network, options)
    network = _rescaled(network, options)
    for _ in range(_GATE_ROUNDS):
        gated = _gated(network, config.gate_probability)
        if len(network.block.observations) - len(gated.observations) <= SETTLED_SHARE * given:
            break
        network = _solved(gated, network, options)
    return _rescaled(network, options)


def _robust(block: Block, config: AdjustConfig, options: SolverOptions) -> AdjustedNetwork:
    """The robust solution, with image sigmas near what the residuals show: a loss far too narrow fits too few."""
    losses, scale = {IMAGE_OBSERVATIONS: config.cauchy_scale}, 1.0
    options = replace(options, cost_tolerance=_ROBUST_COST_TOLERANCE)
    state = block.start()
    for _ in range(1 + _ROBUST_ROUNDS):
        prepared = Prepared.of(block)
        state = solve_block(block, losses=losses, options=options, start=state, prepared=prepared).state
        found = quality(block, state, prepared)
        factor = min(max(found.images.scale, 0.1), 10.0)
        if 1.0 / _FAR_OFF < factor < _FAR_OFF:
            return AdjustedNetwork(block, state, found, scale)
        block, scale = replace(block, observations=block.observations.scaled(factor)), scale * factor
    return AdjustedNetwork(block, state, quality(block, state), scale)


def _solved(block: Block, before: AdjustedNetwork, options: SolverOptions) -> AdjustedNetwork:
    prepared = Prepared.of(block)
    state = solve_block(block, options=options, start=before.state, prepared=prepared).state
    return AdjustedNetwork(block, state, quality(block, state, prepared), before.sigma_scale)


def _gated(network: AdjustedNetwork, probability: float) -> Block:
    """The block without image observations that contradict the rest, and without rays that are left alone."""
    images, obs = network.quality.images, network.block.observations
    obs = obs.take(~images.rejected(probability, images.scale))
    rays = np.bincount(obs.point, minlength=len(network.block.points))
    return replace(network.block, observations=obs.take(rays[obs.point] > 1))


def _rescaled(network: AdjustedNetwork, options: SolverOptions) -> AdjustedNetwork:
    """The image sigmas brought to what the residuals show, and the solution for them."""
    factor = network.quality.components[IMAGE_OBSERVATIONS].factor
    if factor is None or abs(factor - 1.0) < _FACTOR_TOLERANCE:
        return network
    block = replace(network.block, observations=network.block.observations.scaled(factor))
    return replace(_solved(block, network, options), sigma_scale=network.sigma_scale * factor)


def _part(test: TermTests, rows: slice) -> Component:
    """The component of rows of each constraint that are whitened by themselves."""
    return Component(
        int(test.weighted[:, rows].sum()),
        float(np.trace(test.cofactor[:, rows, rows], axis1=1, axis2=2).sum()),
        float(np.sum(np.square(test.residual[:, rows]))),
    )
