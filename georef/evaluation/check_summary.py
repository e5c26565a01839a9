"""The summary of check points of one kind: RMSE, bias, spread, and whether their predicted covariances are true."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from georef.evaluation.statistics import (
    Interval,
    NeesSummary,
    effective_dof,
    finite,
    finite_list,
    rmse_interval,
    summarize_nees,
)
from georef.geometry.rigid import Array
from georef.types.constraints import CheckKind


@dataclass(frozen=True, eq=False)
class CheckPointSummary:
    """All in metres, estimated minus reference; NaN without points. Intervals hold 95 %, two-sided.

    That of the mean NEES knows the errors that points share through their poses; those of the RMSE do not.
    Those of one axis are exact chi-square intervals for independent normal errors without bias; those of the
    horizontal and the 3D RMSE are approximate (Satterthwaite's degrees of freedom).
    """

    kind: CheckKind
    count: int  # points that were determined
    not_determined: int
    rmse_e_m: float
    rmse_n_m: float
    rmse_h_m: float
    rmse_horizontal_m: float  # root of the mean of dE^2 + dN^2
    rmse_3d_m: float
    rmse_axis_intervals_m: tuple[Interval, ...] | None  # east, north, height
    rmse_horizontal_interval_m: Interval | None
    rmse_3d_interval_m: Interval | None
    mean_m: Array  # (3,) bias dE, dN, dH
    std_m: Array  # (3,) about the mean, N - 1; NaN for fewer than 2 points
    nees: NeesSummary  # 3 degrees of freedom

    def to_dict(self) -> dict[str, object]:
        """Plain values for JSON; None for what is unknown."""
        axes = self.rmse_axis_intervals_m or (None, None, None)
        return {
            "kind": str(self.kind),
            "count": self.count,
            "not_determined": self.not_determined,
            "rmse_e_m": finite(self.rmse_e_m),
            "rmse_n_m": finite(self.rmse_n_m),
            "rmse_h_m": finite(self.rmse_h_m),
            "rmse_horizontal_m": finite(self.rmse_horizontal_m),
            "rmse_3d_m": finite(self.rmse_3d_m),
            "rmse_e_interval_95_m": finite_list(axes[0]),
            "rmse_n_interval_95_m": finite_list(axes[1]),
            "rmse_h_interval_95_m": finite_list(axes[2]),
            "rmse_horizontal_interval_95_m": finite_list(self.rmse_horizontal_interval_m),
            "rmse_3d_interval_95_m": finite_list(self.rmse_3d_interval_m),
            "mean_m": finite_list(self.mean_m),
            "std_m": finite_list(self.std_m),
            "nees": self.nees.to_dict(),
        }


def summarize_differences(
    kind: CheckKind,
    differences_m: Array,
    nees_values: Iterable[float | None],
    *,
    joint_cov: Array | None,
    not_determined: int,
) -> CheckPointSummary:
    """The summary of differences (N, 3) dE, dN, dH of check points of one kind, with their NEES (N,).

    joint_cov (3N, 3N): of all differences; it widens the interval of the mean NEES where the points share errors.
    """
    square = np.square(differences_m)
    count = len(square)
    mean_square = square.mean(axis=0) if count else np.full(3, np.nan)
    e, n, h = np.sqrt(mean_square).tolist()
    axes = [rmse_interval(differences_m[:, axis : axis + 1]) for axis in range(3)]
    dof = effective_dof(joint_cov, 3) if joint_cov is not None and count else None
    return CheckPointSummary(
        kind=kind,
        count=count,
        not_determined=not_determined,
        rmse_e_m=e,
        rmse_n_m=n,
        rmse_h_m=h,
        rmse_horizontal_m=float(np.sqrt(mean_square[:2].sum())),
        rmse_3d_m=float(np.sqrt(mean_square.sum())),
        rmse_axis_intervals_m=tuple(axis for axis in axes if axis is not None) or None,
        rmse_horizontal_interval_m=rmse_interval(differences_m[:, :2]),
        rmse_3d_interval_m=rmse_interval(differences_m),
        mean_m=differences_m.mean(axis=0) if count else np.full(3, np.nan),
        std_m=differences_m.std(axis=0, ddof=1) if count > 1 else np.full(3, np.nan),
        nees=summarize_nees(nees_values, 3, effective_dof=dof),
    )
