"""Checks of arrays of points and covariances, and the shape of an error message of this room."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from georef.errors import CrsError
from georef.geometry.rigid import Array


def crs_error(problem: str, expected: str, remedy: str) -> CrsError:
    """The error of this room, to be raised by the caller: what is wrong, what was expected, what to do."""
    return CrsError(f"{problem}\nExpected {expected}.\n{remedy}")


def checked_points(points: ArrayLike, name: str) -> Array:
    """A copy of points (N, 3), float64, finite; CrsError otherwise."""
    out = np.array(points, dtype=np.float64)
    if out.ndim != 2 or out.shape[1] != 3:
        raise crs_error(f"{name} has the shape {out.shape}.", "(N, 3)", "Give one row a point, with its height.")
    _refuse_not_finite(out, name)
    return out


def checked_covs(covs: ArrayLike, count: int) -> Array:
    """Covariances (count, 3, 3), float64, finite; CrsError otherwise."""
    out = np.asarray(covs, dtype=np.float64)
    if out.shape != (count, 3, 3):
        raise crs_error(f"The covariances have the shape {out.shape}.", f"({count}, 3, 3)", "Give one a point.")
    _refuse_not_finite(out, "covs")
    return out


def _refuse_not_finite(values: Array, name: str) -> None:
    bad = ~np.isfinite(values).all(axis=tuple(range(1, values.ndim)))
    if bad.any():
        index = int(np.argmax(bad))
        raise crs_error(f"{name}[{index}] is {values[index].tolist()}.", "finite numbers", "Correct or remove it.")


def refuse_untransformed(points: Array, out: Array) -> None:
    """Raise CrsError, naming the first of points (N, 3), where its transform out (N, k) is not finite."""
    bad = ~np.isfinite(out).all(axis=1)
    if bad.any():
        index = int(np.argmax(bad))
        raise crs_error(
            f"Point {index}, {points[index].tolist()}, cannot be transformed (and {int(bad.sum()) - 1} more).",
            "points where the projection is defined and that its geoid grid covers",
            "Correct the coordinates or the CRS.",
        )


def wrapped_deg(angle_deg: Any) -> Any:
    """An angle or an array of angles, in degrees, brought into [-180, 180)."""
    return (angle_deg + 180.0) % 360.0 - 180.0
