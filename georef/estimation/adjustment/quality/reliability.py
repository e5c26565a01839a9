"""Reliability of given coordinates and poses: how well each is checked, and what an error that is not found would do.

Internal reliability: the minimal detectable bias, found with a probability of 1 - beta0 by a test that rejects good
observations with alpha0. External: what a bias of that size does to the adjusted coordinate itself. Baarda (1968):
delta0 = 4.13 for alpha0 = 0.001 and beta0 = 0.20. Correlated components have the numbers of Schaffrin (1997),
"Reliability measures for correlated observations": those of the plain formula may be negative or above 1.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import cast

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm

from georef.estimation.adjustment.block import KINDS_OF_POINT, KINDS_OF_POSE, Block, Indices, State
from georef.estimation.adjustment.equations.constraint_terms import POSITION_PRIORS, root, whitening
from georef.estimation.adjustment.quality.group_tests import TermTests
from georef.geometry.rigid import Array

ALPHA0, BETA0 = 0.001, 0.20
DELTA0 = float(norm.ppf(1.0 - 0.5 * ALPHA0) + norm.ppf(1.0 - BETA0))
NO_WEIGHT = 1e-9  # of the largest weight of a constraint: below it a coordinate has none
_CHUNK = 50_000  # observations at a time
_CHECKED = 0.01  # a redundancy number below it: next to nothing checks the observation


@dataclass(frozen=True, eq=False)
class Reliability:
    """Of K observations with m components each, along the axes asked for (the world's: east, north, up), in m; poses
    have three rotations in rad about these axes before. NaN where a component has no weight; what nothing checks has a
    redundancy number near 0 and an infinite bias.
    """

    name: str
    ids: tuple[str, ...]  # of points, stations (GNSS) or images (poses)
    place: Array  # (K, 3) in world, adjusted: of the point, the antenna or the projection centre
    residual: Array  # (K, m) estimated minus given
    redundancy: Array  # (K, m) (P Qvv P)_ii / P_ii, 0 to 1: the redundancy number where components are uncorrelated
    w: Array  # (K, m) Baarda's w, of unit variance where all is well
    detectable: Array  # (K, m) minimal detectable bias
    effect: Array  # (K, m) how far it would move the adjusted position of the same observation, m
    distortion: Array  # (K, m) what it would move any function of the unknowns by at most, in its sigmas
    sigma: Array  # (K, m) given 1-sigma
    statistic: Array  # (K,) of all components together
    dof: NDArray[np.int64]  # (K,)

    def __len__(self) -> int:
        return len(self.ids)


Axes = Callable[[Array], Array]
"""Rotations (K, 3, 3) from world axes to the axes wanted at places (K, 3) in world."""


def reliability(block: Block, state: State, test: TermTests, axes: Axes | None = None) -> Reliability:
    """Of pose priors, GNSS positions or given points, from their tests; other kinds raise KeyError."""
    parts = [_part(block, state, _rows(test, rows), axes) for rows in _chunks(len(test.row))]
    columns = {f.name: [getattr(part, f.name) for part in parts] for f in fields(Reliability)[2:]}
    joined = {name: np.concatenate(values) for name, values in columns.items()}
    return Reliability(test.name, tuple(name for part in parts for name in part.ids), **joined)


def _chunks(count: int) -> list[Indices]:
    return np.array_split(np.arange(count), 1 + count // _CHUNK)


def _rows(test: TermTests, rows: Indices) -> TermTests:
    arrays = {f.name: getattr(test, f.name)[rows] for f in fields(TermTests) if f.name != "name"}
    return replace(test, **arrays)


def _part(block: Block, state: State, test: TermTests, axes: Axes | None) -> Reliability:
    weight, own_axes, ids, place = _given(block, state, test)
    if axes is not None:
        own_axes = _on_diagonal(axes(place), own_axes.shape[1]) @ own_axes
    weight = weight @ np.swapaxes(own_axes, 1, 2)  # whitens residuals along the axes wanted
    information = np.swapaxes(weight, 1, 2) @ weight
    checked = np.swapaxes(weight, 1, 2) @ test.cofactor @ weight  # P Qvv P
    power = _diagonal(checked)
    given = _diagonal(information)
    weighted = given > NO_WEIGHT * given.max(axis=1, keepdims=True, initial=0.0)
    # Qvv P in the observation's own units: W^-1 Qvv_w W, where rows without weight stay out.
    back = np.linalg.pinv(weight)
    redundant = back @ test.cofactor @ weight
    with np.errstate(divide="ignore", invalid="ignore"):
        redundancy = np.where(weighted, np.maximum(power, 0.0) / _diagonal(information), np.nan)
        found = weighted & (redundancy > _CHECKED)
        sigma = np.sqrt(power)
        w = np.einsum("kji,kj->ki", weight, test.residual) / sigma
        bias = np.where(found, DELTA0 / sigma, np.where(weighted, np.inf, np.nan))
        moved = np.linalg.norm((np.eye(weight.shape[2]) - redundant)[:, -3:], axis=1) * bias
        lost = np.sqrt(np.maximum(_diagonal(information) - power, 0.0)) * bias
    residual = np.einsum("kij,kj->ki", back, test.residual)
    sigma = np.sqrt(np.einsum("kij,kij->ki", back, back))
    return Reliability(
        *(test.name, ids, place, np.where(weighted, residual, np.nan), redundancy),
        *(np.where(found, w, np.nan), bias, np.where(weighted, moved, np.nan), np.where(weighted, lost, np.nan)),
        *(np.where(weighted, sigma, np.nan), test.statistic, test.dof),
    )


def _given(block: Block, state: State, test: TermTests) -> tuple[Array, Array, tuple[str, ...], Array]:
    """What whitened residuals (K, m, m), rotations (K, m, m) from their axes to the world's, names, places (K, 3)."""
    count = len(test.row)
    if test.name in KINDS_OF_POSE:
        priors, images = block.pose_priors, block.pose_priors.image[test.row]
        axes = _on_diagonal(priors.world_from_cam.rotation[test.row], 6)
        pose = state.world_from_rig.take(block.station[images]) @ state.rig_from_cam.take(block.mounting[images])
        return whitening(priors.cov[test.row]), axes, tuple(block.image_ids[i] for i in images), pose.translation
    world = cast(Array, np.tile(np.eye(3), (count, 1, 1)))
    if test.name == POSITION_PRIORS:
        positions, stations = block.position_priors, block.position_priors.station[test.row]
        antenna = state.world_from_rig.take(stations).apply(state.lever_arms_m[positions.antenna[test.row]])
        return whitening(positions.cov[test.row]), world, tuple(block.station_ids[i] for i in stations), antenna
    if test.name not in KINDS_OF_POINT:
        raise KeyError(f"no reliability of {test.name!r} observations by coordinate")
    names = tuple(block.point_priors.point_ids[i] for i in test.row)
    place = state.points[block.point_priors.point[test.row]]
    return root(block.point_priors.information[test.row]), world, names, place


def _on_diagonal(rotation: Array, size: int) -> Array:
    """Rotations (K, 3, 3) as such of vectors of 3 or 6 components, three and three."""
    if size == 3:
        return rotation
    out = np.zeros((len(rotation), 6, 6))
    out[:, :3, :3] = out[:, 3:, 3:] = rotation
    return out


def _diagonal(matrices: Array) -> Array:
    return np.diagonal(matrices, axis1=1, axis2=2)
