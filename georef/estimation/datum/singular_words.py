"""Singular networks in plain words: what is open, and what would close it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from georef.estimation.adjustment.block import Block, Indices
from georef.estimation.adjustment.equations.reduced import Layout
from georef.geometry.rigid import Array

_NAMED = 3  # stations or points that are named one by one
_SMALL = 0.02  # singular values of a basis, as parts of 1
_NEARLY_UP, _NEARLY_LEVEL = 0.999, 0.05


@dataclass(frozen=True, eq=False)
class Part:
    """Stations that observations tie together, and how nothing keeps them from moving as a whole."""

    stations: Indices
    centre: Array  # (3,) m
    open: Array  # (7, k) basis of open motions about the centre: translation m, rotation rad, growth as a factor


# --- the datum ------------------------------------------------------------------------------------


def missing_datum(block: Block, part: Part, *, whole: bool) -> str:
    """Which constraint is missing of a part of the network that may move as a whole."""
    subject = "The network" if whole else f"The part of the network around {_stations(block, part.stations)}"
    motions = _Motions.of(part)
    problem, remedy = _open_motions(motions)
    own = _given(block, part.stations)
    tied = "" if whole else " Image observations do not tie it to the rest."
    return f"{subject} {problem}.{tied}\nIts datum rests on {own}.\n{remedy}"


@dataclass(frozen=True, eq=False)
class _Motions:
    """Open motions by kind: pure translations (3, t), turns (3, r) that no translation replaces, growth or none."""

    translations: Array
    turns: Array
    grows: bool
    count: int
    line: tuple[Array, Array] | None  # a point and a direction of the line of the only open turn

    @staticmethod
    def of(part: Part) -> _Motions:
        reach = 10.0  # m that a radian stands for where directions are compared
        natural = part.open / np.array([reach] * 3 + [1.0] * 4)[:, None]
        basis = np.linalg.svd(natural, full_matrices=False)[0][:, : natural.shape[1]]
        _, values, mixed = np.linalg.svd(basis[3:], full_matrices=True)
        still = np.concatenate([values, np.zeros(len(mixed) - len(values))]) < _SMALL
        translations = basis[:3] @ mixed[still].T
        moving = basis @ mixed[~still].T
        turns, sizes, _ = np.linalg.svd(moving[3:6], full_matrices=False)
        turns = turns[:, sizes > _SMALL]
        grows = bool(np.linalg.norm(basis[6]) > _SMALL)
        line = None
        if basis.shape[1] == 1 and turns.shape[1] == 1 and not grows:
            spin, shift = basis[3:6, 0], reach * basis[:3, 0]
            # spin x (x - p) = shift + spin x (x - centre): the line's nearest point to the centre.
            line = part.centre + np.cross(spin, shift) / (spin @ spin), spin / np.linalg.norm(spin)
        return _Motions(translations, turns, grows, basis.shape[1], line)


def _open_motions(motions: _Motions) -> tuple[str, str]:
    """What is open (it follows the name of the network), and a remedy."""
    shifts, turns, grows = motions.translations.shape[1], motions.turns.shape[1], motions.grows
    upward = motions.translations[2] @ motions.translations[2] if shifts else 0.0
    if motions.count == 7:
        return "has no datum: nothing fixes its position, orientation and scale", _THREE_POINTS
    if shifts == 0 and turns == 0:
        return "has no scale", "Add a measured distance, or a second control point or GNSS position."
    if shifts == 0 and turns == 3:
        scale = ", and it has no scale" if grows else ""
        return f"may turn about a single point, the only one that is fixed{scale}", _THREE_POINTS
    if motions.line is not None:
        return f"may turn about the line through {_line(*motions.line)}: what is fixed is collinear", _OFF_THE_LINE
    if shifts == 3:
        lacks = ["position", *(["orientation"] if turns == 3 else []), *(["scale"] if grows else [])]
        turn = f", and it may turn about {_axes(motions.turns)}" if 0 < turns < 3 else ""
        return f"has no {' and no '.join(lacks)}{turn}", _THREE_POINTS if turns else "Add a control point."
    if shifts == 1 and upward > _NEARLY_UP:
        tilt = f", and it may tilt about {_axes(motions.turns)}" if turns else ""
        return f"has no height: what is fixed is horizontal only{tilt}", "Add three heights, or full control points."
    if shifts == 2 and upward < _NEARLY_LEVEL:
        turn = ", and it may turn about the vertical" if turns else ""
        scale = "; it has no scale either" if grows else ""
        return (
            f"has no horizontal position: only its height is fixed{turn}{scale}",
            "Add two horizontal control points.",
        )
    return f"may {_listed(motions)}", _THREE_POINTS


_THREE_POINTS = "Add control points (three that are not on one line), GNSS positions, or pose priors."
_OFF_THE_LINE = "Add a control point or a height off that line, GNSS positions off it, or a pose prior."


def _listed(motions: _Motions) -> str:
    parts = []
    if motions.translations.shape[1]:
        parts.append(f"shift along {_axes(motions.translations)}")
    if motions.turns.shape[1]:
        parts.append(f"turn about {_axes(motions.turns)}")
    if motions.grows:
        parts.append("change its scale")
    return " and ".join(parts)


def _axes(directions: Array) -> str:
    """East, north and up as far as they lie in the span of directions (3, k), else the directions."""
    names = [name for name, axis in zip(("east", "north", "up"), directions, strict=True) if axis @ axis > _NEARLY_UP]
    if len(names) == directions.shape[1]:
        return " and ".join(names)
    return " and ".join(f"({x:.2f}, {y:.2f}, {z:.2f})" for x, y, z in directions.T)


def _line(point: Array, direction: Array) -> str:
    x, y, z = point
    a, b, c = direction * np.sign(direction[np.argmax(np.abs(direction))])
    return f"({x:.1f}, {y:.1f}, {z:.1f}) m along ({a:.2f}, {b:.2f}, {c:.2f}) in the world frame"


# --- single unknowns ------------------------------------------------------------------------------


def unseen_stations(block: Block, stations: Indices) -> str:
    """Stations of which an unknown is observed by nothing."""
    plural = len(stations) > 1
    return (
        f"{_stations(block, stations, begin=True)} {'are' if plural else 'is'} not determined: "
        f"{'they have' if plural else 'it has'} {_given(block, stations)}.\n"
        "Leave such stations out, or add image observations, or a pose prior."
    )


def loose_stations(block: Block, stations: Indices) -> str:
    """Stations that may move against the rest."""
    return (
        f"{_stations(block, stations, begin=True)} may move against the rest of the network: too few points, or "
        f"points on one line, tie {'them' if len(stations) > 1 else 'it'} to it. There are {_given(block, stations)}.\n"
        "Add tie points, or a pose prior; or leave out what is tied so weakly."
    )


def loose_rig(mountings: Sequence[str]) -> str:
    return (
        f"Nothing fixes the rig's frame against its cameras ({_some(mountings, 'mounting')}): all their mountings are "
        "estimated.\nHold the mounting of one camera, or give one a weight."
    )


def unobserved_unknown(block: Block, layout: Layout, unknown: int) -> str:
    name = name_of_unknown(block, layout, unknown)
    return (
        f"Nothing determines the {name}.\n"
        "Hold it at its given value, give it a weight, or add observations that depend on it."
    )


def name_of_unknown(block: Block, layout: Layout, unknown: int) -> str:
    """What an unknown of the reduced system is: a station, or what the border holds."""
    if unknown < 6 * layout.stations:
        return f"pose of station {block.station_ids[unknown // 6]!r}"
    place = unknown - 6 * layout.stations
    groups = (layout.mounting, layout.calibration, layout.antenna, layout.drift, layout.kept_point)
    last = max((int(g[(g >= 0) & (g <= place)].max(initial=-1)), kind) for kind, g in enumerate(groups))
    start, kind = last
    index = int(np.flatnonzero(groups[kind] == start)[0])
    if kind == 0:
        return f"{'rotation' if place - start < 3 else 'position'} of mounting {block.mountings[index].name!r}"
    if kind == 1:
        camera = block.calibrations[index].camera
        return f"{camera.estimate[place - start]} of camera {camera.camera_id!r}"
    if kind == 2:
        return f"lever arm of antenna {block.antennas[index].name!r}"
    return f"drift node {index}" if kind == 3 else f"end of a measured distance, point {index}"


# --- what there is --------------------------------------------------------------------------------


def _given(block: Block, stations: Indices) -> str:
    """What refers to stations: "4 image observations, 1 control point"."""
    here = np.zeros(len(block.station_ids), bool)
    here[stations] = True
    of_image = here[block.station]
    observed = of_image[block.observations.view]
    seen = np.unique(block.observations.point[observed])
    rank = np.array([np.linalg.matrix_rank(i) for i in block.point_priors.information])
    at_seen = np.isin(block.point_priors.point, seen)
    full, level = (int((at_seen & (rank == r)).sum()) for r in (3, 2))
    counts = (
        (int(observed.sum()), "image observation"),
        (full, "given point"),
        (level, "horizontal point"),
        (int((at_seen & (rank == 1)).sum()), "given height"),
        (int(here[block.position_priors.station].sum()), "GNSS position"),
        (int(of_image[block.pose_priors.image].sum()), "pose prior"),
        (int((here[block.relative_poses.a] | here[block.relative_poses.b]).sum()), "measured motion"),
        (int(np.isin(block.distances.a, seen).sum()), "measured distance"),
    )
    said = [f"{count} {name}{'s' if count > 1 else ''}" for count, name in counts if count]
    return ", ".join(said) or "no observation and no constraint"


def _stations(block: Block, stations: Indices, *, begin: bool = False) -> str:
    return _some([block.station_ids[i] for i in stations], "Station" if begin else "station")


def _some(names: Sequence[str], what: str) -> str:
    listed = ", ".join(repr(name) for name in names[:_NAMED])
    more = f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
    return f"{what}{'s' if len(names) > 1 else ''} {listed}{more}"
