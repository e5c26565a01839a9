"""Which rows of a vector index a query may return, as the SQL condition that its scalar indices answer."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import ArrayLike

_TOUCH_RAD = 1e-9  # a heading on the border of the window is inside, however it was rounded


def condition(
    centre: ArrayLike | None,
    half_side_m: float | None,
    heading_rad: float | None,
    heading_window_deg: float | None,
    epochs: Sequence[str] | None,
) -> str | None:
    """The condition for a square box, a heading window and a choice of epochs; None where nothing is asked for.

    Raises ValueError for half a box or half a window, and for values that are not finite or negative.
    """
    parts = [
        _box(centre, half_side_m),
        _window(heading_rad, heading_window_deg),
        None if epochs is None else one_of("epoch", epochs),
    ]
    return " AND ".join(part for part in parts if part) or None


def one_of(column: str, values: Iterable[str]) -> str:
    """`column IN (...)` with quotes doubled; a condition that nothing meets where there are no values."""
    quoted = ", ".join("'" + value.replace("'", "''") + "'" for value in values)
    return f"{column} IN ({quoted})" if quoted else "FALSE"


def wrapped(angle_rad: float) -> float:
    """The angle in [0, 2 pi), as headings are stored."""
    return math.fmod(math.fmod(angle_rad, math.tau) + math.tau, math.tau)


def _box(centre: ArrayLike | None, half_side_m: float | None) -> str | None:
    if centre is None and half_side_m is None:
        return None
    if centre is None or half_side_m is None:
        raise ValueError("a search box needs its centre and half its side")
    x, y = (float(value) for value in np.asarray(centre, float).reshape(-1)[:2])
    half = float(half_side_m)
    if not (math.isfinite(x) and math.isfinite(y) and math.isfinite(half) and half >= 0):
        raise ValueError(f"a search box about ({x}, {y}) with half side {half} m is no box")
    bounds = f"x >= {x - half!r} AND x <= {x + half!r} AND y >= {y - half!r} AND y <= {y + half!r}"
    return f"({bounds})"


def _window(heading_rad: float | None, window_deg: float | None) -> str | None:
    """Headings within +-window_deg; a row without heading looks everywhere, or nobody knows where: it passes."""
    if heading_rad is None and window_deg is None:
        return None
    if heading_rad is None or window_deg is None:
        raise ValueError("a heading window needs its heading and its half width")
    half = math.radians(window_deg) + _TOUCH_RAD
    if not (math.isfinite(heading_rad) and math.isfinite(half) and half >= 0):
        raise ValueError(f"a window of +-{window_deg} deg about {heading_rad} rad is no window")
    if half >= math.pi:
        return None
    low, high = wrapped(heading_rad - half), wrapped(heading_rad + half)
    joint = "AND" if low <= high else "OR"  # OR: the window holds north, where the stored angle jumps
    return f"(heading_rad IS NULL OR (heading_rad >= {low!r} {joint} heading_rad <= {high!r}))"
