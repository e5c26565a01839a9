"""A whole simulated survey: a street, the drives along it, their images, and all errors, by options and a seed.

Everything is computed when it is asked for; an image is rendered alone, the same in any order and any process.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import zlib
from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from georef.crs import CrsDefinition, WorldFrame
from georef.geometry.rigid import Rigid3
from georef.simulate.lenses import Lens
from georef.simulate.reference_errors import Deformation, ReferenceQuality, published
from georef.simulate.render import Photography, render
from georef.simulate.rigs import Head, Rig, RigSize, first_rig, handheld_rigs, second_rig
from georef.simulate.scene import Scene, build_scene
from georef.simulate.street import ChangeKind, Epoch, Street, StreetOptions, build_street
from georef.simulate.trajectory import GnssImu, Measured, Motion, Trajectory, drive, measure

WORLD_VERSION = 3  # rises when the same options give another world
ORIGIN_IN_CRS = (565000.0, 5934000.0, 45.0)
CRS = CrsDefinition("EPSG:25832", "ellipsoidal")
REFERENCE = "first"  # the campaign whose exterior orientation is published


@dataclass(frozen=True)
class WorldOptions:
    """What a world is made of. scale: of the images' resolution; handheld: pedestrians walk in the second epoch."""

    seed: int = 0
    length_m: float = 60.0
    layout: Literal["straight", "loop"] = "straight"
    change: float = 1.0
    switched_on: tuple[ChangeKind, ...] = ()
    rigs: RigSize = "small"
    scale: float = 1.0
    max_stations: int | None = 12  # of each drive; None: as many as the street has room for
    new_stations: int | None = None  # of the drives of the new epoch, where these are to be fewer
    handheld: bool = False
    reference: ReferenceQuality = field(default_factory=ReferenceQuality)
    gnss: GnssImu = field(default_factory=GnssImu)

    @property
    def most_new_stations(self) -> int | None:
        return self.max_stations if self.new_stations is None else self.new_stations

    @property
    def street(self) -> StreetOptions:
        return StreetOptions(self.seed, self.length_m, self.layout, self.change, self.switched_on)

    @property
    def fingerprint(self) -> str:
        """Changes with everything that the world depends on."""
        text = json.dumps([WORLD_VERSION, dataclasses.asdict(self)], sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:16]


def small_options(seed: int = 0) -> WorldOptions:
    """Three cameras at ten stations, then two cameras at seven: 44 images of a megapixel."""
    return WorldOptions(seed, scale=0.85, max_stations=10, new_stations=7)


def large_options(seed: int = 0, length_m: float = 200.0) -> WorldOptions:
    """Full rigs at a tenth of their real pixel count, all stations, pedestrians."""
    return WorldOptions(seed, length_m, rigs="large", scale=0.33, max_stations=None, handheld=True)


@dataclass(frozen=True, eq=False)
class WorldImage:
    """One photograph of the world: its camera and its true pose."""

    image_id: str
    campaign: str
    epoch: Epoch  # of the scene that it shows
    station: int
    head: Head
    lens: Lens
    world_from_cam: Rigid3


@dataclass(frozen=True, eq=False)
class StreetWorld:
    """A street in two epochs with its surveys; see the module."""

    options: WorldOptions = field(default_factory=WorldOptions)

    @cached_property
    def frame(self) -> WorldFrame:
        """The street's east, north, up in the CRS."""
        return WorldFrame.create(CRS, ORIGIN_IN_CRS)

    @cached_property
    def street(self) -> Street:
        return build_street(self.options.street)

    @cached_property
    def scenes(self) -> dict[Epoch, Scene]:
        """Filled by `scene`."""
        return {}

    def scene(self, epoch: Epoch) -> Scene:
        if epoch not in self.scenes:
            self.scenes[epoch] = build_scene(self.street, epoch)
        return self.scenes[epoch]

    @cached_property
    def rigs(self) -> dict[str, Rig]:
        """Campaign -> the rig that drives or walks it."""
        options = self.options
        vehicles = {
            REFERENCE: first_rig(options.rigs, options.scale),
            "second": second_rig(options.rigs, options.scale),
        }
        return vehicles | ({rig.name: rig for rig in handheld_rigs(options.scale)} if options.handheld else {})

    @cached_property
    def trajectories(self) -> dict[str, Trajectory]:
        out = {}
        for name, rig in self.rigs.items():
            whole = drive(self.street.axis, rig, self.rng("drive", name))
            count = self.options.max_stations if name == REFERENCE else self.options.most_new_stations
            out[name] = dataclasses.replace(
                whole, s_m=whole.s_m[:count], time_s=whole.time_s[:count], world_from_rigs=whole.world_from_rigs[:count]
            )
        return out

    def motion(self, campaign: str) -> Motion:
        """The way behind a campaign's trajectory, between its triggers too."""
        return Motion.draw(self.street.axis, self.rigs[campaign], self.rng("drive", campaign))

    @cached_property
    def images(self) -> dict[str, WorldImage]:
        """All images, by id, in the order of campaigns and stations."""
        images = [image for name in self.rigs for image in self._images_of(name)]
        return {image.image_id: image for image in images}

    def _images_of(self, campaign: str) -> list[WorldImage]:
        rig = self.rigs[campaign]
        epoch: Epoch = "first" if campaign == REFERENCE else "second"
        return [
            WorldImage(
                f"{campaign}_{station:04d}_{head.name}.jpg",
                campaign,
                epoch,
                station,
                head,
                rig.lenses[head.name],
                world_from_rig @ head.rig_from_cam,
            )
            for station, world_from_rig in enumerate(self.trajectories[campaign].world_from_rigs)
            for head in rig.heads
        ]

    def images_of(self, campaign: str) -> list[WorldImage]:
        return [image for image in self.images.values() if image.campaign == campaign]

    @cached_property
    def deformation(self) -> Deformation:
        """The smooth error of the reference."""
        return Deformation.draw(self.street.axis, self.options.reference, self.rng("deformation"))

    @cached_property
    def published_poses(self) -> dict[str, Rigid3]:
        """The exterior orientation of the reference images as it is published."""
        images = self.images_of(REFERENCE)
        poses = [image.world_from_cam for image in images]
        given = published(poses, self.deformation, self.options.reference, self.rng("published"))
        return {image.image_id: pose for image, pose in zip(images, given, strict=True)}

    @cached_property
    def measured(self) -> dict[str, Measured]:
        """Campaign -> what its GNSS and IMU say; outages are under trees."""
        trees = np.array([item.along_m for item in self.street.items if item.kind == "tree"])
        return {
            name: measure(trajectory, self.options.gnss, self.rng("gnss", name), trees)
            for name, trajectory in self.trajectories.items()
        }

    def render_image(self, image_id: str) -> NDArray[np.uint8]:
        """The photograph (H, W, 3), RGB."""
        image = self.images[image_id]
        return render(self.scene(image.epoch), image.lens, image.world_from_cam, self.photography(image))

    def photography(self, image: WorldImage) -> Photography:
        """Exposure and white balance vary by epoch and drift along the drive; noise is the image's own."""
        own, drift = self.rng("photo", image.image_id), self.rng("photo", image.campaign)
        phase = drift.uniform(0.0, 2.0 * np.pi, 2)
        slow = np.sin(image.station / 5.0 + phase)
        exposure = float(np.exp(0.10 * slow[0] + 0.05 * own.normal()))
        warm = 0.02 * float(slow[1]) + (0.03 if image.epoch == "first" else -0.03)
        return Photography(
            exposure=exposure, white_balance=(1.0 + warm, 1.0, 1.0 - warm), seed=int(own.integers(2**31))
        )

    def rng(self, *purpose: str) -> np.random.Generator:
        """Independent random numbers for a purpose, the same on every call."""
        return np.random.default_rng([self.options.seed, zlib.crc32(" ".join(purpose).encode())])
