"""The way from a CRS to geocentric coordinates of the same datum and back, with the geoid grid it needs."""

from __future__ import annotations

import math
import os
import warnings
from typing import Any, NamedTuple

import numpy as np
from pyproj import Transformer
from pyproj.aoi import AreaOfInterest
from pyproj.datadir import get_data_dir, get_user_data_dir  # pyright: ignore[reportPrivateImportUsage]
from pyproj.exceptions import ProjError
from pyproj.transformer import TransformerGroup

from georef.crs.axes import grid_turn_and_scale
from georef.crs.checks import crs_error, wrapped_deg
from georef.crs.definition import Parts
from georef.crs.geodetic import INVERSE, cartesian, transform
from georef.errors import CrsError
from georef.geometry.rigid import Array

_BIJECTIVE_M, _MAX_REFINEMENTS = 5e-8, 4


class _Operation(NamedTuple):
    geodetic_from_crs: Transformer
    description: str
    accuracy_m: float | None


def find_operation(parts: Parts, lonlat_deg: Array) -> _Operation | None:
    """The best operation CRS -> geographic 3D of the same datum at a place; CrsError where PROJ cannot do it fully."""
    if parts.kind == "geocentric":
        return None
    (lon, lat), pad = lonlat_deg, 0.05
    box = AreaOfInterest(wrapped_deg(lon - pad), max(lat - pad, -90.0), wrapped_deg(lon + pad), min(lat + pad, 90.0))
    geodetic_3d = parts.geodetic.to_3d()
    strictly: dict[str, Any] = {"always_xy": True, "allow_ballpark": False, "area_of_interest": box}
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # the missing grid becomes an error just below
            group = TransformerGroup(parts.full, geodetic_3d, **strictly)
    except ProjError as error:
        raise _operation_error(parts, [], f": {error}") from error
    if not group.transformers or not group.best_available:
        missing = [op.grids for op in group.unavailable_operations[:1]]
        raise _operation_error(parts, [grid.short_name for grids in missing for grid in grids if not grid.available])
    best = group.transformers[0]
    # Rebuilt from its definition: the members of a group can neither be pickled nor shared by threads.
    accuracy = best.accuracy if best.accuracy >= 0 else None
    return _Operation(Transformer.from_pipeline(best.definition), best.description, accuracy)


def _operation_error(parts: Parts, grids: list[str], detail: str = "") -> CrsError:
    or_ellipsoidal = "or declare height = 'ellipsoidal' if that is what they are."
    if not grids:
        return crs_error(
            f"PROJ knows no exact way from heights of {parts.full.name!r} to ellipsoidal ones at the origin{detail}.",
            "a vertical CRS with a published geoid model on this datum and at this place",
            f"Check the origin and the height CRS; convert the heights, {or_ellipsoidal}",
        )
    names = " and the grid ".join(repr(name) for name in grids)
    sync = " and ".join(f"`pyproj sync --file {name}`" for name in grids)
    return crs_error(
        f"Heights of {parts.full.name!r} cannot be converted without the grid {names}, which is not installed.",
        # Asked of pyproj: its wheels do not read the environment variable PROJ_DATA.
        f"it where PROJ looks: {get_user_data_dir()}{os.pathsep}{get_data_dir()}",
        f"Run {sync}, or copy it there, {or_ellipsoidal}",
    )


class Route:
    """CRS <-> geocentric for one project. Longitudes and latitudes in degrees."""

    def __init__(self, parts: Parts, operation: _Operation | None, epoch: float | None) -> None:
        self.parts, self.operation, self.epoch = parts, operation, epoch
        self.cartesian = cartesian(parts.geodetic)

    def ecef_from_crs(self, points: Array) -> Array:
        """(N, 3) -> (N, 3) metres."""
        if self.operation is None:
            return points
        return transform(self.cartesian, self._geodetic_from_crs(points))

    def crs_from_ecef(self, points: Array) -> Array:
        """(N, 3) metres -> (N, 3)."""
        if self.operation is None:
            return points
        geodetic = transform(self.cartesian, points, direction=INVERSE)
        first = self._crs_from_geodetic(geodetic)
        if self.parts.kind == "geographic" and self.parts.vertical is None:
            return first
        # PROJ's two directions are not always each other's inverse: 0.8 mm in EPSG:3035 (a series for the authalic
        # latitude), 0.5 mm in heights where the geoid model is on another datum. Repeat until they are.
        out = first
        for _ in range(_MAX_REFINEMENTS):
            residual = first - self._crs_from_geodetic(self._geodetic_from_crs(out))
            if self.parts.kind == "geographic":
                residual[:, :2] = 0.0
            if np.abs(residual).max(initial=0.0) < _BIJECTIVE_M:
                break
            out = out + residual
        return out

    def _crs_from_geodetic(self, geodetic: Array) -> Array:
        assert self.operation is not None
        return transform(self.operation.geodetic_from_crs, geodetic, self.epoch, INVERSE)

    def _geodetic_from_crs(self, points: Array) -> Array:
        assert self.operation is not None
        return transform(self.operation.geodetic_from_crs, points, self.epoch)

    def describe(self, origin: Array) -> dict[str, Any]:
        """The part of `WorldFrame.describe` that a local CRS lacks; origin (1, 3)."""
        parts, ellipsoid = self.parts, self.parts.geodetic.ellipsoid
        lon, lat, height = transform(self.cartesian, self.ecef_from_crs(origin), direction=INVERSE)[0].tolist()
        authority = parts.horizontal.to_authority()
        out: dict[str, Any] = {
            "kind": parts.kind,
            "horizontal_name": parts.horizontal.name,
            "horizontal_code": ":".join(authority) if authority else None,
            "height_name": parts.vertical.name if parts.vertical is not None else "ellipsoidal height",
            "geodetic_name": parts.geodetic.name,
            "ellipsoid_name": ellipsoid.name if ellipsoid is not None else None,
            "origin_longitude_deg": lon,
            "origin_latitude_deg": lat,
            "origin_ellipsoidal_height_m": height,
            "operation": self.operation.description if self.operation is not None else None,
            "height_accuracy_m": self.operation.accuracy_m if self.operation is not None else 0.0,
        }
        if parts.kind == "projected":
            turn, scale = grid_turn_and_scale(parts, origin)
            out |= {"grid_scale": float(scale[0]), "grid_convergence_deg": -math.degrees(turn[0])}
        return out
