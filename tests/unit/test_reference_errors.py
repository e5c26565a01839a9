"""Errors that reference views of one station share: rigid motion, propagation, and what a pose really does."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from georef.estimation.local_model import LocalModel, query_centred_model
from georef.estimation.pnp import EstimatedPose, refit_pose
from georef.estimation.reference_errors import ReferenceErrors
from georef.geometry.rigid import Array, Rigid3
from tests.unit.test_pnp import query_image
from tests.worlds.points import NOISE, common, court, photograph

STATIONS = ("a", "b", "a", None, "b")
_STEP = np.array([1e-5, 1e-5, 1e-5, 1e-4, 1e-4, 1e-4])


def random_poses(count: int, rng: np.random.Generator) -> list[Rigid3]:
    return [Rigid3.exp(rng.normal(size=6)) for _ in range(count)]


def random_covs(count: int, rng: np.random.Generator) -> list[Array]:
    factors = rng.normal(size=(count, 6, 6))
    return list(factors @ np.swapaxes(factors, 1, 2))


def test_views_of_a_station_move_as_one_rigid_body_and_others_do_not() -> None:
    rng = np.random.default_rng(1)
    poses = random_poses(5, rng)
    error = ReferenceErrors.of_stations(poses, random_covs(5, rng), STATIONS).draw(rng)
    moved = [pose.retract(0.1 * e) for pose, e in zip(poses, error, strict=True)]

    def changed(i: int, j: int) -> float:
        return float(np.abs((poses[i].inverse() @ poses[j]).local(moved[i].inverse() @ moved[j])).max())

    assert max(changed(0, 2), changed(1, 4)) < 1e-9
    assert min(changed(0, 1), changed(3, 0), changed(3, 1)) > 1e-3


def test_propagation_is_that_of_the_joint_covariance() -> None:
    rng = np.random.default_rng(2)
    errors = ReferenceErrors.of_stations(random_poses(5, rng), random_covs(5, rng), STATIONS)
    assert (len(errors), len(errors.covs)) == (5, 3)
    joint = np.zeros((5, 6, 5, 6))
    for i in range(5):
        for j in range(5):
            if errors.station[i] == errors.station[j]:
                joint[i, :, j] = errors.by_station[i] @ errors.covs[errors.station[i]] @ errors.by_station[j].T
    gains = rng.normal(size=(5, 8, 6))
    wide = np.swapaxes(gains, 0, 1).reshape(8, 30)
    np.testing.assert_allclose(errors.propagated(gains), wide @ joint.reshape(30, 30) @ wide.T, rtol=1e-10)
    alone = ReferenceErrors.independent(errors.covs[errors.station])
    assert np.abs(alone.propagated(gains) - errors.propagated(gains)).max() > 0.1


class Exact:
    """A query and references without any noise; the pose is estimated anew for other reference poses."""

    def __init__(self) -> None:
        rng = np.random.default_rng(3)
        world = court(3, points=120, references=5)
        self.poses = list(world.references)
        self.seen = [photograph(world, pose, rng, keypoint_sigma=0.0) for pose in self.poses]
        self.query = photograph(world, world.queries[0], rng, keypoint_sigma=0.0)
        self.truth = world.queries[0]

    def model(self, poses: list[Rigid3]) -> LocalModel:
        posed = [seen.posed(pose) for seen, pose in zip(self.seen, poses, strict=True)]
        return query_centred_model(posed, [common(self.query, seen) for seen in self.seen], NOISE.keypoint_sigma, 1e3)

    def estimate(self, poses: list[Rigid3], errors: ReferenceErrors, model: LocalModel | None = None) -> EstimatedPose:
        found = refit_pose(self.truth, query_image(self.query), model or self.model(poses), errors)
        assert found is not None
        return found


def test_a_pose_follows_the_errors_of_stations_as_its_covariance_says() -> None:
    exact = Exact()
    covs = [NOISE.pose_cov(pose) for pose in exact.poses]
    errors = ReferenceErrors.of_stations(exact.poses, covs, STATIONS)
    model = exact.model(exact.poses)
    start = exact.estimate(exact.poses, errors)
    gains = np.zeros((6, len(errors.covs), 6))
    for station in range(len(errors.covs)):
        for axis in range(6):
            step = _STEP[axis] * np.eye(6)[axis]
            moved = [
                pose.retract(errors.by_station[view] @ step) if errors.station[view] == station else pose
                for view, pose in enumerate(exact.poses)
            ]
            after = exact.estimate(moved, errors, replace(exact.model(moved), cov=model.cov))
            gains[:, station, axis] = start.world_from_cam.local(after.world_from_cam) / _STEP[axis]
    expected = np.einsum("isk,skl,jsl->ij", gains, errors.covs, gains)
    found = start.cov - start.relative_cov
    scale = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(found / np.outer(scale, scale), expected / np.outer(scale, scale), atol=0.02)
    alone = exact.estimate(exact.poses, ReferenceErrors.independent(covs))
    assert np.abs(np.diag(alone.cov - alone.relative_cov) / scale**2 - 1.0).max() > 0.15
