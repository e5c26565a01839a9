"""What a project declares about its coordinates, and the CRS objects behind a checked declaration."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import pyproj
from pyproj import CRS
from pyproj.crs import CompoundCRS
from pyproj.exceptions import CRSError

from georef.crs.checks import crs_error

LOCAL = "local"
ELLIPSOIDAL = "ellipsoidal"

_DEGREE = math.pi / 180.0


@dataclass(frozen=True)
class CrsDefinition:
    """What a project declares about its coordinates; it is checked where it is first used.

    horizontal: any pyproj input ("EPSG:25832", "EPSG:25832+7837", WKT, ...), or "local" for an engineering CRS.
    height: "ellipsoidal", a vertical CRS ("EPSG:7837"), or None where horizontal has a height already or is local.
    epoch: decimal year of the coordinates; required where the frame moves (ITRF, one realisation of WGS 84).
    """

    horizontal: str
    height: str | None = None
    epoch: float | None = None


class Parts(NamedTuple):
    """A checked definition. full: with height; horizontal: without (geocentric: the same CRS again)."""

    kind: str
    full: CRS
    horizontal: CRS
    vertical: CRS | None

    @property
    def geodetic(self) -> CRS:
        """The geographic or geocentric CRS of the same datum."""
        crs = self.horizontal.geodetic_crs
        assert crs is not None, "checked when the definition was resolved"
        return crs


@lru_cache(maxsize=32)
def resolve(definition: CrsDefinition) -> Parts | None:
    """The CRS objects of a definition, None for a local one. Raises CrsError where it cannot be used."""
    _check_epoch(definition)
    if definition.horizontal == LOCAL:
        if definition.height is not None or definition.epoch is not None:
            raise crs_error(
                f"A local CRS is declared with height = {definition.height!r} and epoch = {definition.epoch!r}.",
                "neither: z is the height, and a local frame does not move",
                "Remove both keys.",
            )
        return None
    crs = _parse(definition.horizontal)
    if crs.is_bound and crs.source_crs is not None:
        crs = crs.source_crs  # +towgs84: no datum is ever changed here
    parts = _with_height(crs, definition)
    _check_axes(parts)
    _check_moving(parts, definition.epoch)
    return parts


def _parse(text: str) -> CRS:
    try:
        return CRS.from_user_input(text)
    except CRSError as error:
        raise crs_error(
            f"CRS {text!r} is not known to PROJ {pyproj.proj_version_str}.",
            "a code such as 'EPSG:25832' or 'EPSG:25832+7837', WKT, or 'local'",
            "Look the code up at https://epsg.org, or with pyproj.database.query_crs_info().",
        ) from error


def _with_height(crs: CRS, definition: CrsDefinition) -> Parts:
    label = f"CRS {definition.horizontal!r} ({crs.name})"
    if crs.is_compound or len(crs.axis_info) == 3:
        if definition.height is not None:
            raise crs_error(
                f"{label} has a height already, yet height = {definition.height!r} is declared.",
                "one declaration of the height",
                "Remove the key height, or give the horizontal part alone.",
            )
        if crs.is_geocentric:
            return Parts("geocentric", crs, crs, None)
        horizontal, vertical = crs.sub_crs_list if crs.is_compound else (crs.to_2d(), None)
        return Parts(_kind(horizontal, label), crs, horizontal, vertical)
    kind = _kind(crs, label)
    if definition.height is None:
        raise crs_error(
            f"{label} has no height, and none is declared.",
            "height = 'ellipsoidal', or a vertical CRS such as 'EPSG:7837'",
            "Declare what the heights of the coordinates refer to; georef does not guess it.",
        )
    if definition.height == ELLIPSOIDAL:
        return Parts(kind, crs.to_3d(), crs, None)
    vertical = _parse_vertical(definition.height)
    return Parts(kind, CompoundCRS(f"{crs.name} + {vertical.name}", [crs, vertical]), crs, vertical)


def _kind(crs: CRS, label: str) -> str:
    if crs.is_projected and len(crs.axis_info) == 2:
        return "projected"
    if crs.is_geographic and len(crs.axis_info) == 2:
        return "geographic"
    raise crs_error(
        f"{label} is a {crs.type_name}.",
        "a projected, geographic or geocentric CRS",
        "Give the CRS of the coordinates, or 'local' for an engineering CRS without a datum.",
    )


def _parse_vertical(text: str) -> CRS:
    try:
        vertical = CRS.from_user_input(text)
    except CRSError:
        vertical = None
    if vertical is None or not vertical.is_vertical or len(vertical.axis_info) != 1:
        what = "not known to PROJ" if vertical is None else f"a {vertical.type_name} ({vertical.name})"
        raise crs_error(
            f"height = {text!r} is {what}.",
            "'ellipsoidal', or a vertical CRS such as 'EPSG:7837' (DHHN2016 height)",
            "Look the code up at https://epsg.org, or with pyproj.database.query_crs_info(pj_types='VERTICAL_CRS').",
        )
    return vertical


def _check_axes(parts: Parts) -> None:
    """Refuse what would need more than an exchange of axes: feet, grads, westing, southing, depth, other meridians."""
    plane, up = parts.full.axis_info[:2], parts.full.axis_info[2]
    directed = {axis.direction for axis in plane} == {"east", "north"} and up.direction == "up"
    unit, factor = ("degree", _DEGREE) if parts.kind == "geographic" else ("metre", 1.0)
    scaled = (
        all(math.isclose(axis.unit_conversion_factor, factor) for axis in plane) and up.unit_conversion_factor == 1.0
    )
    if not scaled or not (directed or parts.kind == "geocentric"):
        axes = ", ".join(f"{axis.name} ({axis.direction}, {axis.unit_name})" for axis in (*plane, up))
        raise crs_error(
            f"CRS {parts.full.name!r} has the axes {axes}.",
            f"east and north in {unit}s and up in metres (or geocentric metres)",
            "Convert the coordinates to a CRS with such axes, and declare that one.",
        )
    meridian, angle = parts.geodetic.prime_meridian, parts.geodetic.axis_info[0].unit_conversion_factor
    in_degrees = parts.kind == "geocentric" or math.isclose(angle, _DEGREE)
    if not in_degrees or (meridian is not None and meridian.longitude != 0.0):
        raise crs_error(
            f"CRS {parts.full.name!r} rests on {parts.geodetic.name!r}, which does not count degrees from Greenwich.",
            "the meridian of Greenwich and degrees",
            "Convert the coordinates to a CRS of the same datum that does, and declare that one.",
        )


def _check_epoch(definition: CrsDefinition) -> None:
    if definition.epoch is not None and not 1900.0 <= definition.epoch <= 2200.0:
        raise crs_error(
            f"epoch = {definition.epoch} is no year.", "a decimal year such as 2021.5", "Correct the key epoch."
        )


def _check_moving(parts: Parts, epoch: float | None) -> None:
    datum = parts.geodetic.datum
    if epoch is None and datum is not None and datum.to_json_dict().get("type") == "DynamicGeodeticReferenceFrame":
        raise crs_error(
            f"CRS {parts.full.name!r} moves with time (datum {datum.name}), and no epoch is declared.",
            "epoch = the decimal year of the coordinates, such as 2021.5",
            "Declare it: such frames and the ground part by centimetres a year.",
        )


def crs_kind(definition: CrsDefinition) -> str:
    """ "projected", "geographic", "geocentric" or "local"; raises CrsError as `WorldFrame.create` does."""
    parts = resolve(definition)
    return LOCAL if parts is None else parts.kind
