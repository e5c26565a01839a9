"""Control and check: two types that share no base, so that neither can stand in for the other."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from georef.geometry.rigid import Array
from georef.types.campaign import require_covariance


class CheckKind(StrEnum):
    """What a check point is independent of; the two are never pooled."""

    ABSOLUTE = "absolute"  # surveyed independently of the reference
    RELATIVE = "relative"  # derived from the reference: judges co-registration only


@dataclass(frozen=True, eq=False)
class Mark:
    """A measured image point of a control or check point, observed (distorted) full-resolution pixels."""

    image_id: str
    pixel: Array  # (2,)
    sigma_px: float

    def __post_init__(self) -> None:
        if not self.sigma_px > 0:
            raise ValueError("sigma_px must be positive")


@dataclass(frozen=True, eq=False)
class ControlPoint:
    """A point whose coordinates take part in the adjustment.

    partial: (3, 3) information of rank 2 (horizontal) or 1 (height) where not all of them are known; the others are
    approximate, and cov is wide along them.
    """

    point_id: str
    point_in_world: Array  # (3,)
    cov: Array  # (3, 3)
    marks: tuple[Mark, ...]
    partial: Array | None = None

    @property
    def information(self) -> Array:
        """(3, 3), of rank 1 to 3."""
        return np.asarray(np.linalg.inv(self.cov), dtype=np.float64) if self.partial is None else self.partial

    def __post_init__(self) -> None:
        require_covariance(self.cov, 3)


@dataclass(frozen=True, eq=False)
class CheckPoint:
    """A point that judges the adjustment and never enters it."""

    point_id: str
    kind: CheckKind
    point_in_world: Array  # (3,)
    cov: Array  # (3, 3)
    marks: tuple[Mark, ...]

    def __post_init__(self) -> None:
        require_covariance(self.cov, 3)
