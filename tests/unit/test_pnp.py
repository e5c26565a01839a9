"""PnP: its covariance against Monte Carlo with the errors that references share, its gate, and failing geometry."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2

from georef.estimation.first_pose import QueryImage, ransac_pose
from georef.estimation.local_model import LocalModel, query_centred_model
from georef.estimation.pnp import EstimatedPose, refine_pose, with_covariance
from georef.estimation.reference_errors import ReferenceErrors
from georef.geometry.rigid import Rigid3
from georef.types.results import ReferenceNoise
from tests.worlds.points import (
    CAMERA,
    NOISE,
    Seen,
    World,
    common,
    court,
    disturbed,
    photograph,
    pose_nees,
    scaled_noise,
)

_RUNS = 200


def query_image(seen: Seen, sigma: float = NOISE.keypoint_sigma) -> QueryImage:
    return QueryImage(CAMERA, seen.posed().pixels, sigma * seen.features.scales_px.astype(float))


def nearby(pose: Rigid3, rng: np.random.Generator) -> Rigid3:
    return pose.retract(rng.normal(size=6) * np.repeat([0.003, 0.05], 3))


class Run:
    """One draw: reference poses with new errors, new keypoints, the query's local model."""

    def __init__(
        self, world: World, rng: np.random.Generator, noise: ReferenceNoise = NOISE, blunders: float = 0.0
    ) -> None:
        self.truth = world.queries[1]
        self.given = [disturbed(pose, noise, rng) for pose in world.references]
        references = [photograph(world, pose, rng, keypoint_sigma=noise.keypoint_sigma) for pose in world.references]
        self.seen = photograph(world, self.truth, rng, keypoint_sigma=noise.keypoint_sigma, blunders=blunders)
        posed = [seen.posed(pose) for seen, pose in zip(references, self.given, strict=True)]
        matches = [common(self.seen, seen) for seen in references]
        self.model = query_centred_model(posed, matches, noise.keypoint_sigma)
        self.query = query_image(self.seen, noise.keypoint_sigma)
        self.start = nearby(self.truth, rng)
        self.noise = noise

        self.errors = ReferenceErrors.independent([noise.pose_cov(pose) for pose in self.given])

    def estimate(self, errors: ReferenceErrors | None = None) -> EstimatedPose:
        estimate = refine_pose(self.start, self.query, self.model, errors or self.errors)
        assert estimate is not None
        return estimate


def interval(dof: float, tail: float = 0.005) -> tuple[float, float]:
    """Two-sided interval of a chi-square over its degrees of freedom."""
    return float(chi2.ppf(tail, dof)) / dof, float(chi2.ppf(1.0 - tail, dof)) / dof


def test_covariance_holds_with_shared_reference_errors_and_not_without_them() -> None:
    world, rng = court(1, points=170, references=5), np.random.default_rng(11)
    full, without, squares, predicted = [], [], [], []
    for _ in range(_RUNS):
        run = Run(world, rng)
        estimate = run.estimate()
        alone = with_covariance(
            estimate.world_from_cam,
            run.query,
            run.model,
            estimate.inliers,
            ReferenceErrors.independent(np.zeros((5, 6, 6))),
        )
        assert alone is not None
        np.testing.assert_allclose(alone.cov, estimate.relative_cov, rtol=1e-12)
        full.append(pose_nees(run.truth, estimate.world_from_cam, estimate.cov) / 6.0)
        without.append(pose_nees(run.truth, estimate.world_from_cam, alone.cov) / 6.0)
        squares.append(np.sum(run.truth.local(estimate.world_from_cam)[3:] ** 2))
        predicted.append(np.trace(estimate.cov[3:, 3:]))
    low, high = interval(6.0 * _RUNS)
    assert low - 0.1 < np.mean(full) < high, np.mean(full)  # residuals carry part of the reference errors a second time
    assert np.mean(without) > 5.0, np.mean(without)
    assert 0.9 < np.sqrt(np.mean(squares) / np.mean(predicted)) < 1.1


def test_covariance_holds_for_exact_references() -> None:
    world, rng = court(2, points=170, references=5), np.random.default_rng(12)
    exact = scaled_noise(NOISE, poses=1e-6)
    values, sigma0 = [], []
    for _ in range(_RUNS):
        run = Run(world, rng, exact)
        estimate = run.estimate()
        values.append(pose_nees(run.truth, estimate.world_from_cam, estimate.cov) / 6.0)
        sigma0.append(estimate.sigma0)
    low, high = interval(6.0 * _RUNS)
    assert low < np.mean(values) < high + 0.05, np.mean(values)
    assert 0.95 < np.mean(sigma0) < 1.05


def test_blunders_are_gated_and_healthy_points_kept() -> None:
    world, rng = court(4), np.random.default_rng(14)
    kept_blunders = lost = blunders = healthy = 0
    values = []
    for _ in range(25):
        run = Run(world, rng, blunders=0.3)
        estimate = run.estimate()
        bad = run.seen.blunder[run.model.keypoint]
        blunders, healthy = blunders + bad.sum(), healthy + (~bad).sum()
        kept_blunders += (estimate.inliers & bad).sum()
        lost += (~estimate.inliers & ~bad).sum()
        values.append(pose_nees(run.truth, estimate.world_from_cam, estimate.cov) / 6.0)
    assert blunders > 0.2 * (blunders + healthy)
    assert kept_blunders <= 0.01 * blunders
    assert lost < 0.02 * healthy  # 0.001 of the gate, and reference errors that are larger than keypoint noise
    assert 0.6 < np.mean(values) < 1.3, np.mean(values)


def test_sigma0_shows_understated_keypoint_noise_and_the_covariance_follows() -> None:
    world, rng = court(5), np.random.default_rng(15)
    run = Run(world, rng, scaled_noise(NOISE, poses=1e-6))
    stated = QueryImage(CAMERA, run.query.pixels, run.query.sigma_px / 2.0)
    model = LocalModel(
        run.model.keypoint, run.model.points, run.model.cov / 4.0, run.model.views, run.model.observations
    )
    honest, understated = run.estimate(), refine_pose(run.start, stated, model, run.errors)
    assert understated is not None
    assert understated.sigma0 == pytest.approx(2.0 * honest.sigma0, rel=0.05)
    np.testing.assert_allclose(understated.relative_cov, honest.relative_cov, rtol=0.15, atol=1e-9)


@pytest.mark.parametrize("origin", [(0.0, 0.0, 0.0), (4e5, 5e6, 300.0)])
def test_ransac_finds_the_pose_among_many_blunders_also_far_from_the_origin(origin: tuple[float, ...]) -> None:
    world, rng = court(6, origin=origin), np.random.default_rng(16)
    run = Run(world, rng, blunders=0.5)
    found = ransac_pose(run.query, run.model, gate_px=12.0, seed=0)
    assert found is not None
    pose, inliers = found.world_from_cam, found.inliers
    error = run.truth.local(pose)
    assert np.linalg.norm(error[:3]) < 0.005
    assert np.linalg.norm(error[3:]) < 0.1
    bad = run.seen.blunder[run.model.keypoint]
    assert not (inliers & bad).any()
    assert inliers.sum() > 0.9 * (~bad).sum()


def test_far_origin_changes_neither_pose_nor_covariance() -> None:
    origin = np.array([4e5, 5e6, 300.0])
    results = []
    for shift in (np.zeros(3), origin):
        run = Run(court(7, origin=tuple(shift)), np.random.default_rng(17))
        estimate = run.estimate()
        results.append((estimate.world_from_cam.translation - shift, estimate.cov))
    np.testing.assert_allclose(results[1][0], results[0][0], atol=1e-6)
    np.testing.assert_allclose(results[1][1], results[0][1], rtol=1e-3, atol=1e-12)


def test_no_pose_from_too_few_points_or_points_in_one_place() -> None:
    run = Run(court(8), np.random.default_rng(18))
    few = run.model.take(np.arange(len(run.model)) < 3)
    assert ransac_pose(run.query, few, gate_px=12.0, seed=0) is None
    assert refine_pose(run.start, run.query, few, run.errors) is None
    nothing = run.model.take(np.zeros(len(run.model), bool))
    assert ransac_pose(run.query, nothing, gate_px=12.0, seed=0) is None
    same = np.repeat(run.model.points[:1], len(run.model), axis=0)
    collapsed = LocalModel(run.model.keypoint, same, run.model.cov, run.model.views, run.model.observations)
    assert refine_pose(run.start, run.query, collapsed, run.errors) is None
