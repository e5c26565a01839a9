"""Reliability of given coordinates and poses: how well each is checked, and what an error that is not found would do.

Internal reliability: the minimal detectable bias, found with a probability of 1 - beta0 by a test that rejects good
observations with alpha0. External: what a bias of that size does to the adjusted coordinate itself. Baarda (1968):
delta0 = 4.13 for alpha0 = 0.001 and beta0 = 0.20.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import numpy as np
from scipy.stats import norm

from georef.estimation.adjustment.block import KINDS_OF_POSE, Block
from georef.estimation.adjustment.constraint_terms import POSITION_PRIORS, root, whitening
from georef.estimation.adjustment.group_tests import TermTests
from georef.geometry.rigid import Array

ALPHA0, BETA0 = 0.001, 0.20
DELTA0 = float(norm.ppf(1.0 - 0.5 * ALPHA0) + norm.ppf(1.0 - BETA0))
_CHECKED = 0.01  # a redundancy number below it: next to nothing checks the observation


@dataclass(frozen=True, eq=False)
class Reliability:
    """Of K observations with m components each, in world axes: east, north, up in m; poses have three rotations in rad
    about these axes before. NaN where a component has no weight; what nothing checks has a redundancy number near 0
    and an infinite bias.
    """

    name: str
    ids: tuple[str, ...]  # of points, stations (GNSS) or images (poses)
    residual: Array  # (K, m) estimated minus given
    redundancy: Array  # (K, m) redundancy numbers, 0 to 1 for uncorrelated components
    w: Array  # (K, m) Baarda's w, of unit variance where all is well
    detectable: Array  # (K, m) minimal detectable bias
    effect: Array  # (K, m) how far it would move the adjusted position of the same observation, m
    distortion: Array  # (K, m) what it would move any function of the unknowns by at most, in its sigmas


def reliability(block: Block, test: TermTests) -> Reliability:
    """Of pose priors, GNSS positions or given points, from their tests; other kinds raise KeyError."""
    weight, axes, ids = _given(block, test)
    turned = np.swapaxes(axes, 1, 2)
    weight = weight @ turned  # whitens residuals in world axes
    information = np.swapaxes(weight, 1, 2) @ weight
    checked = np.swapaxes(weight, 1, 2) @ test.cofactor @ weight  # P Qvv P
    power = _diagonal(checked)
    weighted = _diagonal(information) > 0.0
    # Qvv P in the observation's own units: W^-1 Qvv_w W, where rows without weight stay out.
    redundant = np.linalg.pinv(weight) @ test.cofactor @ weight
    redundancy = np.where(weighted, _diagonal(redundant), np.nan)
    found = weighted & (redundancy > _CHECKED)
    with np.errstate(divide="ignore", invalid="ignore"):
        sigma = np.sqrt(power)
        w = np.einsum("kji,kj->ki", weight, test.residual) / sigma
        bias = np.where(found, DELTA0 / sigma, np.where(weighted, np.inf, np.nan))
        moved = np.linalg.norm((np.eye(weight.shape[2]) - redundant)[:, -3:], axis=1) * bias
        lost = np.sqrt(np.maximum(_diagonal(information) - power, 0.0)) * bias
    residual = np.einsum("kij,kj->ki", np.linalg.pinv(weight), test.residual)
    return Reliability(
        *(test.name, ids, np.where(weighted, residual, np.nan), redundancy),
        *(np.where(found, w, np.nan), bias, np.where(weighted, moved, np.nan), np.where(weighted, lost, np.nan)),
    )


def _given(block: Block, test: TermTests) -> tuple[Array, Array, tuple[str, ...]]:
    """What whitened the residuals (K, m, m), rotations (K, m, m) from their axes to the world's, and names."""
    count = len(test.row)
    if test.name in KINDS_OF_POSE:
        priors = block.pose_priors
        axes = np.zeros((count, 6, 6))
        axes[:, :3, :3] = axes[:, 3:, 3:] = priors.world_from_cam.rotation[test.row]
        return whitening(priors.cov[test.row]), axes, tuple(block.image_ids[i] for i in priors.image[test.row])
    world = cast(Array, np.tile(np.eye(3), (count, 1, 1)))
    if test.name == POSITION_PRIORS:
        positions = block.position_priors
        names = tuple(block.station_ids[i] for i in positions.station[test.row])
        return whitening(positions.cov[test.row]), world, names
    if test.name not in ("control", "automatic"):
        raise KeyError(f"no reliability of {test.name!r} observations by coordinate")
    names = tuple(block.point_priors.point_ids[i] for i in test.row)
    return root(block.point_priors.information[test.row]), world, names


def _diagonal(matrices: Array) -> Array:
    return np.diagonal(matrices, axis1=1, axis2=2)
