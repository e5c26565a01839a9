"""The choice of references by what they are expected to tell of a pose."""

from __future__ import annotations

import numpy as np
import pytest

from georef.estimation.expected import Choice, most_informative
from georef.estimation.first_pose import QueryImage
from georef.estimation.guided import PosedFeatures
from georef.estimation.local_model import LocalModel, query_centred_model
from georef.estimation.pnp import refine_pose
from georef.estimation.reference_errors import ReferenceErrors
from georef.geometry.covariance import largest_position_sigma
from georef.geometry.projection import Views
from georef.geometry.rigid import Array, Rigid3, exp_so3
from georef.types.results import ReferenceNoise
from tests.worlds.points import CAMERA, NOISE, Seen, common, court, photograph, scaled_noise

_SIZE = np.array([CAMERA.width, CAMERA.height], dtype=float)


def _model(query: Seen, references: list[Seen]) -> LocalModel:
    posed: list[PosedFeatures] = [r.posed() for r in references]
    return query_centred_model(posed, [common(query, r) for r in references], NOISE.keypoint_sigma)


def _observed(query: Seen) -> QueryImage:
    return QueryImage(CAMERA, query.posed().pixels, NOISE.keypoint_sigma * query.features.scales_px.astype(float))


def _choose(query: Seen, model: LocalModel, poses: list[Rigid3], count: int, noise: ReferenceNoise = NOISE) -> Choice:
    return most_informative(
        query.truth,
        _observed(query),
        model,
        Views.of(poses, [CAMERA] * len(poses)),
        np.tile(_SIZE, (len(poses), 1)),
        [noise.pose_cov(pose) for pose in poses],
        noise,
        2,
        count,
    )


def _beside(pose: Rigid3, offset_m: list[float], turn_deg: float = 0.0) -> Rigid3:
    turn = exp_so3([0.0, np.radians(turn_deg), 0.0])
    return Rigid3(pose.rotation @ turn, pose.translation + np.array(offset_m))


def _sigma(query: Seen, references: list[Seen], noise: ReferenceNoise) -> float:
    found = refine_pose(
        query.truth,
        _observed(query),
        _model(query, references),
        ReferenceErrors.independent([noise.pose_cov(r.truth) for r in references]),
    )
    assert found is not None
    return largest_position_sigma(found.cov)


@pytest.fixture(scope="module")
def query() -> Seen:
    world = court(3, points=800)
    return photograph(world, world.queries[1], np.random.default_rng(3))


@pytest.fixture(scope="module")
def model(query: Seen) -> LocalModel:
    world, rng = court(3, points=800), np.random.default_rng(4)
    return _model(query, [photograph(world, pose, rng) for pose in world.references])


def test_rays_from_elsewhere_come_before_more_of_the_same(query: Seen, model: LocalModel) -> None:
    """Five references a few centimetres apart see most of what the query sees; two farther away see less."""
    crowd = [_beside(query.truth, [0.8 + 0.02 * i, -0.8, 0.0]) for i in range(5)]
    apart = [_beside(query.truth, [-3.0, -0.5, 0.2], 12.0), _beside(query.truth, [3.0, -0.5, 0.0], -12.0)]
    choice = _choose(query, model, [*crowd, *apart], 3)
    assert {5, 6} & set(choice.order[:2].tolist())
    assert choice.sigma_m[-1] < 0.5 * _choose(query, model, crowd, 5).sigma_m[-1]


def test_what_sees_nothing_of_it_is_left_out(query: Seen, model: LocalModel) -> None:
    away = _beside(query.truth, [0.5, 0.0, 0.0], 180.0)
    behind = _beside(query.truth, [0.0, 40.0, 0.0], 180.0)
    beside = [_beside(query.truth, [x, -1.0, 0.0]) for x in (-1.5, 1.5)]
    assert sorted(_choose(query, model, [away, beside[0], behind, beside[1]], 4).order) == [1, 3]
    assert len(_choose(query, model, [away, behind], 2).order) == 0


def test_a_reference_that_is_known_better_goes_first(query: Seen, model: LocalModel) -> None:
    poses = [_beside(query.truth, [x, -0.5, 0.0]) for x in (-2.0, 2.0, 2.05, -2.05)]
    views, sizes = Views.of(poses, [CAMERA] * 4), np.tile(_SIZE, (4, 1))
    weak, good = scaled_noise(NOISE, poses=10.0), NOISE
    covs: list[Array] = [noise.pose_cov(pose) for noise, pose in zip([weak, weak, good, good], poses, strict=True)]
    choice = most_informative(query.truth, _observed(query), model, views, sizes, covs, NOISE, 2, 4)
    assert sorted(choice.order[:2]) == [2, 3]


@pytest.mark.parametrize("pose_errors", [1.0, 0.01])
def test_the_expected_sigma_is_about_that_of_the_pose(query: Seen, model: LocalModel, pose_errors: float) -> None:
    """Of 85 % of 85 % of the points; the expectation has no surplus of blunders and no gate."""
    world, rng, noise = court(3, points=800), np.random.default_rng(8), scaled_noise(NOISE, poses=pose_errors)
    choice = _choose(query, model, list(world.references), 6, noise)
    assert len(choice.order) >= 4
    for count in (2, 3, 4):
        seen = [photograph(world, world.references[int(i)], rng) for i in choice.order[:count]]
        assert 0.5 < choice.sigma_m[count - 1] / _sigma(query, seen, noise) < 2.0
