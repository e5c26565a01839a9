"""The street as an evaluation wants it: two reference epochs, and new images of many kinds of cameras.

"2023" shows the first epoch of the street, "2025" and "2025_panorama" the second; all new images are taken when the
street looks as in 2025. Both reference epochs bend with the same smooth error, as surveys do that are tied to each
other; the small errors of each image are its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from georef.geometry.angles import heading_of
from georef.geometry.camera import Camera
from georef.geometry.panorama import RIG_FROM_PANO, PanoramaHead
from georef.geometry.rigid import Rigid3
from georef.simulate.reference_errors import published
from georef.simulate.rigs import Head, LensDesign, Rig, first_rig
from georef.simulate.street import Epoch
from georef.simulate.trajectory import Measured, Trajectory, drive
from georef.simulate.world import StreetWorld, WorldImage, WorldOptions

EVALUATION_VERSION = 1  # rises when the same options give another world
FIRST_REFERENCE, SECOND_REFERENCE, PANORAMA_REFERENCE = "2023", "2025", "2025_panorama"
REFERENCES = (FIRST_REFERENCE, SECOND_REFERENCE, PANORAMA_REFERENCE)
PANORAMAS = (PANORAMA_REFERENCE, "panorama")
STITCHING_RADIUS_M = 12.0
_HEADS, _HEAD_RADIUS_M, _HEAD_HEIGHT_M, _HEAD_HALF_VIEW_DEG = 5, 0.06, 3.0, 35.0
_BROWN = (-0.06, 0.015, 2e-4, -1e-4)
_PHONE = (0.05, -0.04, 0.0, 0.0)


@dataclass(frozen=True)
class EvaluationOptions(WorldOptions):
    """As WorldOptions, and how many panoramas each of the two campaigns of panoramas has."""

    length_m: float = 60.0
    scale: float = 0.85
    max_stations: int | None = 10
    new_stations: int | None = 7
    panorama_stations: int = 6
    version: int = EVALUATION_VERSION


def evaluation_options(seed: int = 0) -> EvaluationOptions:
    """60 reference images and 6 panoramas, 14 images of a vehicle, 7 of each hand-held camera, 6 panoramas."""
    return EvaluationOptions(seed)


@dataclass(frozen=True, eq=False)
class EvaluationWorld(StreetWorld):
    """See the module."""

    @property
    def evaluation(self) -> EvaluationOptions:
        assert isinstance(self.options, EvaluationOptions)
        return self.options

    @cached_property
    def rigs(self) -> dict[str, Rig]:
        scale = self.options.scale
        mapping = first_rig("small", scale)
        carried = (0.0, 0.25, 1.6)
        phone = LensDesign("phone", 1440, 1080, 66.8, _PHONE, (0.004, -0.002)).scaled(scale)
        fisheye = LensDesign("fisheye", 1440, 1080, 150.0, (), (0.002, -0.002), fisheye=True).scaled(scale)
        rigs = (
            replace(mapping, name=FIRST_REFERENCE),
            replace(mapping, name=SECOND_REFERENCE, start_m=6.0),
            Rig(PANORAMA_REFERENCE, _panorama_heads(scale), (0.3, -0.6, 2.1), 7.0, 1.7, start_m=5.0),
            Rig("vehicle", _vehicle_heads(scale), (-0.2, -0.4, 2.05), 4.0, 0.2, start_m=5.5),
            Rig("fisheye", (Head("fisheye", fisheye, carried, (-15.0, 2.0, 0.0)),), carried, 4.5, 6.6, handheld=True),
            Rig("phone", (Head("phone", phone, carried, (-30.0, 5.0, 0.0)),), carried, 4.5, 6.9, handheld=True),
            Rig("phone_rolled", (Head("phone", phone, carried, (-26.0, 6.0, 90.0)),), carried, 4.5, 6.7, handheld=True),
            Rig("panorama", _panorama_heads(scale), (-0.2, -0.4, 2.05), 6.5, 0.2, start_m=7.5),
        )
        return {rig.name: rig for rig in rigs}

    def station_count(self, campaign: str) -> int | None:
        if campaign in PANORAMAS:
            return self.evaluation.panorama_stations
        return self.options.max_stations if campaign in REFERENCES else self.options.new_stations

    @cached_property
    def trajectories(self) -> dict[str, Trajectory]:
        out = {}
        for name, rig in self.rigs.items():
            whole, count = drive(self.street.axis, rig, self.rng("drive", name)), self.station_count(name)
            out[name] = replace(
                whole, s_m=whole.s_m[:count], time_s=whole.time_s[:count], world_from_rigs=whole.world_from_rigs[:count]
            )
        return out

    def _images_of(self, campaign: str) -> list[WorldImage]:
        scene: Epoch = "first" if campaign == FIRST_REFERENCE else "second"
        return [replace(image, epoch=scene) for image in super()._images_of(campaign)]

    @property
    def new_campaigns(self) -> tuple[str, ...]:
        return tuple(name for name in self.rigs if name not in REFERENCES)

    def pano_poses(self, campaign: str) -> dict[str, Rigid3]:
        """world_from_pano of a campaign's panoramas, by the names of their files."""
        middle = Rigid3(RIG_FROM_PANO, np.array([0.0, 0.0, _HEAD_HEIGHT_M]))
        stations = self.trajectories[campaign].world_from_rigs
        return {panorama_id(campaign, i): pose @ middle for i, pose in enumerate(stations)}

    def poses(self, campaign: str) -> dict[str, Rigid3]:
        """Exact poses of what a campaign delivers: of its images, or of its panoramas."""
        if campaign in PANORAMAS:
            return self.pano_poses(campaign)
        return {image.image_id: image.world_from_cam for image in self.images_of(campaign)}

    def published_orientation(self, campaign: str) -> dict[str, Rigid3]:
        """The exterior orientation of a reference epoch as it is published."""
        exact, rng = self.poses(campaign), self.rng("published", campaign)
        given = published(list(exact.values()), self.deformation, self.options.reference, rng)
        return dict(zip(exact, given, strict=True))

    @cached_property
    def published_poses(self) -> dict[str, Rigid3]:
        return {name: pose for epoch in REFERENCES for name, pose in self.published_orientation(epoch).items()}

    @cached_property
    def measured(self) -> dict[str, Measured]:
        raise NotImplementedError("positions are drawn for each image, see evaluation_files")


def panorama_id(campaign: str, station: int) -> str:
    return f"{campaign}_{station:04d}.jpg"


def panorama_heads(rig: Rig) -> tuple[PanoramaHead, ...]:
    """The heads that a panorama is stitched from, in its frame: all of what they see."""
    middle = np.array([0.0, 0.0, _HEAD_HEIGHT_M])
    out = []
    for head in rig.heads:
        camera, pose = rig.lenses[head.name].camera, head.rig_from_cam
        assert camera is not None
        placed = Rigid3(RIG_FROM_PANO.T @ pose.rotation, RIG_FROM_PANO.T @ (pose.translation - middle))
        out.append(PanoramaHead(head.name, camera, placed, STITCHING_RADIUS_M))
    return tuple(out)


def declared_heads(rig: Rig) -> tuple[PanoramaHead, ...]:
    """The same heads without their borders, where the panorama shows what a neighbour saw."""
    return tuple(replace(head, camera=_narrower(head.camera)) for head in panorama_heads(rig))


def _narrower(camera: Camera) -> Camera:
    half = round(camera.fx * float(np.tan(np.radians(_HEAD_HALF_VIEW_DEG))))
    return replace(camera, width=2 * half, cx=camera.cx - (camera.width / 2.0 - half))


def _vehicle_heads(scale: float) -> tuple[Head, ...]:
    front = LensDesign("vehicle_front", 1440, 1024, 76.0, _BROWN, (0.004, -0.006)).scaled(scale)
    side = LensDesign("vehicle_side", 1440, 1024, 74.0, (-0.08, 0.02, -1e-4, 2e-4), (-0.003, 0.002)).scaled(scale)
    return (
        Head("front", front, (0.1, 1.5, 2.2), (1.5, 1.0, 0.4)),
        Head("side", side, (0.05, 0.1, 2.6), (66.0, 4.0, -0.3)),
    )


def _panorama_heads(scale: float) -> tuple[Head, ...]:
    """Five upright heads, 72 degrees apart, their centres on a small circle above the roof."""
    design = LensDesign("pano", 800, 960, 80.0).scaled(scale)
    return tuple(_panorama_head(i, design) for i in range(_HEADS))


def _panorama_head(i: int, design: LensDesign) -> Head:
    yaw = 360.0 / _HEADS * i
    x, y = _HEAD_RADIUS_M * np.sin(np.radians(yaw)), _HEAD_RADIUS_M * np.cos(np.radians(yaw))
    offset = (0.002 * (i - 2), 0.0015 * ((2 * i) % 5 - 2))
    own = replace(design, name=f"head_{i}", principal_offset=offset)
    return Head(f"head_{i}", own, (float(x), float(y), _HEAD_HEIGHT_M), (yaw, 0.0, 0.3 * (i - 2)))


@dataclass(frozen=True)
class PositionSystem:
    """Independent errors of each position and heading, 1-sigma."""

    horizontal_m: float
    vertical_m: float
    heading_deg: float

    @property
    def sigmas_m(self) -> tuple[float, float, float]:
        return self.horizontal_m, self.horizontal_m, self.vertical_m


def drawn_positions(
    world: StreetWorld, poses: Sequence[Rigid3], system: PositionSystem, purpose: str
) -> tuple[list[np.ndarray], list[float]]:
    """Positions in world and headings in degrees (NaN: it looks up or down), off by what the system states."""
    rng = world.rng("positions", purpose)
    positions = [pose.translation + np.array(system.sigmas_m) * rng.normal(size=3) for pose in poses]
    exact = np.degrees([heading_of(pose.rotation) for pose in poses])
    return positions, list((exact + system.heading_deg * rng.normal(size=len(poses))) % 360.0)
