"""Variance components: how large the residuals of each group are against what their sigmas promise.

sigma^2 = v' P v / r with the group's redundancy r = n - tr(A Qxx A' P), as in Foerstner's simplified estimator; the
redundancies add up to that of the whole adjustment.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

_LEAST_REDUNDANCY = 3.0


@dataclass(frozen=True)
class Component:
    """One group of observations."""

    observations: int  # number of scalar observations
    redundancy: float
    squares: float  # v' P v

    def to_dict(self) -> dict[str, Any]:
        """As reports hold it."""
        own = {"observations": self.observations, "redundancy": self.redundancy}
        return own | {"factor": self.factor, "factor_sigma": self.factor_sigma}

    @property
    def factor(self) -> float | None:
        """Estimated over stated 1-sigma; None where the redundancy is too small to tell."""
        return float(np.sqrt(self.squares / self.redundancy)) if self.redundancy >= _LEAST_REDUNDANCY else None

    @property
    def factor_sigma(self) -> float | None:
        """1-sigma of the factor, for normal errors: s / sqrt(2 r)."""
        return self.factor / float(np.sqrt(2.0 * self.redundancy)) if self.factor is not None else None
