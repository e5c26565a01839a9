"""Errors that neighbours share told apart from those of each image, and not invented where there are none."""

from __future__ import annotations

import numpy as np
import pytest

from georef.estimation.smooth_errors import Residuals, smooth_errors
from georef.geometry.rigid import Array

IMAGES, SPACING_M = 30, 3.0
SEEDS = 6


def residuals(seed: int, own: float, smooth: float) -> Residuals:
    """Images along a street whose relative orientations are measured well: residuals in units of the sigmas.

    own, smooth: true errors in those units; what is common to all is not observable, as in a real network.
    """
    rng = np.random.default_rng(seed)
    place = SPACING_M * np.arange(IMAGES)
    distance = np.abs(place[:, None] - place)
    relative = np.zeros((IMAGES, IMAGES))
    for reach in range(1, 4):
        for i in range(IMAGES - reach):
            difference = np.zeros(IMAGES)
            difference[[i, i + reach]] = -1.0, 1.0
            relative += 40.0 * np.outer(difference, difference)
    information = np.kron(relative, np.eye(6))
    cofactors: Array = np.linalg.inv(information + np.eye(6 * IMAGES)).astype(np.float64)
    alike = np.exp(-0.5 * (distance / 12.0) ** 2) + 1e-9 * np.eye(IMAGES)
    error = own * rng.normal(size=(IMAGES, 6)) + smooth * np.linalg.cholesky(alike) @ rng.normal(size=(IMAGES, 6))
    values, vectors = np.linalg.eigh(information)
    image_part = vectors @ (np.sqrt(np.maximum(values, 0.0)) * rng.normal(size=6 * IMAGES))
    found = cofactors @ (error.ravel() + image_part)  # adjusted minus true
    shared = np.maximum(0, 100 - 20 * (distance / SPACING_M)).astype(int) * (1 - np.eye(IMAGES, dtype=int))
    return Residuals(error.ravel() - found, cofactors, distance, 0.1 * distance / SPACING_M, shared)


def estimates(own: float, smooth: float) -> list[Array | None]:
    """Own position, own rotation and smooth position in units of the sigmas, of several draws."""
    out = []
    for seed in range(SEEDS):
        found = smooth_errors(residuals(seed, own, smooth), 0.01, 2e-4)
        if found is None:
            out.append(None)
        else:
            out.append(np.array([found.own_position_m / 0.01, found.own_rotation_rad / 2e-4, found.position_m / 0.01]))
    return out


@pytest.mark.parametrize("own", [0.4, 0.8])
def test_own_errors_are_found_beside_larger_smooth_ones(own: float) -> None:
    found = [part for part in estimates(own, 1.5) if part is not None]
    assert len(found) == SEEDS
    mean = np.mean(found, axis=0)
    assert 0.8 * own < mean[0] < 1.2 * own, mean
    assert 0.8 * own < mean[1] < 1.2 * own, mean
    assert 0.7 < mean[2] < 2.5, mean


def test_independent_errors_stay_whole() -> None:
    assert [part for part in estimates(1.0, 0.0) if part is not None] == []


def test_images_that_share_nothing_tell_nothing() -> None:
    made = residuals(0, 0.4, 1.5)
    alone = Residuals(made.values, made.cofactors, made.distance, made.angle, np.zeros_like(made.shared))
    assert smooth_errors(alone, 0.01, 2e-4) is None
