"""Coordinates of a coordinate reference system (CRS) <-> the frame `world`.

`world` is metric, topocentric east-north-up at an origin that is fixed for a project. Points go one by one through
CRS -> geographic 3D of the same datum -> geocentric -> topocentric, never through one similarity transform, and the
datum never changes on the way. Columns of points_in_crs, whatever the axis order of the authority:

    projected   easting m, northing m, height m         geocentric  X, Y, Z m
    geographic  longitude deg, latitude deg, height m   local       x, y, z m (right-handed, z up)

A height never passes unchanged by accident: it is declared ellipsoidal, or its geoid model must be installed.
Formulas: IOGP Guidance Note 7-2 (geocentric, topocentric); Snyder, "Map projections" (USGS PP 1395, 1987), section 4.
"""

from georef.crs.area import AREA_MARGIN_DEG, check_area_of_use
from georef.crs.definition import ELLIPSOIDAL, LOCAL, CrsDefinition, crs_kind
from georef.crs.frame import WorldFrame, choose_origin

__all__ = [
    "AREA_MARGIN_DEG",
    "ELLIPSOIDAL",
    "LOCAL",
    "CrsDefinition",
    "WorldFrame",
    "check_area_of_use",
    "choose_origin",
    "crs_kind",
]
