"""The layout of a block's unknowns."""

from __future__ import annotations

import numpy as np

from georef.estimation.adjustment.block import Antenna, Block, Calibration, Distances, RigCamera
from georef.estimation.adjustment.equations.reduced import Layout, Reduced
from georef.geometry.camera import Camera, project
from georef.geometry.poses import Poses
from georef.geometry.rigid import Rigid3
from georef.types.scene import Observations

_CAMERA = Camera("left", 4000, 3000, 2000.0, 2000.0, 2000.0, 1500.0, (0.01, 0.0, 0.0, 0.0), estimate=("focal", "k1"))


def _block() -> Block:
    rng = np.random.default_rng(0)
    none = np.zeros(0, np.int64)
    return Block(
        station_ids=("s0", "s1"),
        image_ids=("a0", "b0", "a1"),
        station=np.array([0, 0, 1]),
        mounting=np.array([0, 1, 0]),
        calibration=np.array([0, 1, 0]),
        mountings=(
            RigCamera("left", Rigid3.identity()),
            RigCamera("right", Rigid3.exp([0.0, 1.0, 0.0, 1.0, 0.0, 0.0]), np.eye(6)),
        ),
        calibrations=(Calibration(_CAMERA, np.zeros((2, 2))), Calibration.held(_CAMERA)),
        world_from_rig=Poses.exp(0.1 * rng.normal(size=(2, 6))),
        points=rng.normal(size=(3, 3)) + np.array([0.0, 0.0, 9.0]),
        observations=Observations(none, none, np.zeros((0, 2)), np.zeros(0), none),
        distances=Distances(np.array([2]), np.array([0]), np.array([1.0]), np.array([0.001])),
        antennas=(Antenna("roof", np.array([0.0, -2.0, 0.0])), Antenna("mast", np.zeros(3), np.eye(3))),
        drift_information=np.zeros((1, 3, 3)),
    )


def test_layout_counts_what_is_not_held() -> None:
    layout = Layout.of(_block())
    assert layout.mounting.tolist() == [-1, 0]
    assert layout.calibration.tolist() == [6, -1]
    assert layout.antenna.tolist() == [-1, 8]
    assert layout.drift.tolist() == [11]
    assert layout.kept_point.tolist() == [14, -1, 17]
    assert (layout.border, layout.size) == (20, 32)


def test_views_hang_off_the_stations() -> None:
    block = _block()
    state = block.start()
    pixels = block.views(state).project(np.array([0, 1, 2]), block.points)
    for image in range(3):
        pose = block.world_from_rig[block.station[image]] @ block.mountings[block.mounting[image]].rig_from_cam
        expected = project(_CAMERA, pose.inverse().apply(block.points[image : image + 1]))[0]
        assert np.allclose(pixels[image], expected, atol=1e-9, equal_nan=True)


def test_dense_form_is_symmetric_and_complete() -> None:
    layout = Layout.of(_block())
    rng = np.random.default_rng(1)
    diagonal = rng.normal(size=(2, 6, 6))
    blocks = np.stack([diagonal[0] + diagonal[0].T, rng.normal(size=(6, 6)), diagonal[1] + diagonal[1].T])
    border, corner = rng.normal(size=(12, 20)), rng.normal(size=(20, 20))
    reduced = Reduced(
        layout, np.array([0, 2, 3]), np.array([0, 1, 1]), blocks, border, corner + corner.T, np.zeros(layout.size)
    )
    dense = reduced.dense()
    assert np.array_equal(dense, dense.T)
    assert np.array_equal(dense[:6, 6:12], blocks[1])
    assert np.array_equal(dense[:12, 12:], border)
