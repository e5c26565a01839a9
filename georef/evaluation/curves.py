"""Cumulative curves: the share of images whose error does not exceed a limit, over limits on a logarithmic axis."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from georef.geometry.rigid import Array

POSITION_RANGE_M = (0.0005, 1.0)
ROTATION_RANGE_DEG = (0.005, 10.0)


@dataclass(frozen=True, eq=False)
class CumulativeCurve:
    """Errors in rising order, and the percentage of all images that each of them and those before it make."""

    errors: Array  # (K,) finite, rising
    percent: Array  # (K,)
    total: int  # images, those without an estimate included

    @staticmethod
    def of(errors: ArrayLike) -> CumulativeCurve:
        """Of errors (N,), infinite where an image has no estimate."""
        every = np.asarray(errors, dtype=np.float64)
        known = np.sort(every[np.isfinite(every)])
        return CumulativeCurve(known, 100.0 * np.arange(1, len(known) + 1) / max(len(every), 1), len(every))

    def at(self, limits: ArrayLike) -> Array:
        """Percentages (L,) of all images with an error of at most each limit (L,); NaN without images."""
        if self.total == 0:
            return np.full(np.shape(limits), np.nan)
        return 100.0 * np.searchsorted(self.errors, np.asarray(limits), side="right") / self.total

    def to_dict(self) -> dict[str, object]:
        """Plain values for JSON."""
        return {"errors": self.errors.tolist(), "percent": self.percent.tolist(), "total": self.total}


def round_limits(low: float, high: float) -> list[float]:
    """1, 2 and 5 times the powers of ten inside a range, its ends included."""
    powers = range(int(np.floor(np.log10(low))), int(np.ceil(np.log10(high))) + 1)
    limits = [float(f"{m}e{power}") for power in powers for m in (1, 2, 5)]
    return [limit for limit in limits if low * (1 - 1e-9) <= limit <= high * (1 + 1e-9)]
