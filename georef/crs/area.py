"""Whether points are plausible in their CRS: areas of use, swapped axes."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from georef.crs.checks import checked_points, crs_error
from georef.crs.definition import CrsDefinition, Parts, resolve
from georef.crs.geodetic import lonlat_from_crs
from georef.errors import CrsError
from georef.geometry.rigid import Array

Mask = NDArray[np.bool_]

AREA_MARGIN_DEG = 1.0
"""Points this far outside the area of use still pass: surveys cross zone borders, swapped axes are much further off."""


def check_area_of_use(definition: CrsDefinition, points_in_crs: ArrayLike) -> None:
    """Raise CrsError, naming the first offending row (from 0), unless points_in_crs (N, 3) are plausible in their CRS.

    Plausible: finite, and not more than AREA_MARGIN_DEG outside the area of use of the horizontal and the vertical CRS
    where PROJ knows one. Finds swapped axes and zone-prefixed coordinates of another zone; cannot find UTM coordinates
    read in another zone, latitude and longitude swapped in a worldwide CRS, or anything geocentric.
    """
    points = checked_points(points_in_crs, "points_in_crs")
    parts = resolve(definition)
    if parts is None or len(points) == 0:
        return
    outside, area = _outside(parts, points)
    if outside.any():
        index = int(np.argmax(outside))
        raise _area_error(parts, points, index, int(outside.sum()), area)


def _outside(parts: Parts, points: Array) -> tuple[Mask, Any]:
    """Mask (N,) of points that are nowhere or outside an area of use, and that area (if none is, the first or None)."""
    lonlat = lonlat_from_crs(parts, points)
    on_earth = (np.abs(lonlat[:, 0]) <= 360.0) & (np.abs(lonlat[:, 1]) <= 90.0)  # false where not finite
    lonlat = np.where(on_earth[:, None], lonlat, 0.0)
    areas = [crs.area_of_use for crs in (parts.horizontal, parts.vertical) if crs is not None and crs.area_of_use]
    masks = [~(on_earth & _inside(area, lonlat)) for area in areas] or [~on_earth]
    worst = next((i for i, mask in enumerate(masks) if mask.any()), 0)
    return masks[worst], areas[worst] if areas else None


def _inside(area: Any, lonlat_deg: Array) -> Mask:
    width = (area.east - area.west) % 360.0 or 360.0
    offset = (lonlat_deg[:, 0] - area.west + AREA_MARGIN_DEG) % 360.0
    lat = lonlat_deg[:, 1]
    return (
        (offset <= width + 2.0 * AREA_MARGIN_DEG)
        & (lat >= area.south - AREA_MARGIN_DEG)
        & (lat <= area.north + AREA_MARGIN_DEG)
    )


def _area_error(parts: Parts, points: Array, index: int, count: int, area: Any) -> CrsError:
    lon, lat = lonlat_from_crs(parts, points[index : index + 1])[0]
    place = f"would lie at longitude {lon:.4f}, latitude {lat:.4f}" if math.isfinite(lon) else "lies nowhere on Earth"
    expected = "a point on Earth"
    if area is not None:
        box = f"longitude {area.west:g} to {area.east:g}, latitude {area.south:g} to {area.north:g}"
        expected = f"{box}, within {AREA_MARGIN_DEG:g} deg ({area.name[:80].strip(' .')})"
    remedy = "Correct the coordinates, or declare the CRS (and zone) that they are in."
    if parts.kind != "geocentric" and not _outside(parts, points[:, [1, 0, 2]])[0].any():
        columns = "easting and northing" if parts.kind == "projected" else "longitude and latitude"
        remedy = f"The {columns} are probably swapped: exchanged, all points lie inside."
    return crs_error(
        f"Point {index}, {points[index].tolist()}, {place}, outside the area of use of {parts.full.name!r}"
        f" ({count} of {len(points)} points).",
        expected,
        remedy,
    )
