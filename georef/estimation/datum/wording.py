"""What separates two sources of positions, in plain words: the fault, its size and sigma, what to do about it."""

from __future__ import annotations

import numpy as np

from georef.estimation.datum.fine import Explanation
from georef.estimation.datum.gross import FOOT_M, SURVEY_FOOT_M, Gross
from georef.estimation.datum.types import Finding, Kind, Paired
from georef.geometry.rigid import Array

_GEOID_M = (10.0, 110.0)  # sizes of undulations, so that smaller constants are not called so
_FALSE_ORIGINS_M = (500_000.0, 1_000_000.0, 10_000_000.0)
_EARTH_RADIUS_M = 6_371_000.0
_ZONE_DEG = 6.0
_LONGEST_ARM_M = 6.0  # an antenna farther off is on no vehicle


_AXES: dict[str, tuple[Kind, str]] = {
    "swapped": ("axes swapped", "easting and northing are swapped"),
    "east reversed": ("handedness", "easting is reversed: the axes are left-handed"),
    "north reversed": ("handedness", "northing is reversed: the axes are left-handed"),
    "swapped and reversed": ("handedness", "easting and northing are swapped, and both reversed"),
    "turned by 90 degrees": ("axes turned", "the axes are turned by 90 degrees: easting is read as northing"),
    "turned by 180 degrees": ("axes turned", "easting and northing are both reversed"),
    "turned by -90 degrees": ("axes turned", "the axes are turned by -90 degrees: northing is read as easting"),
    "up reversed": ("heights reversed", "heights are reversed: depths, or axes with z down"),
    "mirrored": ("handedness", "the axes are left-handed, and turned"),
    "free": ("turn", "the axes are turned, by another angle"),
    "same": ("shift", "the axes are the same"),
}
_FEET = {
    "feet taken as metres": "is in feet that were taken as metres (3.2808 times too large)",
    "metres taken as feet": "is in metres that were taken as feet (0.3048 times its size)",
}


def gross_finding(paired: Paired, gross: Gross, sigma: Array, *, heights: bool = False) -> Finding:
    """Axes, units, or a turn of any angle."""
    what = "the height" if heights else "the position"
    second = paired.second_name
    share = f"{100 * gross.inlier.mean():.0f} % of {len(gross.inlier)} pairs agree"
    scale_sigma = gross.turn_sigma
    if gross.unit == "free":
        return _turned(paired, gross, share)
    kind, words = _AXES[gross.axes]
    texts = [f"of {second} {words}"] if gross.axes != "same" else []
    if gross.unit != "same":
        texts.append(f"{what} of {second} {_FEET[gross.unit]}{_which_foot(paired, gross)}")
        kind = "feet" if gross.axes == "same" else kind
    text = f"{'; '.join(texts)}, beside {paired.first_name} ({share}).".replace("of of", "of")
    remedy = (
        f"Declare the unit of {second} in its file's declaration."
        if kind == "feet"
        else f"Correct the order or sign of the axes in the declaration of {second}."
    )
    value = np.array([gross.scale])
    alternatives = tuple(_alike_words(alike) for alike in gross.alike)
    return Finding(kind, _sentence(text), remedy, value, np.array([scale_sigma]), alternatives)


def _turned(paired: Paired, gross: Gross, share: str) -> Finding:
    turn, sigma = np.degrees(gross.turn_rad), np.degrees(gross.turn_sigma)
    feet = _near_feet(gross)
    kind: Kind = "handedness" if gross.axes == "mirrored" else "feet" if feet else "turn"
    text = (
        f"{paired.second_name} is {'mirrored, ' if kind == 'handedness' else ''}turned by {turn:+.4f} degrees "
        f"(sigma {sigma:.4f}) and {gross.scale:.6f} times as large (sigma {gross.turn_sigma:.6f}), "
        f"beside {paired.first_name} ({share}){feet}."
    )
    remedy = "Check zone and grid north against true north, and that both are in one coordinate reference system."
    value, sigmas = np.array([gross.turn_rad, gross.scale]), np.array([gross.turn_sigma, gross.turn_sigma])
    alternatives = tuple(_alike_words(alike) for alike in gross.alike)
    return Finding(kind, _sentence(text), remedy, value, sigmas, alternatives)


def _near_feet(gross: Gross) -> str:
    for scale, words in ((1 / FOOT_M, "feet as metres"), (FOOT_M, "metres as feet")):
        if abs(gross.scale / scale - 1.0) < max(0.02 if gross.coarse else 0.0, 4.0 * gross.turn_sigma):
            return f"; this is the scale of {words}"
    return ""


def _which_foot(paired: Paired, gross: Gross) -> str:
    """International or survey foot: their difference, 2 parts in a million, shows in the coordinates' large numbers."""
    if len(gross.shift) != 2:
        return ""
    if paired.crs_origin_m is None:
        return "; whether international or US survey feet cannot be seen without the origin of the frame"
    origin = np.array(paired.crs_origin_m)
    feet = {"international feet": FOOT_M, "US survey feet": SURVEY_FOOT_M}
    off = {}
    for name, foot in feet.items():
        scale = 1.0 / foot if gross.scale > 1.0 else foot
        off[name] = float(np.linalg.norm(gross.shift - (scale * gross.matrix @ origin - origin)))
    best = min(off, key=lambda name: off[name])
    return f"; {best} (to {off[best]:.2f} m)" if off[best] < 0.5 * max(off.values()) else ""


def far_finding(paired: Paired, gross: Gross) -> Finding:
    """A frame that lies elsewhere: a false origin, or another zone."""
    east, north = (float(v) for v in gross.shift)
    away = (
        f"{paired.second_name} lies {east / 1e3:+,.3f} km east and {north / 1e3:+,.3f} km north of {paired.first_name}"
    )
    sigma = np.full(2, float(np.median(paired.sigma_m[:, :2])) / np.sqrt(max(gross.inlier.sum(), 1)))
    origin = _false_origin(gross.shift, 1.0 + 5.0 * sigma)
    if gross.same and origin:
        text = f"{away}, unturned: {origin}."
        remedy = (
            f"Correct the false easting or northing, or the zone's number before the easting, of {paired.second_name}."
        )
        return Finding("false origin", _sentence(text), remedy, gross.shift, sigma)
    turn = f", turned by {np.degrees(gross.turn_rad):+.2f} degrees and {gross.scale:.4f} times as large"
    zones = ""
    if paired.latitude_rad is not None:
        degrees = np.degrees(east / (_EARTH_RADIUS_M * np.cos(paired.latitude_rad)))
        zones = f"; east by {degrees:+.1f} degrees of longitude, zones of 6 degrees: {degrees / _ZONE_DEG:+.1f}"
    text = f"{away}{'' if gross.same else turn}{zones}: the size of a wrong zone of the projection."
    remedy = f"Check the zone (EPSG code) declared for {paired.second_name} and for {paired.first_name}."
    return Finding("wrong zone", _sentence(text), remedy, gross.shift, sigma)


def _false_origin(shift: Array, within: Array) -> str:
    """In words, where both coordinates are off by nothing or by multiples of what projections add."""
    words = []
    for name, value, tolerance in zip(("easting", "northing"), shift, within, strict=True):
        if abs(value) < max(1000.0 * tolerance, 1000.0):
            continue
        unit = next((u for u in reversed(_FALSE_ORIGINS_M) if abs(value - u * round(value / u)) < tolerance), None)
        if unit is None:
            return ""
        words.append(f"its {name} has {value:+,.0f} m added")
    return " and ".join(words)


def level_finding(paired: Paired, found: tuple[Explanation, ...]) -> Finding:
    """A small difference of easting and northing; the best explanation, and others that do as well."""
    sound = tuple(e for e in found if float(np.abs(e.values.get("antenna", np.zeros(1))).max()) < _LONGEST_ARM_M)
    found = sound or found
    best = found[0]
    plain = [_part_words(paired, part, best) for part in best.values]
    kind: Kind = _KINDS[next(iter(best.values))] if len(best.values) == 1 else "several"
    others = tuple(
        "It may as well be this: "
        + _sentence("; ".join(_part_words(paired, part, other) for part in other.values))
        + "."
        for other in found[1:]
    )
    if others:
        kind = "undecided"
    remedy = " ".join(dict.fromkeys(_REMEDIES[part] for e in found for part in e.values))
    if others:
        remedy = f"These positions cannot tell which: streets of other directions would. {remedy}"
    value = np.concatenate([best.values[part][: _OWN[part]] for part in best.values])
    sigma = np.concatenate([best.sigma(part)[: _OWN[part]] for part in best.values])
    return Finding(kind, _sentence("; ".join(plain)) + ".", remedy, value, sigma, others)


_KINDS: dict[str, Kind] = {"shift": "shift", "antenna": "antenna offset", "turn": "turn", "scale": "scale"}
_OWN = {"shift": 2, "antenna": 2, "turn": 1, "scale": 1}  # values that describe a part
_REMEDIES = {
    "shift": "Check the datum and epoch of both (frames of one name differ by decimetres), and the base station.",
    "antenna": "Check the lever arm from the rig's origin to the antenna, its axes and its signs.",
    "turn": "Check grid north against true north, and the zone.",
    "scale": "Check whether grid distances were taken as distances on the ground.",
}


def _part_words(paired: Paired, part: str, found: Explanation) -> str:
    value, sigma, second = found.values[part], found.sigma(part), paired.second_name
    if part == "shift":
        return (
            f"{second} lies {value[0]:+.3f} m east (sigma {sigma[0]:.3f}) and {value[1]:+.3f} m north "
            f"(sigma {sigma[1]:.3f}) of {paired.first_name} everywhere{_survey_foot(paired, value, sigma)}"
        )
    if part == "antenna":
        return (
            f"{second} lies {value[0]:+.3f} m to the right (sigma {sigma[0]:.3f}) and {value[1]:+.3f} m ahead "
            f"(sigma {sigma[1]:.3f}) of {paired.first_name} in the vehicle's frame, whatever its heading: "
            "an antenna offset"
        )
    if part == "turn":
        turn, turn_sigma = np.degrees(value[0]), np.degrees(sigma[0])
        return f"{second} is turned by {turn:+.5f} degrees (sigma {turn_sigma:.5f}) against {paired.first_name}"
    parts, parts_sigma = 1e6 * value[0], 1e6 * sigma[0]
    return f"{second} is {parts:+.0f} parts in a million (sigma {parts_sigma:.0f}) larger than {paired.first_name}"


def _survey_foot(paired: Paired, shift: Array, sigma: Array) -> str:
    if paired.crs_origin_m is None:
        return ""
    expected = (SURVEY_FOOT_M / FOOT_M - 1.0) * np.array(paired.crs_origin_m)
    for sign in (1.0, -1.0):
        if np.all(np.abs(shift - sign * expected) < 4.0 * sigma) and np.linalg.norm(expected) > 10.0 * sigma.max():
            return "; this is what US survey feet taken as international ones, or the reverse, make at this origin"
    return ""


def height_finding(paired: Paired, found: tuple[Explanation, ...]) -> Finding:
    """A constant between heights, or one that grows with height."""
    best = found[0]
    second, first = paired.second_name, paired.first_name
    value = np.concatenate(list(best.values.values()))
    sigma = np.concatenate([best.sigma(part) for part in best.values])
    if "shift" not in best.values or "scale" in best.values:
        parts, parts_sigma = 1e6 * best.values["scale"][0], 1e6 * best.sigma("scale")[0]
        text = f"heights of {second} grow {parts:+.0f} parts in a million (sigma {parts_sigma:.0f}) beside {first}."
        return Finding("height scale", _sentence(text), "Check units and signs of heights.", value, sigma)
    off, off_sigma = float(value[0]), float(sigma[0])
    text = f"heights of {second} are {off:+.3f} m (sigma {off_sigma:.3f}) from those of {first}, the same everywhere"
    remedy = f"Check the height of the antenna above the rig's origin, the height datum of {second} and its epoch."
    if paired.geoid_m is not None and abs(abs(off) - abs(paired.geoid_m)) < 1.0 + 5.0 * off_sigma:
        text += f": this is the geoid's height above the ellipsoid there ({paired.geoid_m:.2f} m)"
        remedy = _geoid_remedy(second, first, off)
    elif _GEOID_M[0] < abs(off) < _GEOID_M[1]:
        text += ": the size of a geoid's height above the ellipsoid"
        remedy = _geoid_remedy(second, first, off)
    return Finding("height offset", _sentence(text) + ".", remedy, value, sigma)


def _geoid_remedy(second: str, first: str, off: float) -> str:
    higher, lower = (second, first) if off > 0 else (first, second)
    return (
        f"Where the geoid lies above the ellipsoid, {higher} has ellipsoidal heights and {lower} heights above "
        "the geoid (elsewhere the reverse): declare the vertical reference system of each."
    )


def unrelated_finding(first: str, second: str, what: str) -> Finding:
    """Nothing explains half of the pairs."""
    text = f"{what} of {second} and {first} have nothing in common: no shift, turn or scale explains half of the pairs."
    remedy = "Check that the pairs belong together (times, station names), and units and reference systems of both."
    return Finding("unrelated", _sentence(text), remedy, np.zeros(0), np.zeros(0))


def blind_to(level: Gross | None, height: Gross | None, *, still: bool, no_heading: bool) -> tuple[str, ...]:
    """What these pairs cannot show."""
    if still:
        return ("swapped axes, feet or turns: the positions lie too close together",)
    words = [] if level is None or not level.same else [_blind_words(alike) for alike in level.alike]
    if height is not None and height.same and height.alike:
        words.append("reversed heights or heights in feet, beyond a constant: the drive is too level")
    if no_heading:
        words.append("an antenna offset: there are no headings")
    return tuple(words)


def _blind_words(alike: tuple[str, str]) -> str:
    axes, unit = alike
    unit_words = f", with {unit}" if unit not in ("same", "free") else ""
    return f"that {_AXES[axes][1]}{unit_words}: the drive follows one line"


def _alike_words(alike: tuple[str, str]) -> str:
    axes, unit = alike
    unit_words = f", with {unit}" if unit not in ("same", "free") else ""
    return f"It may as well be this: {_AXES[axes][1]}{unit_words}."


def _sentence(text: str) -> str:
    return text[:1].upper() + text[1:]
