"""The frame `world` of a project: topocentric east-north-up at its origin, and the choice of that origin."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from georef.crs.area import check_area_of_use
from georef.crs.axes import crs_axes_from_ecef, ecef_from_enu
from georef.crs.checks import checked_covs, checked_points, crs_error, wrapped_deg
from georef.crs.definition import LOCAL, CrsDefinition, resolve
from georef.crs.geodetic import lonlat_from_crs
from georef.crs.route import Route, find_operation
from georef.geometry.rigid import Array


@dataclass(frozen=True, eq=False)
class WorldFrame:
    """The world frame of a project. Made by `WorldFrame.create`; unpickling checks the grids again."""

    definition: CrsDefinition
    origin_in_crs: Array
    _route: Route | None
    _origin_in_ecef: Array
    _enu_from_ecef: Array

    @staticmethod
    def create(definition: CrsDefinition, origin_in_crs: ArrayLike) -> WorldFrame:
        """The frame with its origin at origin_in_crs (3,).

        Raises CrsError: the definition is unknown, incomplete or contradictory; its axes or units are not supported;
        a geoid grid is missing; the origin lies outside the area of use.
        """
        check_area_of_use(definition, np.atleast_2d(np.asarray(origin_in_crs, dtype=np.float64)))
        origin = np.array(origin_in_crs, dtype=np.float64).reshape(3)
        origin.setflags(write=False)
        parts = resolve(definition)
        if parts is None:
            return WorldFrame(definition, origin, None, origin, np.eye(3))
        lonlat_deg = lonlat_from_crs(parts, origin[None])
        route = Route(parts, find_operation(parts, lonlat_deg[0]), definition.epoch)
        origin_in_ecef = route.ecef_from_crs(origin[None])[0]
        return WorldFrame(definition, origin, route, origin_in_ecef, ecef_from_enu(lonlat_deg)[0].T)

    def __reduce__(self) -> tuple[Any, ...]:
        return WorldFrame.create, (self.definition, np.array(self.origin_in_crs))

    def world_from_crs(self, points_in_crs: ArrayLike) -> Array:
        """points_in_crs (N, 3) -> points_in_world (N, 3), metres. CrsError: not finite, or outside the geoid grid."""
        points = checked_points(points_in_crs, "points_in_crs")
        if self._route is not None:
            points = self._route.ecef_from_crs(points)
        return (points - self._origin_in_ecef) @ self._enu_from_ecef.T

    def crs_from_world(self, points_in_world: ArrayLike) -> Array:
        """points_in_world (N, 3), metres -> points_in_crs (N, 3), longitudes in [-180, 180]. CrsError as above."""
        points = checked_points(points_in_world, "points_in_world") @ self._enu_from_ecef + self._origin_in_ecef
        return points if self._route is None else self._route.crs_from_ecef(points)

    def crs_axes_from_world(self, points_in_crs: ArrayLike) -> Array:
        """Rotations (N, 3, 3) that take world axes to the axes of the CRS at points_in_crs (N, 3).

        Axes: projected: grid east, grid north, ellipsoidal up; geographic: true east, true north, ellipsoidal up;
        geocentric: X, Y, Z; local: x, y, z (the identity). Up is the normal of the ellipsoid also where heights refer
        to a geoid. Where a projection is not conformal, its grid axes are not at right angles: then it is the rotation
        nearest (Frobenius norm) to the differential of the projection. CrsError: points not finite, not on Earth.
        """
        points = checked_points(points_in_crs, "points_in_crs")
        if self._route is None:
            return np.tile(np.eye(3), (len(points), 1, 1))
        return crs_axes_from_ecef(self._route.parts, points) @ self._enu_from_ecef.T

    def world_cov_from_crs(self, points_in_crs: ArrayLike, covs_in_crs: ArrayLike) -> Array:
        """Covariances (N, 3, 3), m^2, along the axes of the CRS at points_in_crs (N, 3) -> along world axes.

        The axes are those of `crs_axes_from_world`; for a geographic CRS too the values are metres (east, north, up).
        Only rotated: the grid scale (4e-4 in UTM) is far below what a standard deviation is known to.
        """
        axes = self.crs_axes_from_world(points_in_crs)
        return axes.transpose(0, 2, 1) @ checked_covs(covs_in_crs, len(axes)) @ axes

    def crs_cov_from_world(self, points_in_crs: ArrayLike, covs_in_world: ArrayLike) -> Array:
        """The inverse of `world_cov_from_crs`; the points are in the CRS here, too."""
        axes = self.crs_axes_from_world(points_in_crs)
        return axes @ checked_covs(covs_in_world, len(axes)) @ axes.transpose(0, 2, 1)

    def describe(self) -> dict[str, Any]:
        """Names, origin, and (projected) grid scale and convergence there, for reports: plain values only.

        grid_convergence_deg is the bearing of grid north, clockwise from true north; grid_scale that of the projection
        on the ellipsoid, without the reduction for height; height_accuracy_m is PROJ's figure, None if unknown.
        """
        out: dict[str, Any] = {
            "kind": LOCAL,
            "horizontal": self.definition.horizontal,
            "height": self.definition.height,
            "epoch": self.definition.epoch,
            "origin_in_crs": self.origin_in_crs.tolist(),
        }
        if self._route is None:
            return out
        return out | self._route.describe(self.origin_in_crs[None])


def choose_origin(definition: CrsDefinition, points_in_crs: ArrayLike) -> Array:
    """An origin (3,) in the CRS: the mean of points_in_crs (N, 3), rounded to 1 m (longitude, latitude: 1e-5 deg).

    Raises CrsError: no points, points that are not finite, or outside the area of use.
    """
    points = checked_points(points_in_crs, "points_in_crs")
    if len(points) == 0:
        raise crs_error("There are no points to choose an origin from.", "at least one point", "Declare the origin.")
    check_area_of_use(definition, points)
    parts = resolve(definition)
    if parts is None or parts.kind != "geographic":
        return np.round(points.mean(axis=0))
    first_lon = points[0, 0]
    longitude = first_lon + wrapped_deg(points[:, 0] - first_lon).mean()  # right also across the antimeridian
    mean = np.array([wrapped_deg(longitude), points[:, 1].mean(), points[:, 2].mean()])
    return np.array([*np.round(mean[:2], 5), np.round(mean[2])])
