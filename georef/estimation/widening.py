"""How the variance of keypoints grows with the angle across which they are matched.

Seen from another side, a keypoint sits on a slightly different spot of the same thing.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.stats import chi2

from georef.estimation.adjustment.quality.group_tests import group_statistics
from georef.estimation.tracks import nearest_ray_angles
from georef.geometry.projection import Views, linearize
from georef.geometry.rigid import Array
from georef.geometry.triangulation import segment_sum, triangulate
from georef.types.scene import Observations

_ANGLE_EDGES, _LEAST_ANGLE_BINS = np.radians([5.0, 10.0, 15.0, 20.0, 30.0, 45.0, 60.0]), 3
_LEAST_WIDENING_RAD, _ROUNDS = np.radians(3.0), 5
_LEAST_OBSERVATIONS = 30  # of an angle bin
_MEDIAN = np.array([np.nan, *chi2.ppf(0.5, [1, 2])])  # of chi-square, by degrees of freedom
_SINGULAR = 1e12


def widening_angle(points: Array, observations: Observations, views: Views) -> float:
    """The angle of `ReferenceNoise.widening`, rad, from observations of points (P, 3), approximate, by images whose
    poses are held.

    Residuals show it undiluted only where the points were intersected with the right weights: so it is iterated.
    Infinite where the residuals show no growth.
    """
    obs, angle = observations, nearest_ray_angles(points, observations, views.centres)
    widening = np.ones(len(obs))
    found = np.inf
    for _ in range(_ROUNDS):
        weighted = replace(obs, sigma_px=obs.sigma_px * widening)
        cut = triangulate(views, obs.point, obs.view, obs.pixel, weighted.sigma_px, len(points)).points
        found = _growth(angle, _variance_ratios(cut, weighted, views) * np.square(widening))
        widening = np.sqrt(1.0 + angle / found)
    return found


def _variance_ratios(points: Array, obs: Observations, views: Views) -> Array:
    """Squared residuals of the observations (n,) against their variances, poses held, of median 1 where the sigmas are
    true. NaN where an observation is not checked by others."""
    lin = linearize(views, obs.view, points[obs.point])
    residual = np.nan_to_num((lin.pixel - obs.pixel) / obs.sigma_px[:, None])
    by_point = np.nan_to_num(lin.by_point) / obs.sigma_px[:, None, None]
    turned = np.swapaxes(by_point, 1, 2)
    normal = segment_sum(turned @ by_point, obs.point, len(points))
    singular = np.linalg.cond(normal) > _SINGULAR
    normal[singular] = np.eye(3)
    inverse = np.asarray(np.linalg.inv(normal), dtype=np.float64)
    statistic, dof = group_statistics(residual, np.eye(2) - by_point @ inverse[obs.point] @ turned)
    checked = (dof > 0) & np.isfinite(lin.pixel).all(axis=1) & ~singular[obs.point]
    return np.where(checked, statistic / _MEDIAN[dof], np.nan)


def _growth(angle: Array, variance: Array) -> float:
    """The angle across which a variance doubles, from a straight line through the medians of angle bins."""
    known = np.isfinite(variance) & np.isfinite(angle)
    angle, variance = angle[known], variance[known]
    index = np.searchsorted(_ANGLE_EDGES, angle)
    bins = [index == i for i in range(len(_ANGLE_EDGES) + 1) if (index == i).sum() >= _LEAST_OBSERVATIONS]
    if len(bins) < _LEAST_ANGLE_BINS:
        return np.inf
    middle = np.array([np.median(angle[part]) for part in bins])
    level = np.array([np.median(variance[part]) for part in bins])
    count = np.array([part.sum() for part in bins])
    slope, start = np.polyfit(middle, level, 1, w=np.sqrt(count) / level)
    return float(max(start / slope, _LEAST_WIDENING_RAD)) if slope > 0 else np.inf
