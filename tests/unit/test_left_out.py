"""Tracks without an image: nothing of its pixels is left, what it did not see stays, the rest is as if it were new."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from georef.config import CandidatesConfig, LocalizeConfig
from georef.estimation.localization import localize_image
from georef.estimation.reference_map import ReferenceMap
from georef.features.nearest import MutualNearest
from georef.types.campaign import Campaign
from georef.types.results import Localized
from georef.types.scene import ImageStructure
from tests.unit.test_reference_tracks import mapped
from tests.worlds.points import NOISE, court, new_image, pose_nees

LEFT_OUT = 3


def without(reference: ReferenceMap) -> ReferenceMap:
    return reference.without({reference.images[LEFT_OUT].image_id})


def named(structure: ImageStructure) -> list[tuple[int, int, int]]:
    """The point of each observation by its own image's keypoint, with view and keypoint."""
    obs = structure.observations
    return list(zip(structure.keypoint[obs.point].tolist(), obs.view.tolist(), obs.keypoint.tolist(), strict=True))


def test_no_pixel_of_the_image_is_left() -> None:
    reference, _, found = mapped(court(1), 1)
    moved = {}
    rng = np.random.default_rng(1)
    for index, structure in found.items():
        obs = structure.observations
        off = np.where(obs.view[:, None] == LEFT_OUT, rng.normal(0.0, 30.0, obs.pixel.shape), 0.0)
        moved[index] = replace(structure, observations=replace(obs, pixel=obs.pixel + off))
    other = ReferenceMap(Campaign("reference", reference.images), reference._read, NOISE, moved.__getitem__)
    plain, disturbed = without(reference), without(other)
    for index in range(len(plain)):
        a, b = plain.structure(index), disturbed.structure(index)
        assert len(a) > 40
        np.testing.assert_array_equal(a.keypoint, b.keypoint)
        np.testing.assert_array_equal(a.identity, b.identity)
        np.testing.assert_array_equal(a.points, b.points)
        np.testing.assert_array_equal(a.cov, b.cov)
        np.testing.assert_array_equal(a.observations.sigma_px, b.observations.sigma_px)


def test_what_the_image_did_not_see_stays_and_the_rest_is_less_certain() -> None:
    reference, _, found = mapped(court(2), 2)
    rest = without(reference)
    for index in range(len(rest)):
        before = found[index if index < LEFT_OUT else index + 1]
        after = rest.structure(index)
        obs = before.observations
        lost = set(before.keypoint[obs.point[obs.view == LEFT_OUT]].tolist())
        assert lost
        assert set(before.keypoint.tolist()) - lost <= set(after.keypoint.tolist()) <= set(before.keypoint.tolist())
        row, place = np.searchsorted(before.keypoint, after.keypoint), np.arange(len(after))
        same = ~np.isin(after.keypoint, sorted(lost))
        np.testing.assert_array_equal(before.points[row[same]], after.points[place[same]])
        larger = np.trace(after.cov, axis1=1, axis2=2) / np.trace(before.cov[row], axis1=1, axis2=2)
        assert np.median(larger[~same]) > 1.02
        old = {v: v - (v > LEFT_OUT) for v in range(len(reference)) if v != LEFT_OUT}
        assert set(named(after)) <= {(k, old[v], o) for k, v, o in named(before) if v != LEFT_OUT}
        assert np.bincount(after.observations.point).min() >= 2
        assert np.array_equal(after.observations.point, np.sort(after.observations.point))
        first = np.flatnonzero(np.diff(after.observations.point, prepend=-1))
        assert after.identity.tolist() == [[v, k] for p, v, k in zip(*_columns(after, first), strict=True)]


def _columns(structure: ImageStructure, rows: np.ndarray) -> tuple[list[int], list[int], list[int]]:
    obs = structure.observations
    return obs.point[rows].tolist(), obs.view[rows].tolist(), obs.keypoint[rows].tolist()


def test_the_same_track_has_the_same_point_and_name_from_every_image_that_stays() -> None:
    rest = without(mapped(court(4), 4)[0])
    points: dict[tuple[int, int], list[np.ndarray]] = {}
    for index in range(len(rest)):
        structure = rest.structure(index)
        for name, point in zip(structure.identity.tolist(), structure.points, strict=True):
            points.setdefault((name[0], name[1]), []).append(point)
    assert np.mean([len(found) >= 2 for found in points.values()]) > 0.95
    assert all(np.allclose(found, found[0], atol=1e-9) for found in points.values())


def test_left_out_images_are_as_far_off_as_predicted() -> None:
    values, errors = [], []
    for seed in range(12):
        reference, seen, _ = mapped(court(seed % 4), seed)
        given, image_id = reference.poses[LEFT_OUT], reference.images[LEFT_OUT].image_id
        image = new_image("new", given.translation + np.array([1.0, -1.5, 2.0]))
        outcome = localize_image(
            image,
            seen[LEFT_OUT].features,
            reference.without({image_id}),
            MutualNearest(),
            CandidatesConfig(ranking="votes"),
            LocalizeConfig(method="tracks"),
            2048,
        )
        assert isinstance(outcome, Localized), outcome
        assert image_id not in {match.reference_id for match in outcome.matches}
        cov = outcome.world_from_cam_cov + reference.pose_cov(LEFT_OUT)
        values.append(pose_nees(given, outcome.world_from_cam, cov) / 6.0)
        errors.append(float(np.linalg.norm(outcome.world_from_cam.translation - given.translation)))
    assert 0.001 < np.median(errors) < 0.04, np.median(errors)
    assert 0.5 < np.mean(values) < 1.6, np.mean(values)
