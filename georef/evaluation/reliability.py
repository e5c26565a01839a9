"""Predicted against found: whether the sigmas that poses state are those that their errors show.

An error of k components that is normal with a predicted covariance S has the mean square tr(S). Its length over
sqrt(tr S) is therefore about 1, whatever the size of S, and does not grow with it where the prediction is right.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from georef.evaluation.pose_errors import PoseError, pose_error
from georef.evaluation.statistics import finite
from georef.geometry.rigid import Array, Rigid3

_MEDIAN_OF_SIX = float(chi2.ppf(0.5, 6))


@dataclass(frozen=True, eq=False)
class Reliability:
    """One image: its error, and the sigmas that were predicted of it (root of the trace, all axes together)."""

    error: PoseError
    position_sigma_m: float | None  # None: no pose
    rotation_sigma_rad: float | None

    def to_dict(self) -> dict[str, object]:
        """Plain values for JSON: metres and degrees."""
        rotation = None if self.rotation_sigma_rad is None else float(np.rad2deg(self.rotation_sigma_rad))
        return {
            **self.error.to_dict(),
            "predicted_position_sigma_m": self.position_sigma_m,
            "predicted_rotation_sigma_deg": rotation,
        }


def reliability(image_id: str, estimate: tuple[Rigid3, Array] | None, given: Rigid3, given_cov: Array) -> Reliability:
    """The error of an estimated pose with its covariance (6, 6) against a given pose that has errors of its own.

    The two must be independent. None where the image has no pose. Raises ValueError as `pose_error` does.
    """
    error = pose_error(image_id, estimate, given, given_cov)
    if estimate is None:
        return Reliability(error, None, None)
    variance = np.diag(estimate[1] + given_cov)
    return Reliability(error, float(np.sqrt(variance[3:].sum())), float(np.sqrt(variance[:3].sum())))


def median_nees_ratio(errors: list[PoseError]) -> float | None:
    """The median NEES over that of a chi-square with 6 degrees of freedom: 1 where covariances are true.

    Beside the mean, which a single gross error can carry away. None without errors.
    """
    known = [error.nees for error in errors if error.nees is not None]
    return finite(np.median(known) / _MEDIAN_OF_SIX) if known else None
