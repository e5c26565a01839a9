"""The weighted constraints of a block, linearised at a state: all kinds but coordinates of points.

Given coordinates of points are not here: they enter where points are eliminated. Residuals are estimated minus
reference, whitened, so that the cost of a block is half the sum of their squares (before any robust loss).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import cast

import numpy as np

from georef.estimation.adjustment.block import Block, Indices, State
from georef.estimation.adjustment.equations.reduced import Layout
from georef.geometry.pose_jacobians import inverse_right_jacobians
from georef.geometry.poses import Poses
from georef.geometry.rigid import Array, skew

Columns = tuple[tuple[Indices, Array], ...]
POSE_PRIORS, POSITION_PRIORS, RELATIVE_POSES, DISTANCES = "pose priors", "GNSS positions", "relative poses", "distances"
MOUNTINGS, CALIBRATIONS, LEVER_ARMS, DRIFT = "mountings", "calibrations", "lever arms", "drift"


@dataclass(frozen=True, eq=False)
class Term:
    """K constraints of one kind with m residuals each.

    columns: for each group of s unknowns the index of its first in the reduced system (K,), -1 where it is held or
    absent, and the whitened derivative by it (K, m, s). The groups of one row differ. Weights that leave a direction
    free have rows of zeros.
    """

    name: str  # one of the kinds above
    residual: Array  # (K, m)
    columns: Columns
    row: Indices  # (K,) where each stands in its list of the block: a prior, a mounting, a calibration ...


def constraint_terms(block: Block, state: State, layout: Layout | None = None) -> list[Term]:
    """All constraints at a state. Covariances must be positive definite (numpy.linalg.LinAlgError otherwise);
    information may have any rank."""
    layout = layout or Layout.of(block)
    terms = [
        _pose_priors(block, state, layout),
        _position_priors(block, state, layout),
        _relative_poses(block, state, layout),
        _distances(block, state, layout),
        _mountings(block, state, layout),
        *_calibrations(block, state, layout),
        _lever_arms(block, state, layout),
        _drift(block, state, layout),
    ]
    return [term for term in terms if len(term.row)]


def dense_columns(columns: Columns, rows: Indices, width: int, size: int) -> Array:
    """Derivatives (U, k m), by all U = size unknowns of the reduced system, of chosen rows of constraints."""
    out = np.zeros((size, len(rows), width))
    for first, by in columns:
        here = np.flatnonzero(first[rows] >= 0)
        at = first[rows[here]][:, None] + np.arange(by.shape[2])
        out[at[:, :, None], here[:, None, None], np.arange(width)] = np.swapaxes(by[rows[here]], 1, 2)
    return out.reshape(size, -1)


def whitening(cov: Array) -> Array:
    """W (K, m, m) with W' W the inverse of covariances (K, m, m)."""
    return cast(Array, np.linalg.inv(np.linalg.cholesky(cov)))


def root(information: Array) -> Array:
    """W (K, m, m) with W' W = information (K, m, m), of any rank."""
    values, vectors = np.linalg.eigh(information)
    return np.sqrt(np.maximum(values, 0.0))[:, :, None] * np.swapaxes(vectors, 1, 2)


def _term(name: str, weight: Array, residual: Array, columns: Columns, row: Indices | None = None) -> Term:
    """Residuals (K, m) and derivatives whitened by W (K, m, m)."""
    whitened = tuple((first, np.ascontiguousarray(weight @ by)) for first, by in columns)
    return Term(
        name, np.einsum("kij,kj->ki", weight, residual), whitened, np.arange(len(residual)) if row is None else row
    )


def _in_border(layout: Layout, first: Indices) -> Indices:
    return np.where(first >= 0, 6 * layout.stations + first, -1)


def _pose_priors(block: Block, state: State, layout: Layout) -> Term:
    priors = block.pose_priors
    station, mounting = block.station[priors.image], block.mounting[priors.image]
    rig_from_cam = state.rig_from_cam.take(mounting)
    residual = priors.world_from_cam.local(state.world_from_rig.take(station) @ rig_from_cam)
    by_cam = inverse_right_jacobians(residual)
    columns = (
        (6 * station, by_cam @ rig_from_cam.inverse().adjoint()),
        (_in_border(layout, layout.mounting[mounting]), by_cam),
    )
    return _term(POSE_PRIORS, whitening(priors.cov), residual, columns)


def _position_priors(block: Block, state: State, layout: Layout) -> Term:
    priors = block.position_priors
    poses, lever_m = state.world_from_rig.take(priors.station), state.lever_arms_m[priors.antenna]
    node, weight = drift_at(block)
    by_drift = weight[:, :, None, None] * np.eye(3)
    columns = (
        (6 * priors.station, np.concatenate([-poses.rotation @ skew(lever_m), poses.rotation], axis=2)),
        (_in_border(layout, layout.antenna[priors.antenna]), poses.rotation),
        *(
            (_in_border(layout, np.where(node[:, n] >= 0, _first(layout.drift, node[:, n]), -1)), by_drift[:, n])
            for n in range(2)
        ),
    )
    return _term(POSITION_PRIORS, whitening(priors.cov), position_residuals(block, state), columns)


def position_residuals(block: Block, state: State) -> Array:
    """Adjusted less measured positions (K, 3) of antennas, the estimated drift taken off."""
    priors, (node, weight) = block.position_priors, drift_at(block)
    residual = state.world_from_rig.take(priors.station).apply(state.lever_arms_m[priors.antenna]) - priors.position
    if len(state.drift_m):
        residual = residual + np.einsum("kn,kni->ki", weight, state.drift_m[node])
    return residual


def drift_at(block: Block) -> tuple[Indices, Array]:
    """Drift nodes (K, 2) of positions, -1: none, and their weights (K, 2); one node named twice is taken once."""
    node, weight = block.position_priors.drift_node.copy(), block.position_priors.drift_weight.copy()
    weight[node < 0] = 0.0
    twice = (node[:, 0] == node[:, 1]) & (node[:, 0] >= 0)
    weight[twice, 0] += weight[twice, 1]
    weight[twice, 1], node[twice, 1] = 0.0, -1
    return node, weight


def _first(starts: Indices, index: Indices) -> Indices:
    """starts[index], -1 for all where there is nothing to index."""
    return starts[index] if len(starts) else np.full(len(index), -1)


def _relative_poses(block: Block, state: State, layout: Layout) -> Term:
    measured = block.relative_poses
    a_from_b = state.world_from_rig.take(measured.a).inverse() @ state.world_from_rig.take(measured.b)
    residual = measured.a_from_b.local(a_from_b)
    by_b = inverse_right_jacobians(residual)
    columns = ((6 * measured.a, -by_b @ a_from_b.inverse().adjoint()), (6 * measured.b, by_b))
    return _term(RELATIVE_POSES, whitening(measured.cov), residual, columns)


def _distances(block: Block, state: State, layout: Layout) -> Term:
    """Points that coincide have no direction between them: their derivative is zero."""
    measured = block.distances
    between = state.points[measured.a] - state.points[measured.b]
    length = np.linalg.norm(between, axis=1, keepdims=True)
    by_a = (between / np.where(length > 0.0, length, 1.0))[:, None, :]
    columns = tuple(
        (_in_border(layout, layout.kept_point[end]), by) for end, by in ((measured.a, by_a), (measured.b, -by_a))
    )
    weight = (1.0 / measured.sigma_m)[:, None, None]
    return _term(DISTANCES, weight, length - measured.distance_m[:, None], columns)


def _mountings(block: Block, state: State, layout: Layout) -> Term:
    row = np.flatnonzero(layout.mounting >= 0)
    information = [i for m in block.mountings if (i := m.information) is not None]
    given = Poses.of(block.mountings[i].rig_from_cam for i in row)
    residual = given.local(state.rig_from_cam.take(row))
    columns = ((_in_border(layout, layout.mounting[row]), inverse_right_jacobians(residual)),)
    return _term(MOUNTINGS, root(_stacked(information, 6)), residual, columns, row)


def _calibrations(block: Block, state: State, layout: Layout) -> Iterator[Term]:
    """One term for each number of unknown parameters."""
    counts = np.array([len(c.camera.estimate) for c in block.calibrations])
    for count in sorted(set(counts[counts > 0].tolist())):
        row = np.flatnonzero(counts == count)
        given, current = [block.calibrations[i] for i in row], [state.cameras[i] for i in row]
        pairs = [(c, g.camera) for c, g in zip(current, given, strict=True)]
        residual = np.array([c.steps_since(g, g.estimate) for c, g in pairs])
        rates = np.array([[c.unit(name) / g.unit(name) for name in g.estimate] for c, g in pairs])
        logarithmic = np.array([[name in ("focal", "aspect") for name in g.estimate] for _, g in pairs])
        by_step = np.where(logarithmic, 1.0, rates)[:, :, None] * np.eye(count)
        columns = ((_in_border(layout, layout.calibration[row]), by_step),)
        yield _term(CALIBRATIONS, root(np.stack([c.information for c in given])), residual, columns, row)


def _lever_arms(block: Block, state: State, layout: Layout) -> Term:
    row = np.flatnonzero(layout.antenna >= 0)
    information = [i for a in block.antennas if (i := a.information) is not None]
    given = block.start().lever_arms_m[row]
    columns = ((_in_border(layout, layout.antenna[row]), _identities(len(row))),)
    return _term(LEVER_ARMS, root(_stacked(information, 3)), state.lever_arms_m[row] - given, columns, row)


def _drift(block: Block, state: State, layout: Layout) -> Term:
    columns = ((_in_border(layout, layout.drift), _identities(len(state.drift_m))),)
    return _term(DRIFT, root(block.drift_information), state.drift_m, columns)


def _stacked(information: list[Array], size: int) -> Array:
    return np.array(information, dtype=np.float64).reshape(-1, size, size)


def _identities(count: int) -> Array:
    return cast(Array, np.tile(np.eye(3), (count, 1, 1)))
