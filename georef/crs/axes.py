"""Directions: east, north and up, the axes of a CRS at a place, grid convergence and scale.

Formulas: IOGP Guidance Note 7-2 (topocentric); Snyder, "Map projections" (USGS PP 1395, 1987), section 4.
"""

from __future__ import annotations

import numpy as np

from georef.crs.checks import refuse_untransformed, wrapped_deg
from georef.crs.definition import Parts
from georef.crs.geodetic import lonlat_from_crs, semi_axes
from georef.geometry.rigid import Array

_STEP_M = 50.0  # half the base of the central difference for the direction of grid north: good to 1e-10 rad


def ecef_from_enu(lonlat_deg: Array) -> Array:
    """Rotations (N, 3, 3) whose columns are east, north and up at longitude, latitude (N, 2)."""
    (lon, lat), out = np.radians(lonlat_deg).T, np.zeros((len(lonlat_deg), 3, 3))
    out[:, 0, 0], out[:, 1, 0] = -np.sin(lon), np.cos(lon)
    out[:, 0, 1], out[:, 1, 1], out[:, 2, 1] = -np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)
    out[:, 0, 2], out[:, 1, 2], out[:, 2, 2] = np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)
    return out


def crs_axes_from_ecef(parts: Parts, points: Array) -> Array:
    """Rotations (N, 3, 3) from geocentric axes to those of the CRS at points (N, 3); CrsError: not on Earth."""
    if parts.kind == "geocentric":
        return np.tile(np.eye(3), (len(points), 1, 1))
    lonlat_deg = lonlat_from_crs(parts, points)
    refuse_untransformed(points, lonlat_deg)
    axes_from_ecef = ecef_from_enu(lonlat_deg).transpose(0, 2, 1)
    if parts.kind == "geographic":
        return axes_from_ecef
    turn, _ = grid_turn_and_scale(parts, points)
    grid_from_enu = np.tile(np.eye(3), (len(points), 1, 1))
    grid_from_enu[:, 0, 0] = grid_from_enu[:, 1, 1] = np.cos(turn)
    grid_from_enu[:, 0, 1], grid_from_enu[:, 1, 0] = np.sin(turn), -np.sin(turn)
    return grid_from_enu @ axes_from_ecef


def grid_turn_and_scale(parts: Parts, points: Array) -> tuple[Array, Array]:
    """Angle (N,) rad, counter-clockwise, from true to grid axes, and the point scale (N,), by central differences.

    With A = d(east, north) / d(easting, northing), the rotation nearest to A turns by atan2(A10 - A01, A00 + A11).
    """
    a, b = semi_axes(parts.geodetic)
    lat = np.radians(lonlat_from_crs(parts, points)[:, 1])
    squeeze = 1.0 - (1.0 - (b / a) ** 2) * np.sin(lat) ** 2
    columns = []
    for step in (np.array([_STEP_M, 0.0, 0.0]), np.array([0.0, _STEP_M, 0.0])):
        lonlat = lonlat_from_crs(parts, points + step) - lonlat_from_crs(parts, points - step)
        east = np.radians(wrapped_deg(lonlat[:, 0])) * np.cos(lat) * a / np.sqrt(squeeze)  # prime vertical radius
        north = np.radians(lonlat[:, 1]) * b * b / (a * squeeze**1.5)  # meridian radius
        columns.append(np.stack([east, north], axis=1) / (2.0 * _STEP_M))
    m = np.stack(columns, axis=2)
    turn = np.arctan2(m[:, 1, 0] - m[:, 0, 1], m[:, 0, 0] + m[:, 1, 1])
    return turn, 1.0 / np.sqrt(np.abs(np.linalg.det(m)))
