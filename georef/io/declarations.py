"""What the leading comment lines of a table declare: coordinate reference system, height, angles.

# CRS: EPSG:25832 (ETRS89 / UTM 32N), height: ellipsoidal GRS80, metres.
# Angles: degrees, R = Rx(omega) Ry(phi) Rz(kappa), image (right, top, back) to grid (E, N, up).
# Local engineering CRS of the site, metres.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, Protocol, get_args

from georef.errors import InputError

AngleConvention = Literal["omega-phi-kappa", "yaw-pitch-roll"]
AngleUnit = Literal["deg", "gon", "rad"]
ANGLE_NAMES: dict[AngleConvention, tuple[str, str, str]] = {
    "omega-phi-kappa": ("omega", "phi", "kappa"),
    "yaw-pitch-roll": ("yaw", "pitch", "roll"),
}
UNIT_NAMES: dict[str, str] = {"deg": "degrees", "gon": "gon", "rad": "radians"}

_CRS = re.compile(
    r"\bCRS\s*[:=]\s*(?:(?P<authority>EPSG|ESRI|IGNF|OGC)\s*:?\s*(?P<code>\w+)(?:\+(?P<vertical>\d+))?|local\b)", re.I
)
_LOCAL = re.compile(r"\blocal\b[^.,;]*\bCRS\b", re.I)
_HEIGHT = re.compile(r"\bheights?\s*[:=]\s*(?P<height>[^,;.]+)", re.I)
_ANGLES = re.compile(r"\bangles?\s*[:=]\s*(?P<text>.*)", re.I)
_UNIT = re.compile(r"\b(deg|degrees?|gons?|rad|radians?)\b", re.I)
_ROTATION = re.compile(r"R([xyz])\(\s*(-?\s*(?:omega|phi|kappa|yaw|pitch|roll))\s*\)", re.I)
_NAMED = {name: re.compile("[-, /]+".join(parts), re.I) for name, parts in ANGLE_NAMES.items()}
_AXES = re.compile(r"\b(?:image|camera)\s*\(([^)]*)\)\s*to\b", re.I)
_OMEGA_PHI_KAPPA = [("x", "omega"), ("y", "phi"), ("z", "kappa")]
_IMAGE_AXES = ["right", "top", "back"]


@dataclass(frozen=True)
class Declared:
    """What the comments of a file declare; None: nothing.

    crs is an authority code ("EPSG:25832") or "local"; height is "ellipsoidal", a vertical CRS ("EPSG:7837") or the
    text as it stands; angles is an AngleConvention, or the text of a convention that is neither; rows says on which
    row each of them stands.
    """

    crs: str | None = None
    height: str | None = None
    angles: str | None = None
    angle_unit: AngleUnit | None = None
    rows: dict[str, int] = field(default_factory=dict)


class Declaring(Protocol):
    """Anything that was read from a file with declarations."""

    @property
    def path(self) -> Path: ...
    @property
    def declared(self) -> Declared: ...


def parse_declarations(comments: Iterable[tuple[int, str]], path: Path) -> Declared:
    """The declarations of comment lines (row, text). Raises InputError when two lines contradict each other."""
    found: dict[str, tuple[int, str]] = {}
    for row, text in comments:
        for name, value in _declarations_of(text).items():
            if name in found and found[name][1] != value:
                earlier_row, earlier = found[name]
                raise InputError(
                    f"The comments declare two values of {name}: {earlier!r} (row {earlier_row}) and {value!r}.",
                    expected="one declaration a file.",
                    remedy="Delete the wrong one.",
                    path=path,
                    row=row,
                )
            found.setdefault(name, (row, value))
    values = {name: value for name, (_, value) in found.items()}
    return Declared(
        values.get("crs"),
        values.get("height"),
        values.get("angles"),
        next((unit for unit in get_args(AngleUnit) if unit == values.get("angle_unit")), None),
        {name: row for name, (row, _) in found.items()},
    )


def check_declared_crs(table: Declaring, horizontal: str) -> None:
    """Raise InputError when the file declares another horizontal CRS than the project; what cannot be compared passes.

    horizontal: [crs] horizontal of project.toml, e.g. "EPSG:25832" or "local"; of a compound "EPSG:25832+7837" the
    horizontal part counts.
    """
    declared = table.declared
    expected = normalized_crs(horizontal)
    comparable = expected == "local" or re.fullmatch(r"[A-Z]+:\w+", expected) is not None
    if declared.crs is None or declared.crs == expected or not comparable:
        return
    raise InputError(
        f"The file declares the CRS {declared.crs}, the project has {horizontal}.",
        expected=f"coordinates in {horizontal}, the [crs] horizontal of project.toml.",
        remedy=f"Correct [crs] horizontal in project.toml (or --set crs.horizontal={declared.crs}), transform the "
        "coordinates, or correct the comment.",
        path=table.path,
        row=declared.rows.get("crs"),
    )


def check_declared_height(table: Declaring, height: str) -> None:
    """Raise InputError when the file declares other heights than the project; what cannot be compared passes.

    height: [crs] height of project.toml, "ellipsoidal" or a vertical CRS such as "EPSG:7837".
    """
    declared, expected = table.declared, _normalized_height(height)
    if declared.height is None or declared.height == expected:
        return
    comparable = "ellipsoidal" in (declared.height, expected) or declared.height.startswith("EPSG:")
    if not comparable:
        return
    raise InputError(
        f"The file declares heights {declared.height!r}, the project has {height!r}.",
        expected=f"heights as [crs] height of project.toml says: {height}.",
        remedy="Correct [crs] height in project.toml (or --set crs.height=...), transform the heights, or correct "
        "the comment.",
        path=table.path,
        row=declared.rows.get("height"),
    )


def check_declared_angles(table: Declaring, convention: AngleConvention, unit: AngleUnit) -> None:
    """Raise InputError when the file declares another angle convention or unit; no declaration passes."""
    declared = table.declared
    if declared.angles is not None and declared.angles != convention:
        raise InputError(
            f"The file declares the angles {declared.angles!r}, the project reads them as {convention}.",
            expected=f"{convention}"
            + (": R = Rx(omega) Ry(phi) Rz(kappa), image (right, top, back)." if convention[0] == "o" else "."),
            remedy="Correct `angles` in project.toml, convert the angles, or correct the comment.",
            path=table.path,
            row=declared.rows.get("angles"),
        )
    if declared.angle_unit is not None and declared.angle_unit != unit:
        raise InputError(
            f"The file declares its angles in {UNIT_NAMES[declared.angle_unit]}, the project reads {UNIT_NAMES[unit]}.",
            expected=f"angles in {UNIT_NAMES[unit]}.",
            remedy=f'Set angle_unit = "{declared.angle_unit}" in project.toml, or correct the comment.',
            path=table.path,
            row=declared.rows.get("angle_unit"),
        )


def normalized_crs(name: str) -> str:
    """An authority code in capitals without its vertical part; any local or engineering CRS is "local"."""
    text = name.strip()
    if re.match(r"local|engineering", text, re.I):
        return "local"
    return re.sub(r"\s+", "", text.split("+")[0]).upper()


def _normalized_height(text: str) -> str:
    stripped = text.strip()
    if re.match(r"ellipsoid", stripped, re.I):
        return "ellipsoidal"
    code = re.search(r"EPSG\s*:?\s*(\d+)", stripped, re.I)
    return f"EPSG:{code[1]}" if code else stripped


def _declarations_of(text: str) -> dict[str, str]:
    out: dict[str, str] = {}
    if text.startswith("Covariance:"):  # the second comment of poses.csv: its CRS is that of the origin
        return out
    crs = _CRS.search(text)
    if crs:
        out["crs"] = f"{crs['authority']}:{crs['code']}".upper() if crs["authority"] else "local"
        if crs["vertical"]:
            out["height"] = f"EPSG:{crs['vertical']}"
    elif _LOCAL.search(text):
        out["crs"] = "local"
    if height := _HEIGHT.search(text):
        value = _normalized_height(height["height"])
        if "crs" in out or value == "ellipsoidal" or value.startswith("EPSG:"):  # not "antenna height: 1.5 m"
            out["height"] = value
    if angles := _angles_of(text):
        out["angles"] = angles
    if (sentence := _ANGLES.search(text)) and (unit := _UNIT.search(sentence["text"])):
        out["angle_unit"] = unit[1].lower()[:3]
    return out


def _angles_of(text: str) -> str | None:
    rotation = [(axis.lower(), angle.lower().replace(" ", "")) for axis, angle in _ROTATION.findall(text)]
    if rotation:
        axes = _AXES.search(text)
        usual = axes is None or [name.strip().lower() for name in axes[1].split(",")] == _IMAGE_AXES
        if rotation == _OMEGA_PHI_KAPPA and usual:
            return "omega-phi-kappa"
        product = " ".join(f"R{axis}({angle})" for axis, angle in rotation)
        return product if usual or axes is None else f"{product}, image ({axes[1]})"
    return next((name for name, pattern in _NAMED.items() if pattern.search(text)), None)
