"""The simulated street: its axis, what is where, what changes between the epochs, what hides what."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from georef.errors import ConfigError
from georef.geometry.angles import rotation_from_yaw_pitch_roll
from georef.geometry.camera import Camera
from georef.geometry.rigid import Rigid3
from georef.simulate import materials
from georef.simulate.axis import ground_height
from georef.simulate.lenses import Lens
from georef.simulate.scene import Scene, build_scene
from georef.simulate.shading import paint
from georef.simulate.street import Epoch, StreetOptions, build_street

LENS = Lens("small", 200, 150, Camera("small", 200, 150, 150.0, 150.0, 100.0, 75.0))
THINGS = ("season", "cars", "vegetation", "facade", "fences", "markings")


@cache
def scene(epoch: Epoch, options: StreetOptions) -> Scene:
    return build_scene(build_street(options), epoch)


CHANGED = StreetOptions(seed=5, length_m=30.0, change=0.0, switched_on=THINGS)
UNCHANGED = StreetOptions(seed=5, length_m=30.0, change=0.0)


def camera_at(s: float, yaw_deg: float = 0.0, options: StreetOptions = CHANGED) -> Rigid3:
    axis = build_street(options).axis
    heading = float(axis.heading_rad(s)[0]) + np.radians(yaw_deg)
    return Rigid3(rotation_from_yaw_pitch_roll((heading, 0.0, 0.0)), axis.beside(s, 1.7)[0] + [0.0, 0.0, 2.4])


def rays_of(pose: Rigid3, step: int = 2) -> np.ndarray:
    x, y = np.meshgrid(np.arange(0, 200, step) + 0.5, np.arange(0, 150, step) + 0.5)
    return LENS.rays(np.column_stack([x.ravel(), y.ravel()])) @ pose.rotation.T


@pytest.mark.parametrize("layout", ["straight", "loop"])
def test_the_heading_is_the_direction_of_the_axis(layout: str) -> None:
    axis = build_street(StreetOptions(length_m=260.0, layout=layout)).axis  # pyright: ignore[reportArgumentType]
    s = np.linspace(0.5, 259.0, 300)
    step = (axis.at(s + 1e-4) - axis.at(s - 1e-4)) / 2e-4
    heading = axis.heading_rad(s)
    np.testing.assert_allclose(step[:, :2], np.column_stack([np.sin(heading), np.cos(heading)]), atol=1e-3)


def test_a_loop_closes() -> None:
    axis = build_street(StreetOptions(length_m=260.0, layout="loop")).axis
    np.testing.assert_allclose(axis.at([0.0, 260.0])[0], axis.at([0.0, 260.0 - 1e-9])[1], atol=1e-6)
    turned = axis.heading_rad([260.0 - 1e-9]) - axis.heading_rad([0.0])
    np.testing.assert_allclose(turned, 2 * np.pi, atol=1e-9)


@pytest.mark.parametrize("bad", [StreetOptions(length_m=5.0), StreetOptions(change=1.5)])
def test_impossible_streets_are_refused(bad: StreetOptions) -> None:
    with pytest.raises(ConfigError, match="Expected"):
        build_street(bad)


def test_the_same_options_give_the_same_street() -> None:
    one, two = build_street(StreetOptions(seed=3)), build_street(StreetOptions(seed=3))
    assert [i.seed for i in one.items] == [i.seed for i in two.items]
    assert [i.seed for i in one.items] != [i.seed for i in build_street(StreetOptions(seed=4)).items]


def test_no_change_means_no_change() -> None:
    assert build_street(UNCHANGED).changes == ()
    pose = camera_at(8.0)
    first, second = (scene(e, UNCHANGED).cast(pose.translation, rays_of(pose), True) for e in ("first", "second"))
    np.testing.assert_array_equal(first.distance_m, second.distance_m)
    assert first.colour is not None
    np.testing.assert_array_equal(first.colour, second.colour)
    assert scene("first", UNCHANGED).light == scene("second", UNCHANGED).light


def test_the_amount_of_change_does_not_touch_the_first_epoch() -> None:
    def firsts(change: float) -> dict[int, tuple[int, int]]:
        items = build_street(StreetOptions(seed=5, change=change)).items
        return {i.number: (i.seed, i.versions[0]) for i in items if i.versions[0] is not None and i.kind != "fence"}

    assert firsts(0.0) == firsts(1.0)
    counts = [len(build_street(StreetOptions(seed=5, change=c)).changes) for c in (0.0, 0.3, 1.0)]
    assert counts == sorted(counts)
    assert {c.kind for c in build_street(StreetOptions(seed=5)).changes} == set(THINGS) - {"season"}


@pytest.mark.parametrize("yaw_deg", [0.0, 70.0, 200.0])
def test_what_differs_lies_in_a_box_of_the_changes(yaw_deg: float) -> None:
    pose = camera_at(8.0, yaw_deg)
    rays = rays_of(pose)
    first, second = (scene(e, CHANGED).cast(pose.translation, rays, True) for e in ("first", "second"))
    assert first.colour is not None
    assert second.colour is not None
    differs = (first.distance_m != second.distance_m) | (np.abs(first.colour - second.colour) > 1e-5).any(axis=1)
    nearer = np.minimum(first.distance_m, second.distance_m)[differs]
    points = pose.translation + nearer[:, None] * rays[differs]
    boxes = [(c.low_in_world - 1e-6, c.high_in_world + 1e-6) for c in build_street(CHANGED).changes]
    explained = np.any([np.all((points >= low) & (points <= high), axis=1) for low, high in boxes], axis=0)
    assert explained.all()
    assert 0.02 < differs.mean() < 0.9


@pytest.mark.parametrize("epoch", ["first", "second"])
def test_every_object_stays_in_its_box(epoch: Epoch) -> None:
    street = build_street(CHANGED)
    place = scene(epoch, CHANGED).around(street.axis.at([10.0])[0])
    owner = place.mesh.item[place.mesh.surface]
    for item in street.items:
        corners = place.mesh.corners[owner == item.number].reshape(-1, 3)
        if item.kind in ("road", "corner") or not len(corners):
            continue
        local = item.world_from_item.inverse().apply(corners)
        assert (local >= np.array(item.low) - 1e-9).all(), item.kind
        assert (local <= np.array(item.high) + 1e-9).all(), item.kind


def test_rays_find_the_road_where_it_is() -> None:
    world, rng = scene("first", CHANGED), np.random.default_rng(1)
    starts = build_street(CHANGED).axis.beside(rng.uniform(0, 30, 300), rng.uniform(-1.0, 1.0, 300), 1.2)
    hits = world.cast(starts, np.broadcast_to([0.0, 0.0, -1.0], (300, 3)))
    ground = starts[:, 2] - ground_height(starts[:, 0], starts[:, 1])
    raised = ground - hits.distance_m  # markings 4 mm, covers 8 mm
    assert (np.abs(raised[:, None] - [0.0, 0.004, 0.008]).min(axis=1) < 1e-5).all()
    assert (hits.normal[:, 2] > 0.999).all()


def test_natural_points_lie_on_surfaces_and_recur() -> None:
    one, two = scene("first", CHANGED).natural_points(), scene("second", CHANGED).natural_points()
    assert len(set(one.point_ids.tolist())) == len(one.point_ids) > 200
    both = dict(zip(two.point_ids.tolist(), two.points_in_world, strict=True))
    shared = [i for i, kept in enumerate(one.in_both_epochs) if kept]
    again = np.array([both[int(one.point_ids[i])] for i in shared])
    np.testing.assert_array_equal(one.points_in_world[shared], again)
    assert 0.3 < one.in_both_epochs.mean() < 1.0


def test_walls_hide_points_and_visible_points_are_seen() -> None:
    world, pose = scene("first", CHANGED), camera_at(8.0)
    points = world.natural_points().points_in_world
    pixels, seen = world.visible(points, pose, LENS)
    assert np.isfinite(pixels[seen]).all()
    assert 20 < seen.sum() < np.isfinite(pixels[:, 0]).sum()
    hidden = pose.translation + 25.0 * pose.rotation @ np.array([[0.9, 0.0, 0.45]]).T[:, 0]  # behind the houses
    assert not world.visible(hidden, pose, LENS)[1][0]
    before = pose.translation + 2.0 * pose.rotation @ np.array([0.0, 0.0, 1.0])
    assert world.visible(before, pose, LENS)[1][0]


@pytest.mark.parametrize("material", [materials.PLASTER, materials.ASPHALT, materials.CONCRETE])
def test_textures_do_not_repeat(material: int) -> None:
    """Patches 0.5 m wide along 60 m: none correlates with another."""
    step, patch = 0.005, 100
    u = np.arange(120 * patch) * step
    uv = np.stack(np.meshgrid(u, np.arange(24) * step, indexing="ij"), axis=-1).reshape(-1, 2)
    out = np.zeros((len(uv), 3), np.float32)
    looks = (np.array([material], np.int32), np.array([9], np.int64), np.full((1, 3), 0.4), np.zeros((1, 4)))
    across = uv + np.array([0.0, 2.0])
    paint(
        np.zeros(len(uv), np.int32), across, np.zeros((len(uv), 2)), np.full(len(uv), step), np.ones(len(uv)),
        *looks, 0.0, out,
    )  # fmt: skip
    patches = out[:, 0].reshape(120, -1)
    likeness = np.corrcoef(patches)
    assert np.abs(likeness - np.eye(120)).max() < 0.8
    assert patches.std() / patches.mean() > 0.05
