"""Localization of what belongs together: the images of one exposure of a rig, and short sequences of exposures.

Images come localized one by one. Those that fit the calibrated rig give one pose of the station; the others, rejected
or in contradiction, are looked at again where the station says that they are. What fits nowhere stays as it was, with a
note: a contradiction is never averaged.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from scipy.stats import chi2

from georef.config import LocalizeConfig, StationsConfig
from georef.estimation.reference_map import ReferenceMap
from georef.estimation.station_image import StationImage, outcomes_of, station_of
from georef.estimation.station_problem import Member, station_problem
from georef.estimation.station_search import second_chance
from georef.estimation.station_solve import SolvedStations, solve_stations
from georef.estimation.timer import StepTimer
from georef.estimation.tracks import PairMatches
from georef.geometry.rigid import Array, Rigid3
from georef.types.results import Localized, Outcome, Rejected

_CONTRADICTION = 0.9999  # probability of the chi-square test of two images' stations

FindStation = Callable[[Sequence[StationImage]], Rigid3 | None]


def localize_station(
    images: Sequence[StationImage],
    reference: ReferenceMap,
    config: StationsConfig,
    localize: LocalizeConfig,
    find: FindStation | None = None,
) -> list[Outcome]:
    """The outcomes of a station's images, posed together where they fit its rig.

    find: looks for the station where no image was localized alone.
    """
    cpu_s: dict[str, float] = {}
    with StepTimer(cpu_s, "station"):
        outcomes = _together(images, reference, config, localize, find)
    shared = cpu_s["station"] / max(len(images), 1)
    return [replace(o, cpu_s={**o.cpu_s, "station": o.cpu_s.get("station", 0.0) + shared}) for o in outcomes]


def _together(
    images: Sequence[StationImage],
    reference: ReferenceMap,
    config: StationsConfig,
    localize: LocalizeConfig,
    find: FindStation | None,
) -> list[Outcome]:
    alone = [s.outcome for s in images]
    agreeing, note = fitting(images)
    if not agreeing and not note and find is not None:
        return _found(images, reference, config, localize, find)
    if not agreeing:
        return [replace(o, notes=(*o.notes, note)) if note else o for o in alone]
    start = station_of(images[agreeing[0]])
    members = [images[i].member(0) for i in agreeing]
    solved = _solved(members, start, reference, config)
    if solved is None:
        return [replace(o, notes=(*o.notes, "the images of its station do not fix one pose")) for o in alone]
    others = [i for i, s in enumerate(images) if i not in agreeing and not s.image.camera.estimate]
    tried = {i: second_chance(images[i], solved.state.world_from_rigs[0], reference, localize) for i in others}
    asked = [*agreeing, *(i for i, matches in tried.items() if matches)]
    if len(asked) > len(agreeing):
        members = [images[i].member(0, tried.get(i)) for i in asked]
        solved, asked = _joined(members, asked, agreeing, solved, reference, config, localize)
    if len(asked) < 2:
        return alone
    posed = outcomes_of(solved, reference, [images[i] for i in asked], list(range(len(asked))), localize)
    out = list(alone)
    for i, outcome in zip(asked, posed, strict=True):
        out[i] = _noted(outcome, images[i].outcome, len(asked), of_majority=i in agreeing)
    for i in set(tried) - set(asked):
        out[i] = replace(alone[i], notes=(*alone[i].notes, _left_alone(images[i], solved)))
    return out


def _found(
    images: Sequence[StationImage],
    reference: ReferenceMap,
    config: StationsConfig,
    localize: LocalizeConfig,
    find: FindStation,
) -> list[Outcome]:
    """The outcomes where no image was localized alone: two at least must fit, or all stay rejected."""
    alone = [s.outcome for s in images]
    start = find(images)
    if start is None:
        return alone
    asked = [i for i, s in enumerate(images) if not s.image.camera.estimate]
    members = [images[i].member(0, second_chance(images[i], start, reference, localize)) for i in asked]
    for _ in range(len(asked)):
        solved = _solved(members, start, reference, config) if len(asked) > 1 else None
        if solved is None:
            return alone
        enough = [_enough(solved, k, localize) for k in range(len(asked))]
        if all(enough):
            break
        members = [member for member, good in zip(members, enough, strict=True) if good]
        asked = [i for i, good in zip(asked, enough, strict=True) if good]
    else:
        return alone
    out = list(alone)
    posed = outcomes_of(solved, reference, [images[i] for i in asked], list(range(len(asked))), localize)
    for i, outcome in zip(asked, posed, strict=True):
        out[i] = _noted(outcome, alone[i], len(asked), of_majority=False)
    return out


def fitting(images: Sequence[StationImage]) -> tuple[list[int], str]:
    """Which localized images agree on one pose of the rig, most of them, and a note where no majority does."""
    usable = [i for i, s in enumerate(images) if s.usable]
    if not usable:
        return [], ""
    agree = np.array([[_agree(images[i], images[j]) for j in usable] for i in usable])
    best = int(agree.sum(axis=1).argmax())
    chosen = [i for i, fits in zip(usable, agree[best], strict=True) if fits]
    if len(usable) > 1 and 2 * len(chosen) <= len(usable):
        return [], f"the {len(usable)} localized images of its station contradict the rig; each is left alone"
    return chosen, ""


def _agree(a: StationImage, b: StationImage) -> bool:
    """Whether two images have the rig in one place, within what their covariances and the calibration allow."""
    difference = station_of(a).local(station_of(b))
    cov = _station_cov(a) + _station_cov(b)
    return bool(difference @ np.linalg.solve(cov, difference) <= chi2.ppf(_CONTRADICTION, 6))


def _station_cov(image: StationImage) -> Array:
    """Covariance (6, 6) of world_from_rig as one image has it, its mounting included."""
    assert isinstance(image.outcome, Localized)
    cov = image.outcome.world_from_cam_cov
    if image.mounting.cov is not None:
        cov = cov + image.mounting.cov
    adjoint = image.mounting.rig_from_cam.adjoint()
    return adjoint @ cov @ adjoint.T


def _solved(
    members: Sequence[Member], start: Rigid3, reference: ReferenceMap, config: StationsConfig
) -> SolvedStations | None:
    problem = station_problem(members, [start], [], reference)
    return solve_stations(problem, config.gate_probability) if len(problem.given) else None


def _joined(
    members: list[Member],
    asked: list[int],
    agreeing: list[int],
    before: SolvedStations,
    reference: ReferenceMap,
    config: StationsConfig,
    localize: LocalizeConfig,
) -> tuple[SolvedStations, list[int]]:
    """The station with the images that were looked at again, without those that still have too little that fits."""
    start = before.state.world_from_rigs[0]
    solved = _solved(members, start, reference, config)
    if solved is None:
        return before, agreeing
    enough = [i in agreeing or _enough(solved, k, localize) for k, i in enumerate(asked)]
    if all(enough):
        return solved, asked
    kept = [k for k, good in enumerate(enough) if good]
    again = _solved([members[k] for k in kept], start, reference, config)
    return (before, agreeing) if again is None else (again, [asked[k] for k in kept])


def _enough(solved: SolvedStations, member: int, config: LocalizeConfig) -> bool:
    """The test of a single image: enough points with a position, and enough of those that it has."""
    own = (solved.problem.observations.view == member) & ~solved.problem.free[solved.problem.observations.point]
    inliers = int((own & solved.inliers).sum())
    return inliers >= config.min_inliers and inliers >= config.min_inlier_ratio * int(own.sum())


def _noted(outcome: Outcome, before: Outcome, count: int, *, of_majority: bool) -> Outcome:
    notes = [f"posed together with the {count - 1} other images of its station"]
    if isinstance(before, Rejected):
        notes.append(f"alone it was rejected: {before.reason.value} ({before.detail})")
    elif not of_majority and isinstance(outcome, Localized):
        off = before.world_from_cam.local(outcome.world_from_cam)
        notes.append(
            f"alone its pose contradicted the rig: {1e3 * np.linalg.norm(off[3:]):.0f} mm and "
            f"{np.degrees(np.linalg.norm(off[:3])):.3f} deg away"
        )
    return replace(outcome, notes=(*outcome.notes, *notes))


def _left_alone(image: StationImage, solved: SolvedStations) -> str:
    if isinstance(image.outcome, Rejected):
        return "its station was localized by others, and too little of it matches there"
    off = station_of(image).local(solved.state.world_from_rigs[0])
    return (
        f"its pose contradicts the rig of its station by {1e3 * np.linalg.norm(off[3:]):.0f} mm and "
        f"{np.degrees(np.linalg.norm(off[:3])):.3f} deg; it is left alone"
    )


def localize_window(
    window: Sequence[Sequence[StationImage]],
    middle: int,
    ties: Sequence[PairMatches],
    reference: ReferenceMap,
    config: StationsConfig,
    localize: LocalizeConfig,
) -> list[Outcome]:
    """The outcomes of the middle station of a short sequence, posed with its neighbours and their tie points.

    The images have the poses of their stations; `ties` name them by their places in the flattened window. Where the
    sequence contradicts what the station has alone, that is kept.
    """
    own = window[middle]
    members = [image.member(s) for s, station in enumerate(window) for image in station]
    starts = [station_of(station[0]) for station in window]
    cpu_s: dict[str, float] = {}
    with StepTimer(cpu_s, "sequence"):
        problem = station_problem(
            members, starts, ties, reference, config.min_tie_point_rays, config.max_tie_points_per_image
        )
        solved = solve_stations(problem, config.gate_probability)
        if solved is None:
            return [replace(i.outcome, notes=(*i.outcome.notes, "its sequence does not fix its pose")) for i in own]
        places = [k for k, member in enumerate(members) if member.station == middle]
        posed = outcomes_of(solved, reference, own, places, localize)
    note = f"posed in a sequence of {len(window)}"
    share = cpu_s["sequence"] / len(own)
    return [_if_it_fits(image.outcome, outcome, note, share) for image, outcome in zip(own, posed, strict=True)]


def _if_it_fits(alone: Outcome, outcome: Outcome, note: str, cpu_s: float) -> Outcome:
    """The pose in the sequence, unless it is farther from that of the station than that pose's own uncertainty."""
    timed = {**alone.cpu_s, "sequence": cpu_s}
    if isinstance(alone, Localized) and isinstance(outcome, Localized):
        off = alone.world_from_cam.local(outcome.world_from_cam)
        if off @ np.linalg.solve(alone.world_from_cam_cov, off) > chi2.ppf(_CONTRADICTION, 6):
            return replace(alone, notes=(*alone.notes, "its sequence contradicts it"), cpu_s=timed)
    return replace(outcome, notes=(*outcome.notes, note), cpu_s=timed)
