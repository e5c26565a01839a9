"""Networks that lack a constraint: the one that is missing is named, and none is where nothing is missing."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest

from georef.estimation.adjustment.block import (
    Antenna,
    Block,
    Calibration,
    Distances,
    PointPriors,
    PosePriors,
    PositionPriors,
    RelativePoses,
    RigCamera,
)
from georef.estimation.adjustment.equations.reduced import Layout, Reduced
from georef.estimation.adjustment.gtsam_reference.graph import BlockGraph
from georef.estimation.datum.singular import explain_singular
from georef.estimation.datum.singular_words import name_of_unknown
from georef.geometry.camera import Camera
from georef.geometry.poses import Poses
from georef.geometry.rigid import Array, Rigid3
from georef.types.scene import Observations
from tests.worlds.dense_normals import sparse
from tests.worlds.rig_blocks import rig_block

CAMERA = Camera("cam", 4000, 3000, 2000.0, 2000.0, 2000.0, 1500.0)
_NORTH = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
_FULL, _LEVEL, _HEIGHT = (1.0, 1.0, 1.0), (1.0, 1.0, 0.0), (0.0, 0.0, 1.0)
_CONTROL = np.array([[-6.0, 30.0, 2.0], [5.0, 26.0, -3.0], [1.0, 35.0, 5.0]])
_ON_A_LINE = np.array([[-6.0, 30.0, 2.0], [0.0, 31.0, 1.0], [9.0, 32.5, -0.5]])


def network(first: Array = _CONTROL, seed: int = 0, camera: Camera = CAMERA) -> Block:
    """Seven single-camera stations look at thirty points, of which these are the first; no constraint yet."""
    rng = np.random.default_rng(seed)
    centres = np.stack([np.linspace(-6.0, 6.0, 7), rng.uniform(-1.0, 1.0, 7), rng.uniform(-1.0, 1.0, 7)], axis=1)
    turned = Poses.exp(np.concatenate([0.05 * rng.normal(size=(7, 3)), np.zeros((7, 3))], axis=1))
    others = rng.uniform([-8.0, 24.0, -6.0], [8.0, 36.0, 6.0], (30 - len(first), 3))
    block = Block(
        station_ids=tuple(f"S{i}" for i in range(7)),
        image_ids=tuple(f"i{i}" for i in range(7)),
        station=np.arange(7),
        mounting=np.zeros(7, np.int64),
        calibration=np.zeros(7, np.int64),
        mountings=(RigCamera("front", Rigid3.identity()),),
        calibrations=(Calibration(camera, np.zeros((len(camera.estimate),) * 2)),),
        world_from_rig=Poses(_NORTH @ turned.rotation, centres),
        points=np.concatenate([first, others]),
        observations=Observations.joined([]),
    )
    return observed(block)


def observed(block: Block) -> Block:
    """Every point in every image."""
    view, point = (
        a.ravel() for a in np.meshgrid(np.arange(len(block.image_ids)), np.arange(len(block.points)), indexing="ij")
    )
    pixel = block.views(block.start()).project(view, block.points[point])
    assert np.isfinite(pixel).all()
    sigma = np.full(len(view), 0.5)
    return replace(block, observations=Observations(point, view, pixel, sigma, np.full(len(view), -1)))


def with_control(block: Block, *axes: tuple[float, float, float], sigma_m: float = 0.01) -> Block:
    """The first points given, one along the axes of each tuple."""
    information = np.array([np.diag(a) for a in axes]) / sigma_m**2
    point = np.arange(len(axes))
    names = tuple(f"GCP{i}" for i in point)
    return replace(block, point_priors=PointPriors(point, block.points[point], information, 0 * point, names))


def with_points(block: Block) -> Block:
    return with_control(block, _FULL, _FULL, _FULL)


def with_gnss(block: Block, stations: list[int], sigma_m: float = 0.02, *, drift: bool = False) -> Block:
    station = np.array(stations)
    count = len(station)
    return replace(
        block,
        antennas=(Antenna("roof", np.zeros(3)),),
        drift_information=np.zeros((int(drift), 3, 3)),
        position_priors=PositionPriors(
            station,
            block.world_from_rig.translation[station],
            np.tile(sigma_m**2 * np.eye(3), (count, 1, 1)),
            0 * station,
            np.tile([0 if drift else -1, -1], (count, 1)),
            np.tile([1.0, 0.0], (count, 1)),
        ),
    )


def with_prior(block: Block, image: int) -> Block:
    pose = block.world_from_rig.take(np.array([image]))
    cov = np.diag([1e-3] * 3 + [0.02] * 3)[None] ** 2
    return replace(block, pose_priors=PosePriors(np.array([image]), pose, cov, np.zeros(1, np.int64)))


def reduced_of(block: Block) -> Reduced:
    """The reduced normal equations with all station pairs in their pattern that are not zero."""
    return sparse(Layout.of(block), *BlockGraph(block, block.start()).reduced())


def explained(block: Block) -> str | None:
    return explain_singular(block, block.start(), reduced_of(block))


@dataclass(frozen=True)
class Case:
    make: Callable[[], Block]
    says: tuple[str, ...]


def _scale_bar(block: Block) -> Block:
    length = float(np.linalg.norm(block.points[3] - block.points[4]))
    return replace(block, distances=Distances(np.array([3]), np.array([4]), np.array([length]), np.array([0.001])))


def _base(block: Block) -> Block:
    """Two cameras a metre apart at each station."""
    count = len(block.station_ids)
    sides = [RigCamera(name, Rigid3(np.eye(3), np.array([x, 0.3, 0.5]))) for name, x in (("left", 0.0), ("right", 1.0))]
    return observed(
        replace(
            block,
            image_ids=tuple(f"{side.name}{i}" for side in sides for i in range(count)),
            station=np.tile(np.arange(count), 2),
            mounting=np.repeat([0, 1], count),
            calibration=np.zeros(2 * count, np.int64),
            mountings=tuple(sides),
        )
    )


def _eccentric(block: Block) -> Block:
    """One camera a station, beside the centre of its rig."""
    return observed(replace(block, mountings=(RigCamera("front", Rigid3(np.eye(3), np.array([1.0, 0.3, 0.5]))),)))


def _blind_station(block: Block) -> Block:
    return replace(block, observations=block.observations.take(block.observations.view != 4))


def _second_part(block: Block) -> Block:
    """Stations 4 to 6 see other points than 0 to 3."""
    of_rest = block.observations.view >= 4
    return replace(block, observations=block.observations.take((block.observations.point >= 15) == of_rest))


def _two_points_of_one(block: Block) -> Block:
    keep = (block.observations.view != 5) | (block.observations.point < 2)
    return replace(block, observations=block.observations.take(keep))


def _free_mounting(block: Block) -> Block:
    return replace(block, mountings=(RigCamera("front", Rigid3.identity(), np.zeros((6, 6))),))


def _unused(block: Block) -> Block:
    """A mounting and a camera that no image has."""
    camera = replace(CAMERA, camera_id="spare", estimate=("focal",))
    return replace(
        block,
        mountings=(*block.mountings, RigCamera("rear", Rigid3.identity(), np.zeros((6, 6)))),
        calibrations=(*block.calibrations, Calibration(camera, np.ones((1, 1)))),
    )


def _unused_camera(block: Block) -> Block:
    camera = replace(CAMERA, camera_id="spare", estimate=("cx", "focal"))
    return replace(block, calibrations=(*block.calibrations, Calibration(camera, np.diag([1e4, 0.0]))))


_CASES = {
    "nothing": Case(network, ("has no datum", "position, orientation and scale", "210 image observations")),
    "scale bar": Case(lambda: _scale_bar(network()), ("no position and no orientation.\n", "1 measured distance")),
    "rig base": Case(lambda: _base(network()), ("no position and no orientation.\n",)),
    "one point": Case(
        lambda: with_control(network(), _FULL), ("turn about a single point", "no scale", "1 given point.", "three")
    ),
    "one point, scale": Case(lambda: _scale_bar(with_control(network(), _FULL)), ("turn about a single point,",)),
    "two points": Case(
        lambda: with_control(network(), _FULL, _FULL),
        ("turn about the line", "collinear", "2 given points", "off that line"),
    ),
    "collinear points": Case(
        lambda: with_control(network(_ON_A_LINE), *[_FULL] * 3),
        ("turn about the line", "along (0.97, 0.16, -0.16)", "3 given points"),
    ),
    "nearly collinear points": Case(
        lambda: with_control(network(_ON_A_LINE + 0.005 * np.eye(3)), *[_FULL] * 3), ("turn about the line",)
    ),
    "one position": Case(lambda: with_gnss(network(), [2]), ("turn about a single point", "1 GNSS position")),
    "two positions": Case(lambda: with_gnss(network(), [1, 5]), ("turn about the line", "2 GNSS positions")),
    "horizontal points": Case(
        lambda: with_control(network(), _LEVEL, _LEVEL, _LEVEL), ("has no height", "3 horizontal points", "heights")
    ),
    "heights": Case(
        lambda: with_control(network(), _HEIGHT, _HEIGHT, _HEIGHT),
        ("has no horizontal position", "about the vertical", "3 given heights", "horizontal control"),
    ),
    "positions that drift": Case(lambda: with_gnss(network(), list(range(7)), drift=True), ("has no position.",)),
    "an unseen station": Case(
        lambda: with_points(_blind_station(network())), ("Station 'S4' is not determined", "no observation and no")
    ),
    "an unseen station with a position": Case(
        lambda: with_gnss(with_points(_blind_station(network())), [4]), ("Station 'S4' is not", "1 GNSS position")
    ),
    "two parts": Case(
        lambda: with_points(_second_part(network())),
        (
            "part of the network around stations 'S4', 'S5', 'S6' has no datum",
            "do not tie it",
            "45 image observations.",
        ),
    ),
    "two points of one station": Case(
        lambda: with_points(_two_points_of_one(network())),
        ("Station 'S5' may move", "2 image observations", "Add tie points"),
    ),
    "no mounting held": Case(lambda: with_points(_free_mounting(network())), ("rig's frame", "'front'", "Hold")),
    "an unused mounting": Case(
        lambda: with_points(_unused(network())), ("Nothing determines the rotation of mounting 'rear'",)
    ),
    "an unused camera": Case(
        lambda: with_points(_unused_camera(network())), ("Nothing determines the focal of camera 'spare'",)
    ),
}


@pytest.mark.parametrize("name", _CASES)
def test_the_missing_constraint_is_named(name: str) -> None:
    said = explained(_CASES[name].make())
    assert said is not None
    for part in _CASES[name].says:
        assert part in said, said
    assert said.count("\n") in (1, 2)


_SOUND: dict[str, Callable[[], Block]] = {
    "three points": lambda: with_control(network(), _FULL, _FULL, _FULL),
    "weak points": lambda: with_control(network(), _FULL, _FULL, _FULL, sigma_m=0.5),
    "two points and a height": lambda: with_control(network(), _FULL, _FULL, _HEIGHT),
    "two horizontal points and three heights": lambda: with_control(
        network(np.concatenate([_CONTROL, _CONTROL[::-1] + 1.0])), _LEVEL, _LEVEL, _HEIGHT, _HEIGHT, _HEIGHT
    ),
    "positions": lambda: with_gnss(network(), list(range(7))),
    "poor positions": lambda: with_gnss(network(), list(range(7)), 0.2),
    "a pose and a scale bar": lambda: _scale_bar(with_prior(network(), 3)),
    "a pose and a rig base": lambda: with_prior(_base(network()), 3),
    "positions that drift and a point": lambda: with_control(with_gnss(network(), list(range(7)), drift=True), _FULL),
    "everything": lambda: rig_block(0, disturbed=0.1).block,
}


@pytest.mark.parametrize("name", _SOUND)
def test_nothing_is_said_of_a_network_that_lacks_nothing(name: str) -> None:
    assert explained(_SOUND[name]()) is None


def test_a_pose_prior_alone_leaves_the_scale() -> None:
    for block in (network(), _eccentric(network())):
        said = explained(with_prior(block, 3))
        assert said is not None
        assert "The network has no scale" in said
        assert "measured distance" in said


def test_parts_that_a_measured_motion_ties_are_one() -> None:
    block = with_control(_second_part(network(_CONTROL)), _FULL, _FULL, _FULL)
    said = explained(block)
    assert said is not None
    assert "'S4', 'S5', 'S6'" in said
    motion = block.world_from_rig.take(np.array([0])).inverse() @ block.world_from_rig.take(np.array([4]))
    tied = RelativePoses(np.array([0]), np.array([4]), motion, 1e-4 * np.eye(6)[None])
    said = explained(replace(block, relative_poses=tied))
    assert said is not None
    assert "around stations 'S4', 'S5', 'S6' has no scale" in said
    said = explained(replace(block, relative_poses=tied, point_priors=PointPriors.none()))
    assert said is not None
    assert "The network has no position and no orientation." in said  # the motion tells the scale


@pytest.mark.parametrize("dense", [1500, 0], ids=["dense", "sparse"])
def test_the_weakest_combination_is_found_in_large_networks_too(dense: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("georef.estimation.datum.singular._DENSE", dense)
    said = explained(_CASES["two points of one station"].make())
    assert said is not None
    assert "'S5'" in said
    assert explained(_SOUND["three points"]()) is None


def test_unknowns_have_names() -> None:
    block = rig_block(0).block
    layout = Layout.of(block)
    names = [name_of_unknown(block, layout, i) for i in range(layout.size)]
    assert names[0] == names[5] == "pose of station 's0'"
    assert names[36:38] == ["rotation of mounting 'right'"] * 2
    assert names[41] == "position of mounting 'right'"
    assert names[42:46] == [f"{name} of camera '{camera}'" for camera in ("left", "right") for name in ("focal", "k1")]
    assert names[46] == "lever arm of antenna 'mast'"
    assert [names[49], names[52]] == ["drift node 0", "drift node 1"]
    assert names[55] == "end of a measured distance, point 0"
