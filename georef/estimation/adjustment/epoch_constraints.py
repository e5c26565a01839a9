"""What is measured beside the images of an epoch, added to its block: antenna, offset, motions, lengths, lenses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import cast

import numpy as np
from numpy.typing import NDArray

from georef.estimation.adjustment.block import (
    Antenna,
    Block,
    Calibration,
    Distances,
    Indices,
    PositionPriors,
    RelativePoses,
)
from georef.geometry.camera import Camera
from georef.geometry.poses import Poses
from georef.geometry.rigid import Array, Rigid3
from georef.geometry.triangulation import triangulate
from georef.types.scene import Observations


@dataclass(frozen=True, eq=False)
class GnssOffset:
    """An offset of GNSS: constant, or linear between nodes at places (D,) rising, in time or along the stations.

    information: (3, 3), inverse covariance about no offset, of each node; zeros: free. at: (S,) place of each station.
    """

    information: Array
    nodes: Array
    at: Array


def with_antenna(block: Block, antenna: Antenna) -> Block:
    """Positions are of this antenna on the rig. Fixes of several images of one station are one: combined by weight."""
    priors = block.position_priors
    stations = np.unique(priors.station)
    position, cov = np.zeros((len(stations), 3)), np.zeros((len(stations), 3, 3))
    for k, station in enumerate(stations):
        rows = np.flatnonzero(priors.station == station)
        weights = np.linalg.inv(priors.cov[rows])
        cov[k] = np.linalg.inv(weights.sum(axis=0))
        position[k] = cov[k] @ np.einsum("kij,kj->i", weights, priors.position[rows])
    count = len(stations)
    own = PositionPriors(
        *(stations, position, cov, np.full(count, len(block.antennas))),
        *(np.full((count, 2), -1), np.zeros((count, 2))),
    )
    return replace(block, position_priors=own, antennas=(*block.antennas, antenna))


def with_gnss_offset(block: Block, offset: GnssOffset) -> Block:
    """Positions share an unknown offset. Nodes that no position depends on are left out."""
    priors, nodes = block.position_priors, offset.nodes
    node, weight = np.full((len(priors), 2), -1), np.zeros((len(priors), 2))
    node[:, 0], weight[:, 0] = 0, 1.0
    if len(nodes) > 1:
        at = np.clip(offset.at[priors.station], nodes[0], nodes[-1])
        before = np.clip(np.searchsorted(nodes, at, side="right") - 1, 0, len(nodes) - 2)
        share = (at - nodes[before]) / (nodes[before + 1] - nodes[before])
        node, weight = np.column_stack([before, before + 1]), np.column_stack([1.0 - share, share])
    used = np.unique(node[weight > 0.0])
    number = np.full(len(nodes), -1)
    number[used] = np.arange(len(used))
    return replace(
        block,
        position_priors=replace(priors, drift_node=np.where(weight > 0.0, number[node], -1), drift_weight=weight),
        drift_information=np.tile(offset.information, (len(used), 1, 1)),
    )


def with_motions(block: Block, a: Indices, b: Indices, a_from_b: Sequence[Rigid3], cov: Array) -> Block:
    """Measured motions between stations a and b (K,)."""
    return replace(block, relative_poses=RelativePoses(a, b, Poses.of(a_from_b), cov))


def with_calibrations(block: Block, sigmas: Mapping[str, Mapping[str, float]]) -> Block:
    """Cameras whose named parameters are estimated with these 1-sigmas, in their own units (inf: freely); others stay
    held. Cameras that localization has estimated are left as they are: no keypoint of theirs takes part."""
    estimated = tuple(
        _estimated(calibration, sigmas.get(calibration.camera.camera_id, {})) for calibration in block.calibrations
    )
    return replace(block, calibrations=estimated)


def _estimated(calibration: Calibration, sigmas: Mapping[str, float]) -> Calibration:
    names = tuple(sigmas)
    if not names:
        return calibration
    camera: Camera = replace(calibration.camera, estimate=names)
    steps = np.array([sigmas[name] / camera.unit(name) for name in names])
    return Calibration(camera, np.diag(1.0 / np.square(steps)))


def with_held_mountings(block: Block) -> Block:
    """Every camera of a rig exactly where the calibration has it."""
    return replace(block, mountings=tuple(replace(m, information=None) for m in block.mountings))


def with_marked_points(block: Block, marks: Observations, count: int) -> tuple[Block, Indices]:
    """The block with `count` more points that are marked in its images, and their places (count,), -1: not determined.

    marks: point is 0 to count - 1, view an image of the block.
    """
    found = triangulate(block.views(block.start()), marks.point, marks.view, marks.pixel, marks.sigma_px, count)
    known = cast(NDArray[np.bool_], np.isfinite(found.points).all(axis=1))
    place = np.where(known, len(block.points) + np.cumsum(known) - 1, -1)
    kept = marks.take(known[marks.point])
    observations = Observations.joined([block.observations, kept.with_points(place[kept.point])])
    points = np.concatenate([block.points, found.points[known]])
    return replace(block, points=points, observations=observations), place


def with_distances(block: Block, a: Indices, b: Indices, distance_m: Array, sigma_m: Array) -> Block:
    """Measured distances between points a and b (K,)."""
    return replace(block, distances=Distances(a, b, distance_m, sigma_m))
