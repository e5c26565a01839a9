"""Stations and sequences: what they gain, that their covariances hold, and what becomes of images that do not fit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from georef.config import StationsConfig
from georef.estimation.guided import PosedFeatures
from georef.estimation.station_image import StationImage, station_of
from georef.estimation.station_problem import station_problem
from georef.estimation.station_search import first_station_pose
from georef.estimation.station_solve import solve_stations
from georef.estimation.stations import localize_station, localize_window
from georef.estimation.tracks import PairMatches
from georef.features.nearest import MutualNearest
from georef.geometry.rigid import Rigid3
from georef.types.results import Localized, Outcome, Rejected
from tests.worlds.points import common, pose_nees
from tests.worlds.rig import LOCALIZE, RIG_SIGMAS, RigSurvey, moved, rejected, rig_survey

CONFIG = StationsConfig()
_RUNS = 24


def station(survey: RigSurvey, images: list[StationImage] | None = None) -> list[Outcome]:
    return localize_station(images or list(survey.exposures[0].images), survey.reference, CONFIG, LOCALIZE)


def localized(outcome: Outcome) -> Localized:
    assert isinstance(outcome, Localized), outcome
    return outcome


def same_pose(a: Outcome, b: Outcome) -> bool:
    return np.array_equal(localized(a).world_from_cam.matrix(), localized(b).world_from_cam.matrix())


def error_mm(survey: RigSurvey, outcome: Localized, camera: int, exposure: int = 0) -> float:
    truth = survey.exposures[exposure].truth(camera)
    return 1e3 * float(np.linalg.norm(outcome.world_from_cam.translation - truth.translation))


def interval(dof: float, tail: float = 0.005) -> tuple[float, float]:
    return float(chi2.ppf(tail, dof)) / dof, float(chi2.ppf(1.0 - tail, dof)) / dof


def test_a_station_of_one_image_is_that_image() -> None:
    survey = rig_survey(1, calibrated=None)
    image = survey.exposures[0].images[0]
    before = localized(image.outcome)
    problem = station_problem([image.member(0)], [station_of(image)], [], survey.reference)
    solved = solve_stations(problem)
    assert solved is not None
    (cov,), (relative,) = solved.covs(survey.reference)
    off = before.world_from_cam.local(solved.poses()[0])
    assert np.all(np.abs(off) < 0.25 * np.sqrt(np.diag(before.relative_cov)))  # sigmas of tracks have steps of 19 %
    for mine, given in ((cov, before.world_from_cam_cov), (relative, before.relative_cov)):
        assert np.allclose(np.sqrt(np.diag(mine)), np.sqrt(np.diag(given)), rtol=0.05)


@pytest.mark.parametrize("calibrated", [True, False])
def test_a_station_is_better_than_its_images_and_its_covariance_holds(calibrated: bool) -> None:
    single, together, ratios = [], [], []
    for seed in range(_RUNS):
        survey = rig_survey(100 + seed, calibrated=RIG_SIGMAS if calibrated else None)
        for k, outcome in enumerate(map(localized, station(survey))):
            before = localized(survey.exposures[0].images[k].outcome)
            single.append(error_mm(survey, before, k))
            together.append(error_mm(survey, outcome, k))
            truth = survey.exposures[0].truth(k)
            ratios.append(pose_nees(truth, outcome.world_from_cam, outcome.world_from_cam_cov) / 6.0)
            assert outcome.notes[-1] == "posed together with the 1 other images of its station"
            assert np.linalg.eigvalsh(before.world_from_cam_cov - outcome.world_from_cam_cov)[-1] > 0
    low, high = interval(6 * _RUNS)  # of one image a draw: those of a station are far from independent
    assert low < np.mean(ratios) < high
    assert 0.3 < np.sqrt(np.mean(np.square(together)) / np.mean(np.square(single))) < 0.9


def test_an_image_that_was_rejected_alone_joins_its_station() -> None:
    survey = rig_survey(3)
    first, second = survey.exposures[0].images
    outcome = localized(station(survey, [first, rejected(second)])[1])
    assert error_mm(survey, outcome, 1) < 30
    assert outcome.correspondence_count >= LOCALIZE.min_inliers
    assert any(note.startswith("alone it was rejected: few_matches") for note in outcome.notes)
    assert {m.reference_id for m in outcome.matches} <= {f"r{i}" for i in range(6)}


def test_an_image_of_another_place_does_not_join() -> None:
    survey, other = rig_survey(3), rig_survey(4)
    first, second = survey.exposures[0].images
    seen = other.exposures[0].seen[1]
    shuffled = replace(seen.features, descriptors=seen.features.descriptors[::-1].copy())
    foreign = rejected(replace(second, features=PosedFeatures.of(shuffled, seen.camera, Rigid3.identity())))
    before, after = first.outcome, station(survey, [first, foreign])
    assert isinstance(after[1], Rejected)
    assert same_pose(after[0], before)


def test_two_images_that_contradict_the_rig_are_left_alone() -> None:
    survey = rig_survey(5)
    first, second = survey.exposures[0].images
    wrong = moved(second, [0.0, 0.0, 0.0, 0.3, 0.0, 0.0])
    for before, after in zip((first, wrong), station(survey, [first, wrong]), strict=True):
        assert same_pose(after, before.outcome)
        assert "contradict the rig" in after.notes[-1]


def test_a_majority_overrules_one_image_and_says_so() -> None:
    survey = rig_survey(6, cameras=3)
    images = list(survey.exposures[0].images)
    images[2] = moved(images[2], [0.0, 0.0, 0.0, 0.3, 0.0, 0.0])
    outcome = localized(station(survey, images)[2])
    assert error_mm(survey, outcome, 2) < 30
    assert "alone its pose contradicted the rig: 3" in outcome.notes[-1]  # 300 mm, about


def test_no_image_no_station() -> None:
    survey = rig_survey(8)
    images = [rejected(image) for image in survey.exposures[0].images]
    assert all(isinstance(outcome, Rejected) for outcome in station(survey, images))


def window_of(survey: RigSurvey) -> tuple[list[list[StationImage]], list[PairMatches]]:
    """The exposures as stations, and all true matches between their images."""
    window = []
    for exposure in survey.exposures:
        posed = localize_station(exposure.images, survey.reference, CONFIG, LOCALIZE)
        window.append([replace(i, outcome=o) for i, o in zip(exposure.images, posed, strict=True)])
    seen = [photo for exposure in survey.exposures for photo in exposure.seen]
    pairs = [(a, b) for a in range(len(seen)) for b in range(a + 1, len(seen))]
    return window, [PairMatches(a, b, common(seen[a], seen[b]).indices) for a, b in pairs]


def test_a_sequence_is_better_than_its_station_and_its_covariance_holds() -> None:
    before, after, ratios = [], [], []
    for seed in range(_RUNS // 2):
        survey = rig_survey(300 + seed, exposures=3)
        window, ties = window_of(survey)
        outcomes = localize_window(window, 1, ties, survey.reference, CONFIG, LOCALIZE)
        for k, outcome in enumerate(map(localized, outcomes)):
            before.append(error_mm(survey, localized(window[1][k].outcome), k, 1))
            after.append(error_mm(survey, outcome, k, 1))
            truth = survey.exposures[1].truth(k)
            ratios.append(pose_nees(truth, outcome.world_from_cam, outcome.world_from_cam_cov) / 6.0)
            assert outcome.notes[-1] == "posed in a sequence of 3"
    low, high = interval(6 * _RUNS // 2)
    assert low < np.mean(ratios) < high
    assert np.sqrt(np.mean(np.square(after)) / np.mean(np.square(before))) < 1.0


def test_free_tie_points_take_part_where_three_rays_see_them() -> None:
    survey = rig_survey(9, exposures=3)
    window, ties = window_of(survey)
    members = [image.member(s) for s, images in enumerate(window) for image in images]
    starts = [station_of(images[0]) for images in window]
    without = [replace(m, matches=m.matches[:2]) for m in members]  # two references: many points are free
    problem = station_problem(without, starts, ties, survey.reference)
    assert problem.free.sum() > 20
    assert np.bincount(problem.observations.point)[problem.free].min() >= 3
    solved = solve_stations(problem)
    assert solved is not None
    alone = solve_stations(station_problem(without, starts, [], survey.reference))
    assert alone is not None
    covs, covs_alone = solved.covs(survey.reference)[1], alone.covs(survey.reference)[1]
    assert all(np.trace(a[3:, 3:]) < np.trace(b[3:, 3:]) for a, b in zip(covs, covs_alone, strict=True))


def test_a_station_of_rejected_images_is_found_by_all_of_them_together() -> None:
    survey = rig_survey(10, points=400)
    images = [
        replace(i, outcome=replace(i.outcome, candidates=tuple(f"r{k}" for k in range(6))))
        for i in map(rejected, survey.exposures[0].images)
    ]

    def find(asked: Sequence[StationImage]) -> Rigid3 | None:
        return first_station_pose(asked, survey.reference, MutualNearest(ratio=0.9), 2000, 4, LOCALIZE)

    outcomes = localize_station(images, survey.reference, CONFIG, LOCALIZE, find)
    for k, outcome in enumerate(map(localized, outcomes)):
        assert error_mm(survey, outcome, k) < 30
        assert "alone it was rejected: few_matches (as a test)" in outcome.notes
    turned = [replace(i.mounting, rig_from_cam=i.mounting.rig_from_cam.inverse()) for i in images]
    scattered = [replace(i, mounting=mounting) for i, mounting in zip(images, turned, strict=True)]
    assert all(isinstance(o, Rejected) for o in localize_station(scattered, survey.reference, CONFIG, LOCALIZE, find))
