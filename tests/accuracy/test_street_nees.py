"""Whether the adjustment predicts its own errors: poses and check points together, over many draws of all errors."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from scipy.stats import chi2

from georef.simulate.observations import ObservationNoise
from georef.simulate.reference_errors import ReferenceQuality
from tests.worlds.street import adjusted_block, street_block

SEEDS = 60
PARTS = ("joint", "poses", "points")


def _mean_nees(seeds: Iterable[int], **given) -> dict[str, tuple[float, float, float]]:
    """Part -> NEES over degrees of freedom of all seeds together, and its two-sided 99 % interval."""
    values: dict[str, list[tuple[float, int]]] = {name: [] for name in PARTS}
    for seed in seeds:
        block = street_block(seed, **given)
        for name, value in block.judged(adjusted_block(block)).nees.items():
            values[name].append(value)
    out = {}
    for name, found in values.items():
        total, dof = np.sum(found, axis=0)
        out[name] = (total / dof, chi2.ppf(0.005, dof) / dof, chi2.ppf(0.995, dof) / dof)
    return out


def test_errors_are_as_large_as_predicted_neither_more_nor_less() -> None:
    """With an imperfect reference, drawn from the sigmas that it declares."""
    found = _mean_nees(range(SEEDS))
    assert {name: (low, mean, high) for name, (mean, low, high) in found.items() if not low < mean < high} == {}


def test_a_smooth_error_of_the_reference_is_carried_along() -> None:
    """Relative to the deformed reference the errors stay as predicted: 15 mm over 100 m hardly bend a short street."""
    mean, low, high = _mean_nees(range(100, 115), quality=ReferenceQuality(absolute_m=0.015))["joint"]
    assert low < mean < high


def test_an_overconfident_reference_is_found_out() -> None:
    """The test has power: sigmas of the reference stated at half their size leave the interval."""
    mean, _, high = _mean_nees(range(200, 208), stated_poses=0.5)["joint"]
    assert mean > high


def test_planted_blunders_are_rejected() -> None:
    noise = ObservationNoise(blunders=0.05)
    planted, left, means = 0, 0, []
    for seed in range(300, 310):
        block = street_block(seed, noise=noise)
        adjusted = adjusted_block(block)
        obs = adjusted.block.observations
        planted += len(block.planted)
        left += len(block.planted & set(zip(obs.view.tolist(), obs.keypoint.tolist(), strict=True)))
        means.append(block.judged(adjusted).nees["joint"])
    assert planted > 150
    assert left <= 0.01 * planted
    total, dof = np.sum(means, axis=0)
    assert chi2.ppf(0.0005, dof) < total < chi2.ppf(0.9995, dof)
