"""Pictures taken on their side: coordinates, what is stored and matched, and the second try of localization."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image as Picture

from georef.config import CandidatesConfig, LocalizeConfig
from georef.estimation.localization import localize_image
from georef.estimation.reference_map import ReferenceMap
from georef.estimation.turning import Looked
from georef.features.images import turned
from georef.features.nearest import MutualNearest
from georef.geometry.pixels import turn_angles, turn_keypoints, turned_size
from georef.io.exif import stated_quarter_turns
from georef.io.items import read_outcome, write_outcome
from georef.store.feature_store import FeatureStore
from georef.types.campaign import Image
from georef.types.features import Features, Matches
from georef.types.results import Localized, Outcome, Rejected, RejectReason
from tests.worlds.points import NOISE, Seen, court, new_image, photograph, pose_nees, reference_map, unit


@pytest.mark.parametrize("quarter_turns", range(4))
def test_keypoints_follow_the_turned_picture(quarter_turns: int) -> None:
    picture = np.arange(6 * 4 * 3, dtype=np.uint8).reshape(4, 6, 3)
    other = turned(picture, quarter_turns)
    assert (other.shape[1], other.shape[0]) == turned_size((6, 4), quarter_turns)
    for row in range(4):
        for column in range(6):
            place = turn_keypoints([[column + 0.5, row + 0.5]], size=(6, 4), quarter_turns=quarter_turns)[0]
            there = other[int(place[1] - 0.5), int(place[0] - 0.5)]
            np.testing.assert_array_equal(there, picture[row, column])


def test_one_quarter_turn_is_clockwise() -> None:
    top_left = turn_keypoints([[0.5, 0.5]], size=(6, 4), quarter_turns=1)
    np.testing.assert_array_equal(top_left, [[3.5, 0.5]])


@pytest.mark.parametrize("quarter_turns", range(4))
def test_directions_turn_with_the_keypoints(quarter_turns: int) -> None:
    angles = np.array([0.0, 0.4, 1.5, 3.1, -0.7, -3.1], np.float32)
    ends = np.column_stack([2.5 + np.cos(angles), 1.5 + np.sin(angles)])
    here, there = (turn_keypoints(p, size=(6, 4), quarter_turns=quarter_turns) for p in ([[2.5, 1.5]], ends))
    turned_angles = turn_angles(angles, quarter_turns)
    np.testing.assert_allclose(turned_angles, np.arctan2(*(there - here).T[::-1]), atol=1e-6)


@pytest.mark.parametrize("quarter_turns", range(4))
def test_features_of_a_turned_picture_are_of_the_image(quarter_turns: int, tmp_path: Path) -> None:
    found = _features((600, 800) if quarter_turns % 2 else (800, 600))
    mapped = found.turned_back(quarter_turns)
    assert mapped.image_size == (800, 600)
    assert mapped.quarter_turns == quarter_turns
    places, size = mapped.as_found
    assert size == found.image_size
    np.testing.assert_allclose(places, found.keypoints_px, atol=1e-4)
    as_found, expected = mapped.orientations_as_found, found.orientations_rad
    assert as_found is not None
    assert expected is not None
    np.testing.assert_allclose(as_found, expected, atol=1e-6)
    assert mapped.head(5).quarter_turns == quarter_turns
    source = tmp_path / "a.jpg"
    source.write_bytes(b"picture")
    store = FeatureStore(tmp_path)
    store.write("a", mapped, source)
    again = store.read("a")
    assert again.quarter_turns == quarter_turns
    np.testing.assert_array_equal(again.keypoints_px, mapped.keypoints_px)


def _features(size: tuple[int, int]) -> Features:
    rng = np.random.default_rng(3)
    return Features(
        size,
        rng.uniform((1, 1), np.subtract(size, 1), (30, 2)).astype(np.float32),
        np.linspace(1.0, 0.1, 30, dtype=np.float32),
        np.ones(30, np.float32),
        unit(rng.normal(size=(30, 16))).astype(np.float32),
        np.zeros((30, 3), np.uint8),
        rng.uniform(-3, 3, 30).astype(np.float32),
    )


@pytest.mark.parametrize(("orientation", "expected"), [(None, 0), (1, 0), (6, 1), (3, 2), (8, 3), (2, 0), (5, 0)])
def test_what_exif_states(orientation: int | None, expected: int, tmp_path: Path) -> None:
    exif = Picture.Exif()
    if orientation is not None:
        exif[0x0112] = orientation
    Picture.fromarray(np.zeros((20, 30, 3), np.uint8)).save(tmp_path / "a.jpg", exif=exif)
    assert stated_quarter_turns(tmp_path / "a.jpg") == expected


@dataclass
class _Rolled:
    """A picture whose features have the descriptors of the references only when it is turned by `upright_after`."""

    seen: Features
    upright_after: int
    stated_turns: int = 0
    looks: list[int] = field(default_factory=list)
    glances: list[int] = field(default_factory=list)

    def features(self, quarter_turns: int) -> Features:
        found = replace(self.seen, quarter_turns=quarter_turns)
        if quarter_turns == self.upright_after:
            return found
        noise = np.random.default_rng(quarter_turns).normal(size=found.descriptors.shape)
        return replace(found, descriptors=unit(noise).astype(np.float32))

    def glance(self, quarter_turns: int) -> Looked:
        self.glances.append(quarter_turns)
        return Looked(self.features(quarter_turns).head(200))

    def look(self, quarter_turns: int) -> Looked:
        self.looks.append(quarter_turns)
        return Looked(self.features(quarter_turns))


@dataclass(frozen=True, eq=False)
class _Survey:
    reference: ReferenceMap
    query: Seen
    image: Image


@pytest.fixture(scope="module")
def survey() -> _Survey:
    rng = np.random.default_rng(5)
    world = court(1)
    photos = [photograph(world, pose, rng, clutter=60) for pose in world.references]
    query = photograph(world, world.queries[2], rng, clutter=60)
    image = new_image("q", query.truth.translation + np.array([1.0, -1.0, 1.0]))
    return _Survey(reference_map(photos, world.references, NOISE), query, image)


class _CountingMatcher(MutualNearest):
    calls = 0

    def match(self, a: Features, b: Features) -> Matches:
        self.calls += 1
        return super().match(a, b)


def _localize(
    survey: _Survey, picture: _Rolled | None, taken: Features, matcher: MutualNearest | None = None
) -> Outcome:
    candidates = CandidatesConfig(ranking="votes")
    return localize_image(
        survey.image,
        taken,
        survey.reference,
        matcher or MutualNearest(),
        candidates,
        LocalizeConfig(),
        2048,
        picture=picture,
    )


@pytest.mark.parametrize("upright_after", [1, 2, 3])
def test_an_image_on_its_side_is_localized_turned(survey: _Survey, upright_after: int, tmp_path: Path) -> None:
    picture = _Rolled(survey.query.features, upright_after)
    assert isinstance(_localize(survey, None, picture.features(0)), Rejected)
    outcome = _localize(survey, picture, picture.features(0))
    assert isinstance(outcome, Localized)
    assert picture.looks == [upright_after]
    assert outcome.quarter_turns == upright_after
    assert f"turned by {90 * upright_after} deg" in " ".join(outcome.notes)
    assert pose_nees(survey.query.truth, outcome.world_from_cam, outcome.world_from_cam_cov) < 25.0
    assert outcome.cpu_s["turning"] > 0
    write_outcome(tmp_path / "q.npz", outcome)
    again = read_outcome(tmp_path / "q.npz")
    assert isinstance(again, Localized)
    assert again.quarter_turns == upright_after


def test_an_upright_image_is_not_turned(survey: _Survey) -> None:
    picture = _Rolled(survey.query.features, 0)
    outcome = _localize(survey, picture, survey.query.features)
    assert isinstance(outcome, Localized)
    assert (outcome.quarter_turns, picture.glances, picture.looks) == (0, [], [])
    assert "turning" not in outcome.cpu_s


@pytest.mark.parametrize("stated", [1, 3])
def test_what_the_file_states_is_tried_first_and_not_believed(survey: _Survey, stated: int) -> None:
    picture = _Rolled(survey.query.features, 1, stated_turns=stated)
    outcome = _localize(survey, picture, picture.features(0))
    assert isinstance(outcome, Localized)
    assert outcome.quarter_turns == 1
    assert picture.looks == ([1] if stated == 1 else [3, 1])
    assert bool(picture.glances) == (stated != 1)


def test_an_image_of_another_place_is_not_matched_again_and_again(survey: _Survey) -> None:
    """No way up has clearly more votes than another."""
    picture, matcher = _Rolled(survey.query.features, 9), _CountingMatcher()
    outcome = _localize(survey, picture, picture.features(0), matcher)
    assert isinstance(outcome, Rejected)
    assert outcome.reason in (RejectReason.FEW_MATCHES, RejectReason.FEW_INLIERS)
    assert picture.looks == []
    once = _CountingMatcher()
    _localize(survey, None, picture.features(0), once)
    assert matcher.calls == once.calls
