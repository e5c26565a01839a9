"""The datum sentinel: each planted fault is found and named with its size, and nothing where there is nothing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from pyproj import Transformer

from georef.estimation.datum.sentinel import DatumReport, Paired, compare_datums
from georef.simulate.drive_city import draw_route

_ORIGIN = (400_000.0, 5_540_000.0)
_SIGMA, _DRIFT, _EACH = 0.03, 0.03, 25  # m, m, positions between nodes of the drift
_STRAIGHT = 0.4  # heading, rad


def _drive(seed: int, n: int = 300, heading: float | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Positions and headings along streets of a city, or one straight street."""
    if heading is None:
        poses = draw_route(n, np.random.default_rng([seed, 1])).world_from_rig
        return poses.translation, np.arctan2(poses.rotation[:, 0, 1], poses.rotation[:, 1, 1])
    s = 4.0 * np.arange(n)
    wander = np.radians(0.5) * np.random.default_rng([seed, 1]).normal(size=n)
    return np.column_stack([s * np.sin(heading), s * np.cos(heading), 0.01 * s]), heading + wander


def _noisy(positions: np.ndarray, seed: int, outliers: float) -> np.ndarray:
    """With white noise, a drift, and outliers of 0.4 to 20 m."""
    rng, n = np.random.default_rng([seed, 2]), len(positions)
    nodes = _DRIFT * rng.normal(size=(n // _EACH + 2, 3))
    place = np.arange(n) / _EACH
    drift = np.column_stack([np.interp(place, np.arange(len(nodes)), nodes[:, k]) for k in range(3)])
    out = positions + drift + _SIGMA * rng.normal(size=(n, 3))
    bad = rng.random(n) < outliers
    out[bad] += rng.normal(size=(int(bad.sum()), 3)) * np.exp(rng.uniform(-1.0, 3.0, (int(bad.sum()), 1)))
    return out


def _report(first, second, heading, **known) -> DatumReport:
    return compare_datums(
        Paired("the map", "GNSS", first, second, np.full(first.shape, _SIGMA), _DRIFT, _EACH, heading, **known)
    )


def _kinds(report: DatumReport) -> list[str]:
    return [finding.kind for finding in report.findings]


def _arm(heading: np.ndarray, right: float, ahead: float) -> np.ndarray:
    s, c = np.sin(heading), np.cos(heading)
    return np.column_stack([c * right + s * ahead, -s * right + c * ahead, np.zeros(len(heading))])


def _crs(change):
    """What a change of projected coordinates does to world ones."""
    origin = np.array([*_ORIGIN, 0.0])
    return lambda p: change(p + origin) - origin


def _plus(*shift: float):
    return lambda p: p + np.array(shift)


_SWAP = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
_FAULTS = {
    "nothing": (lambda p: p, []),
    "geoid": (_plus(0.0, 0.0, 46.3), ["height offset"]),
    "height": (_plus(0.0, 0.0, -0.4), ["height offset"]),
    "swap": (_crs(lambda p: p @ _SWAP), ["axes swapped"]),
    "swap in world": (lambda p: p @ _SWAP, ["axes swapped"]),
    "feet": (_crs(lambda p: p / 0.3048), ["feet", "feet"]),
    "metres as feet": (lambda p: p * 0.3048, ["feet", "feet"]),
    "heights in feet": (lambda p: _plus(0.0, 0.0, 60.0)(p) * [1.0, 1.0, 1.0 / 0.3048], ["feet"]),
    "false easting": (_plus(500_000.0, 0.0, 0.0), ["false origin"]),
    "shift": (_plus(0.12, -0.2, 0.0), ["shift"]),
    "left-handed": (lambda p: p * [1.0, -1.0, 1.0], ["handedness"]),
    "depths": (lambda p: p * [1.0, 1.0, -1.0], ["heights reversed"]),
    "turn": (lambda p: p @ _about_up(np.radians(0.4)).T, ["turn"]),
    "large turn": (lambda p: p @ _about_up(np.radians(7.0)).T, ["turn"]),
}


def _about_up(angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


@pytest.mark.parametrize("name", _FAULTS)
@pytest.mark.parametrize("seed", [1, 2])
def test_each_fault_is_named(name: str, seed: int) -> None:
    fault, kinds = _FAULTS[name]
    positions, heading = _drive(seed)
    report = _report(positions, _noisy(fault(positions), seed, 0.3), heading, crs_origin_m=_ORIGIN)
    assert _kinds(report) == kinds
    assert report.outliers == pytest.approx(0.3, abs=0.08)
    assert all(finding.text.endswith(".") and finding.remedy for finding in report.findings)


def test_sizes_and_their_sigmas() -> None:
    """Over drives, errors of what is found have the sigma that is stated, on either side."""
    shift, height, arm = [], [], []
    for seed in range(25):
        positions, heading = _drive(seed)
        report = _report(positions, _noisy(_plus(0.15, -0.25, 0.3)(positions), seed, 0.3), heading)
        (level, up) = report.findings
        shift.append((level.value - [0.15, -0.25]) / level.sigma)
        height.append((up.value - 0.3) / up.sigma)
        turned = _report(positions, _noisy(positions + _arm(heading, 0.3, -0.6), seed, 0.3), heading)
        (finding,) = turned.findings
        assert finding.kind == "antenna offset"
        arm.append((finding.value - [0.3, -0.6]) / finding.sigma)
    for errors in (shift, height, arm):
        assert 0.5 < np.sqrt(np.mean(np.square(errors))) < 1.4


def test_nothing_is_found_where_there_is_nothing() -> None:
    """Of 36 drives of several lengths, half of them with outliers, none has a finding (nor had any of 4,000 others)."""
    found = []
    for seed in range(36):
        positions, heading = _drive(seed, (40, 120, 300)[seed % 3], (None, _STRAIGHT)[seed // 3 % 2])
        report = _report(positions, _noisy(positions, seed, (0.0, 0.3)[seed // 6 % 2]), heading)
        found += _kinds(report)
    assert found == []


def test_a_straight_street_cannot_tell_an_antenna_from_a_shift() -> None:
    positions, heading = _drive(3, heading=_STRAIGHT)
    report = _report(positions, _noisy(positions + _arm(heading, 0.3, -0.6), 3, 0.3), heading)
    (finding,) = report.findings
    assert finding.kind == "undecided"
    both = " ".join((finding.text, *finding.alternatives))
    assert "antenna offset" in both
    assert "everywhere" in both
    assert "streets of other directions" in finding.remedy


def test_what_a_straight_street_would_hide_is_said() -> None:
    positions, heading = _drive(4, heading=np.pi / 4)
    report = _report(positions, _noisy(positions, 4, 0.3), heading)
    assert report.findings == ()
    assert any("swapped" in what for what in report.blind_to)
    turned, heading = _drive(4)
    assert _report(turned, _noisy(turned, 4, 0.3), heading).blind_to == ()


def test_a_mirror_on_a_line_may_be_a_turn() -> None:
    positions, heading = _drive(5, heading=_STRAIGHT)
    (finding,) = _report(positions, _noisy(positions * [1.0, -1.0, 1.0], 5, 0.3), heading).findings
    assert finding.kind == "handedness"
    assert "turned" in finding.alternatives[0]


def test_a_wrong_zone_is_named_with_its_number() -> None:
    first, second, heading = _in_zones(32632, 32633)
    report = _report(first, _noisy(second, 6, 0.3), heading, latitude_rad=np.radians(50.0))
    assert _kinds(report) == ["wrong zone"]
    assert "zones of 6 degrees: +1.0" in report.findings[0].text
    assert report.findings[0].value[0] == pytest.approx(429_400.0, abs=1000.0)


def _in_zones(right: int, wrong: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A drive in the topocentric frame of 9.5 E 50 N, and the same with its projected coordinates read in a zone."""
    positions, heading = _drive(6)
    to_earth = Transformer.from_crs(4979, 4978, always_xy=True)
    origin = np.array(to_earth.transform(9.5, 50.0, 0.0))
    lon, lat = np.radians([9.5, 50.0])
    east = np.array([-np.sin(lon), np.cos(lon), 0.0])
    up = np.array([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)])
    world_from_earth = np.stack([east, np.cross(up, east), up])
    corner = Transformer.from_crs(4326, right, always_xy=True).transform(9.5, 50.0)
    frames = []
    for zone in (right, wrong):
        easting, northing = (positions[:, :2] + corner).T
        lonlat = Transformer.from_crs(zone, 4326, always_xy=True).transform(easting, northing)
        geocentric = np.column_stack(to_earth.transform(*lonlat, positions[:, 2]))
        frames.append((geocentric - origin) @ world_from_earth.T)
    return frames[0], frames[1], heading


@pytest.mark.parametrize("foot", ["international", "US survey"])
def test_which_foot_is_said_where_the_origin_is_known(foot: str) -> None:
    size = 0.3048 if foot == "international" else 1200.0 / 3937.0
    positions, heading = _drive(7)
    second = _noisy(_crs(lambda p: p / size)(positions), 7, 0.3)
    assert f"{foot} feet" in _report(positions, second, heading, crs_origin_m=_ORIGIN).findings[0].text
    assert "cannot be seen" in _report(positions, second, heading).findings[0].text


def test_survey_feet_taken_as_international_ones() -> None:
    positions, heading = _drive(8)
    second = _crs(lambda p: p * [1.000002, 1.000002, 1.0])(positions)
    (finding,) = _report(positions, _noisy(second, 8, 0.3), heading, crs_origin_m=_ORIGIN).findings
    assert finding.kind == "shift"
    assert "US survey feet" in finding.text


def test_a_known_geoid_is_recognised() -> None:
    positions, heading = _drive(9)
    second = _noisy(positions - [0.0, 0.0, 46.3], 9, 0.3)
    (finding,) = _report(positions, second, heading, geoid_m=46.1).findings
    assert "geoid" in finding.text
    assert "the map has ellipsoidal heights" in finding.remedy
    small = _report(positions, _noisy(positions - [0.0, 0.0, 2.0], 9, 0.3), heading)
    assert "geoid" not in small.findings[0].text


def test_a_few_surveyed_points_without_headings() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform(-200.0, 200.0, (8, 3)) * [1.0, 1.0, 0.05]
    noise = 0.01 * rng.normal(size=(8, 3))
    paired = Paired("the images", "control", points, points + noise, np.full((8, 3), 0.01), 0.0, 1.0)
    calm = compare_datums(paired)
    assert calm.findings == ()
    assert any("antenna" in what for what in calm.blind_to)
    shifted = compare_datums(replace(paired, second=points + noise + [0.0, 0.0, 0.3]))
    assert _kinds(shifted) == ["height offset"]
    assert shifted.findings[0].value[0] == pytest.approx(0.3, abs=0.03)
    swapped = compare_datums(replace(paired, second=(points + noise) @ _SWAP))
    assert _kinds(swapped) == ["axes swapped"]


def test_positions_that_belong_to_nothing() -> None:
    positions, heading = _drive(10)
    other = np.random.default_rng(3).uniform(-500.0, 500.0, positions.shape)
    report = _report(positions, other, heading)
    assert _kinds(report) == ["unrelated"]
    assert report.outliers == 1.0


def test_what_cannot_be_compared_is_refused_or_said() -> None:
    positions, heading = _drive(11, 40)
    with pytest.raises(ValueError, match="finite"):
        _report(positions * np.nan, positions, heading)
    with pytest.raises(ValueError, match="shapes"):
        _report(positions, positions[:5], heading)
    assert "4 are needed" in _report(positions[:3], positions[:3], heading[:3]).blind_to[0]
    standing = np.zeros((40, 3)) + 0.01 * positions[:1]
    assert "too close together" in _report(standing, _noisy(standing, 1, 0.0), heading).blind_to[0]
