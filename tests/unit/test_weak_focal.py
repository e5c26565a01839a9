"""A focal length without height differences is warned of, one with relief is not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from georef.estimation.adjustment.block import Block, Calibration, PointPriors, RigCamera
from georef.estimation.adjustment.equations.reduced import Layout
from georef.estimation.adjustment.gtsam_reference.graph import BlockGraph
from georef.estimation.adjustment.quality.weak_focal import WeakFocal, weak_focals
from georef.estimation.datum.singular import explain_singular
from georef.geometry.camera import Camera
from georef.geometry.poses import Poses
from georef.geometry.rigid import Rigid3
from georef.types.scene import Observations
from tests.unit.test_datum import observed, reduced_of

_CAMERA = Camera("aerial", 4000, 4000, 2000.0, 2000.0, 2000.0, 2000.0, estimate=("focal",))


def flight(relief_m: float, tilt_rad: float = 0.0) -> Block:
    """Nine nadir images from 40 m, forty points on ground of some relief, six of which are control."""
    rng = np.random.default_rng(0)
    x, y = (a.ravel() for a in np.meshgrid([-15.0, 0.0, 15.0], [-15.0, 0.0, 15.0]))
    down = np.diag([1.0, -1.0, -1.0])
    turns = np.concatenate([[[0.0, 0.0, 0.0]] * 5, [[tilt_rad, 0.0, 0.0]] * 4]) + 0.002 * rng.normal(size=(9, 3))
    turned = Poses.exp(np.concatenate([turns, np.zeros((9, 3))], axis=1))
    points = np.column_stack([rng.uniform(-18.0, 18.0, (40, 2)), relief_m * rng.uniform(-0.5, 0.5, 40)])
    point = np.arange(6)
    information = np.tile(np.eye(3) / 0.01**2, (6, 1, 1))
    names = tuple(f"GCP{i}" for i in point)
    return observed(
        Block(
            station_ids=tuple(f"s{i}" for i in range(9)),
            image_ids=tuple(f"i{i}" for i in range(9)),
            station=np.arange(9),
            mounting=np.zeros(9, np.int64),
            calibration=np.zeros(9, np.int64),
            mountings=(RigCamera("nadir", Rigid3.identity()),),
            calibrations=(Calibration(_CAMERA, np.array([[1.0 / 0.05**2]])),),
            world_from_rig=Poses(down @ turned.rotation, np.stack([x, y, np.full(9, 40.0)], axis=1)),
            points=points,
            observations=Observations.joined([]),
            point_priors=PointPriors(point, points[:6], information, 0 * point, names),
        )
    )


def weak(block: Block) -> tuple[WeakFocal, ...]:
    layout = Layout.of(block)
    matrix, _ = BlockGraph(block, block.start()).reduced()
    covariance = np.asarray(np.linalg.inv(matrix), dtype=np.float64)
    return weak_focals(block, block.start(), layout, covariance[6 * layout.stations :, 6 * layout.stations :])


def test_over_flat_ground_the_focal_length_is_weak_and_the_network_is_not_singular() -> None:
    block = flight(relief_m=0.2)
    found = weak(block)
    assert [w.camera_id for w in found] == ["aerial"]
    assert found[0].loss > 1000.0
    assert "distance to the scene" in str(found[0])
    assert explain_singular(block, block.start(), reduced_of(block)) is None


def test_the_sigma_is_that_of_the_adjustment() -> None:
    block = flight(relief_m=0.2)
    loose = replace(block, calibrations=(Calibration(_CAMERA, np.zeros((1, 1))),))
    held = weak(block)[0].sigma_px / _CAMERA.fx
    free = weak(loose)[0].sigma_px / _CAMERA.fx
    assert held == pytest.approx(1.0 / np.sqrt(1.0 / free**2 + 1.0 / 0.05**2), rel=1e-6)


@pytest.mark.parametrize("block", [flight(8.0), flight(0.2, 0.4)], ids=["relief", "slant"])
def test_relief_or_views_at_a_slant_determine_it(block: Block) -> None:
    assert weak(block) == ()
