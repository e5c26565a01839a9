"""Rendered pictures: where things appear, to a fraction of a pixel; repeatable; textures filtered, light in order."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
import pytest

from georef.geometry.angles import rotation_from_yaw_pitch_roll
from georef.geometry.camera import Camera
from georef.geometry.rigid import Array, Rigid3
from georef.simulate.casting import SurfaceHits, Surroundings
from georef.simulate.lenses import Fisheye, Lens
from georef.simulate.light import Light
from georef.simulate.photography import NOISELESS, Photography, develop
from georef.simulate.render import linear_light, render
from georef.simulate.scene import Scene, build_scene
from georef.simulate.street import StreetOptions, build_street

OPTIONS = StreetOptions(seed=2, length_m=20.0)


def lens(scale: int = 1, distortion: tuple[float, ...] = ()) -> Lens:
    width, height, focal = 240 * scale, 180 * scale, 190.0 * scale
    return Lens(
        "test", width, height, Camera("test", width, height, focal, focal, 0.5 * width, 0.5 * height, distortion)
    )


@cache
def first() -> Scene:
    return build_scene(build_street(OPTIONS), "first")


def camera_at(s: float, yaw_deg: float, pitch_deg: float = 0.0, up_m: float = 2.4) -> Rigid3:
    axis = build_street(OPTIONS).axis
    heading = float(axis.heading_rad(s)[0]) + np.radians(yaw_deg)
    rotation = rotation_from_yaw_pitch_roll((heading, np.radians(pitch_deg), 0.0))
    return Rigid3(rotation, axis.beside(s, 1.7)[0] + [0.0, 0.0, up_m])


class Silhouette(Scene):
    """A scene in which one object shines and all else is black."""

    shining = -1

    def albedo(self, place: Surroundings, hits: SurfaceHits, *_: object) -> np.ndarray:  # type: ignore[override]
        owner = np.where(hits.surface >= 0, place.mesh.item[hits.surface], -1)
        return np.repeat((owner == self.shining)[:, None], 3, axis=1).astype(np.float32)


def silhouette_of(kind: str) -> tuple[Silhouette, Array]:
    """A scene with one flat marking shining, and its corners (4, 3)."""
    street = build_street(OPTIONS)
    scene = Silhouette(street, "first")
    scene.light = Light("overcast", (0.0, 0.0, 1.0), (0, 0, 0), (0, 0, 0), (1.0, 1.0, 1.0), 0.0)
    item = next(i for i in street.items if i.kind == kind and 6 < i.along_m < 14 and i.values[0] == 0 and i.versions[0])
    scene.shining = item.number
    points = scene.natural_points()
    return scene, points.points_in_world[points.point_ids // 4096 == item.number]


@pytest.mark.parametrize(
    "chosen",
    [lens(2), lens(2, (-0.2, 0.05, 2e-3, -1e-3)), Lens("f", 480, 360, None, Fisheye(300.0, 238.3, 181.9, (0.03,)))],
    ids=["pinhole", "brown", "fisheye"],
)
def test_an_object_appears_at_its_projected_pixels(chosen: Lens) -> None:
    """The centroid of a painted dash, whose edges are known: 0.05 px, where half a pixel would be ten times as much."""
    scene, corners = silhouette_of("marking")
    middle = corners.mean(axis=0)
    pose = Rigid3(rotation_from_yaw_pitch_roll((0.7, np.radians(-75), 0.2)), middle + np.array([-0.55, -0.5, 3.4]))
    picture = linear_light(scene, chosen, pose)[..., 0].astype(np.float64)
    x, y = np.meshgrid(np.arange(chosen.width) + 0.5, np.arange(chosen.height) + 0.5)
    measured = np.array([(picture * x).sum(), (picture * y).sum()]) / picture.sum()
    fine = np.concatenate([np.linspace(corners[i], corners[(i + 1) % 4], 50, endpoint=False) for i in range(4)])
    outline = chosen.project(pose.inverse().apply(fine))
    moments = cv2.moments(outline.astype(np.float32)[:, None])
    expected = np.array([moments["m10"], moments["m01"]]) / moments["m00"]
    assert np.linalg.norm(measured - expected) < 0.05
    assert picture.sum() == pytest.approx(moments["m00"], rel=0.01)
    between = (picture > 0.1) & (picture < 0.9)
    assert between.sum() > 0.02 * picture.sum()  # anti-aliased


def test_the_same_picture_again() -> None:
    pose, photography = camera_at(5.0, 40.0), Photography(seed=3)
    one = render(build_scene(build_street(OPTIONS), "first"), lens(), pose, photography)
    np.testing.assert_array_equal(one, render(first(), lens(), pose, photography))
    assert (one != render(first(), lens(), pose, Photography(seed=4))).any()
    assert one.dtype == np.uint8
    assert one.shape == (180, 240, 3)


@pytest.mark.parametrize("yaw_deg", [0.0, 75.0])
def test_a_pixel_is_the_mean_of_finer_pixels(yaw_deg: float) -> None:
    """Textures are filtered by the footprint, edges supersampled: the same as sixteen pixels averaged."""
    pose = camera_at(5.0, yaw_deg)
    plain = linear_light(first(), lens(), pose)
    fine = linear_light(first(), lens(4), pose).reshape(180, 4, 240, 4, 3).mean(axis=(1, 3))
    error = plain - fine
    assert abs(error.mean()) < 0.01 * fine.mean()
    assert np.sqrt((error**2).mean()) < 0.35 * fine.std()
    assert np.median(np.abs(error)) < 0.05 * fine.mean()


def test_the_epochs_look_different_but_not_by_little() -> None:
    pose = camera_at(5.0, 0.0)
    one = render(first(), lens(), pose, NOISELESS).astype(float)
    other = render(build_scene(build_street(OPTIONS), "second"), lens(), pose, NOISELESS).astype(float)
    assert np.abs(one - other).mean() > 12
    assert all(40 < picture.mean() < 200 for picture in (one, other))


def test_noise_exposure_and_vignetting() -> None:
    grey = np.full((200, 200, 3), 0.15, np.float32)
    plain = develop(grey, NOISELESS)
    assert plain.std() == 0
    noisy = develop(grey, Photography(vignetting=0.0)).astype(float)
    assert 0.3 < noisy.std() < 5
    assert abs(noisy.mean() - plain.mean()) < 0.5
    brighter = develop(grey, Photography(exposure=2.0, vignetting=0.0, shot_noise=0.0, read_noise=0.0))
    assert brighter.mean() > plain.mean() + 20
    warm = develop(grey, Photography(white_balance=(1.2, 1.0, 0.8), shot_noise=0.0, read_noise=0.0))
    assert warm[100, 100, 0] > warm[100, 100, 2] + 10
    assert int(warm[0, 0, 1]) < int(warm[100, 100, 1]) - 5


def test_motion_blur_keeps_the_light_and_softens() -> None:
    pose = camera_at(5.0, 60.0)
    sharp = render(first(), lens(), pose, NOISELESS).astype(float)
    moved = Photography(vignetting=0, shot_noise=0, read_noise=0, motion_blur_m=(0.0, 0.15, 0.0))
    blurred = render(first(), lens(), pose, moved).astype(float)
    assert abs(sharp.mean() - blurred.mean()) < 3
    assert np.abs(np.diff(blurred, axis=1)).mean() < 0.9 * np.abs(np.diff(sharp, axis=1)).mean()
