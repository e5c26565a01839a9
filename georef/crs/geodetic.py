"""The ellipsoid of a CRS: its axes, geocentric coordinates, and where points lie on it."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from pyproj import CRS, Transformer
from pyproj.enums import TransformDirection

from georef.crs.checks import refuse_untransformed
from georef.crs.definition import Parts
from georef.geometry.rigid import Array

INVERSE = TransformDirection.INVERSE


def semi_axes(geodetic: CRS) -> tuple[float, float]:
    """Semi-major and semi-minor axis in metres of the ellipsoid of a geodetic CRS."""
    ellipsoid = geodetic.ellipsoid
    assert ellipsoid is not None, "a geodetic CRS has an ellipsoid"
    return float(ellipsoid.semi_major_metre), float(ellipsoid.semi_minor_metre)


@lru_cache(maxsize=32)
def cartesian(geodetic: CRS) -> Transformer:
    """(longitude deg, latitude deg, ellipsoidal height m) -> geocentric metres, on the ellipsoid of a CRS."""
    a, b = semi_axes(geodetic)
    to_radians = "+step +proj=unitconvert +xy_in=deg +xy_out=rad"
    return Transformer.from_pipeline(f"+proj=pipeline {to_radians} +step +proj=cart +a={a!r} +b={b!r}")


@lru_cache(maxsize=32)
def _lonlat_transformer(horizontal: CRS, geodetic: CRS) -> Transformer:
    return Transformer.from_crs(horizontal, geodetic, always_xy=True)


def lonlat_from_crs(parts: Parts, points: Array) -> Array:
    """(N, 3) -> longitude and latitude (N, 2) in degrees on the same datum; inf where the projection has no inverse."""
    if parts.kind == "geographic":
        return points[:, :2]
    if parts.kind == "geocentric":
        return np.column_stack(cartesian(parts.geodetic).transform(*points.T, direction=INVERSE))[:, :2]
    transformer = _lonlat_transformer(parts.horizontal, parts.geodetic)
    return np.column_stack(transformer.transform(points[:, 0], points[:, 1]))


def transform(
    transformer: Transformer,
    points: Array,
    epoch: float | None = None,
    direction: TransformDirection = TransformDirection.FORWARD,
) -> Array:
    """Points (N, 3) through a transformer, at one epoch (decimal year); CrsError where a result is not finite."""
    time = None if epoch is None else np.full(len(points), epoch)
    out = np.column_stack(transformer.transform(*points.T, tt=time, direction=direction)[:3])
    refuse_untransformed(points, out)
    return out
