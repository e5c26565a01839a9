"""Rigs as projects declare them: the table, the stations of images, and what is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from georef.errors import ConfigError, InputError
from georef.geometry.angles import rotation_from_yaw_pitch_roll
from georef.geometry.camera import Camera
from georef.geometry.panorama import RIG_FROM_PANO
from georef.io.rig_table import read_rig
from georef.project import EpochSection
from georef.stages.mountings import with_rig
from georef.types.campaign import Campaign, Image

HEADER = "camera,x,y,z,yaw,pitch,roll,sigma_m,sigma_deg"
LEFT, RIGHT = "left,-0.3,-2.0,1.5,-60,2,1,0.001,0.01", "right,0.3,-2.0,1.5,60,2,1,0.002,0.02"


def table(folder: Path, *rows: str) -> Path:
    path = folder / "rig.csv"
    path.write_text("\n".join([HEADER, *rows]) + "\n", encoding="utf-8")
    return path


def image(name: str, camera: str, station: str | None) -> Image:
    return Image(name, Path(name), Camera(camera, 100, 80, 90.0, 90.0, 50.0, 40.0), "new", station=station)


def test_a_mounting_is_where_the_table_says(tmp_path: Path) -> None:
    rig = read_rig(table(tmp_path, LEFT, RIGHT))
    right = rig["right"].rig_from_cam
    assert np.allclose(right.translation, [0.3, -2.0, 1.5])
    ahead = right.rotation @ [0.0, 0.0, 1.0]  # x right, y down, z forward
    tilt = np.radians(2.0)
    assert np.allclose(ahead, [np.cos(tilt) * np.sin(np.pi / 3), -np.sin(tilt), np.cos(tilt) * np.cos(np.pi / 3)])
    assert np.allclose(right.rotation, RIG_FROM_PANO.T @ rotation_from_yaw_pitch_roll(np.radians([60.0, 2.0, 1.0])))
    cov = rig["right"].cov
    assert cov is not None
    assert np.allclose(np.sqrt(np.diag(cov)), [np.radians(0.02)] * 3 + [0.002] * 3)


def test_one_camera_may_define_the_rig(tmp_path: Path) -> None:
    rig = read_rig(table(tmp_path, "left,0,0,0,0,0,0,0,0", RIGHT))
    assert rig["left"].cov is None
    with pytest.raises(InputError, match="'left' and 'right' both have sigmas of 0"):
        read_rig(table(tmp_path, "left,0,0,0,0,0,0,0,0", "right,0.3,-2.0,1.5,60,2,1,0,0"))


@pytest.mark.parametrize("row", ["left,0,0,0,0,0,0,-0.001,0.01", "left,0,0,0,0,0,0,0.001,0"])
def test_sigmas_are_positive(tmp_path: Path, row: str) -> None:
    with pytest.raises(InputError, match="Camera 'left' has sigma_"):
        read_rig(table(tmp_path, row, RIGHT))


def test_images_of_a_station_have_the_mountings_of_their_cameras(tmp_path: Path) -> None:
    path = table(tmp_path, LEFT, RIGHT)
    campaign = Campaign("new", (image("a", "left", "1"), image("b", "right", "1"), image("c", "left", None)))
    rig = read_rig(path)
    assert with_rig(campaign, rig, path, path).mountings == {"a": rig["left"], "b": rig["right"]}


@pytest.mark.parametrize(
    ("images", "problem"),
    [
        ((image("a", "left", None),), "no image has a station"),
        ((image("a", "top", "1"),), "its camera 'top' is not mounted"),
        ((image("a", "left", "1"), image("b", "left", "1")), "Station '1' has 2 images of camera 'left'"),
    ],
)
def test_stations_that_cannot_be(tmp_path: Path, images: tuple[Image, ...], problem: str) -> None:
    path = table(tmp_path, LEFT, RIGHT)
    with pytest.raises(InputError, match=problem):
        with_rig(Campaign("new", images), read_rig(path), path, path)


def test_a_rig_needs_the_table_that_names_stations() -> None:
    with pytest.raises(ValueError, match="column `station`"):
        EpochSection.model_validate({"images": "new", "cameras": "cameras.csv", "rig": "rig.csv"})
    with pytest.raises((ValueError, ConfigError), match="a rig by themselves"):
        EpochSection.model_validate(
            {"images": "new", "gnss": "g.csv", "panorama": {"projection": "cube-map"}, "rig": "rig.csv"}
        )
