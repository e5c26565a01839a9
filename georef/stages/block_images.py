"""The images of a block: which camera took each, which were exposed together, and where and how they start."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np

from georef.crs import WorldFrame
from georef.errors import InputError
from georef.estimation.adjustment.block import Antenna, Block, Calibration, PositionPriors, RigCamera
from georef.estimation.vertical_start import vertical_start
from georef.geometry.camera import Camera
from georef.geometry.poses import Poses
from georef.geometry.rigid import Array, Rigid3
from georef.io.bingo import BingoTable
from georef.io.gnss import GnssTable
from georef.io.rig_table import read_rig
from georef.io.table import IntArray
from georef.project import BlockSection, Project
from georef.stages.block_tables import BlockTables, rows_of
from georef.stages.cameras import CameraTable, Stated
from georef.stages.reference import world_poses
from georef.types.campaign import Mounting
from georef.types.scene import Observations

logger = logging.getLogger(__name__)
_LARGEST_MISFIT = 0.1  # of half the image: the mark of a tilt of about six degrees, or of steep ground
_SAME_PLACE_M = 0.01


@dataclass(frozen=True, eq=False)
class BlockImages:
    """M images in the order of their measurements, S exposures."""

    path: str  # of the measurements, for messages
    image_ids: tuple[str, ...]  # M
    cameras: tuple[Camera, ...]  # M
    station_ids: tuple[str, ...]  # S
    station: IntArray  # (M,)
    mountings: tuple[RigCamera, ...]
    mounting: IntArray  # (M,)
    positions: Array  # (M, 3) in world: of the antenna, or of the camera where no GNSS is given
    attitude: Poses | None  # M, to start from; None: they look down
    priors: PositionPriors
    antennas: tuple[Antenna, ...]
    drift_information: Array  # (D, 3, 3)
    camera_sigma: Mapping[str, float]

    def started(self, observations: Observations) -> Block:
        """The block without points: approximate poses from the tables, or from observations of points by images."""
        world_from_cam = self.attitude if self.attitude is not None else self._looking_down(observations)
        world_from_rig = self._stations(world_from_cam)
        calibrations = {camera: i for i, camera in enumerate(dict.fromkeys(self.cameras))}
        none = np.zeros(0, np.int64)
        return Block(
            station_ids=self.station_ids,
            image_ids=self.image_ids,
            station=self.station,
            mounting=self.mounting,
            calibration=np.array([calibrations[camera] for camera in self.cameras]),
            mountings=self.mountings,
            calibrations=tuple(_calibration(camera, self.camera_sigma) for camera in calibrations),
            world_from_rig=world_from_rig,
            points=np.zeros((0, 3)),
            observations=Observations(none, none, np.zeros((0, 2)), np.zeros(0), none),
            position_priors=self.priors,
            antennas=self.antennas,
            drift_information=self.drift_information,
        )

    def _looking_down(self, observations: Observations) -> Poses:
        start = vertical_start(self.positions, self.cameras, observations)
        unknown = np.flatnonzero(~np.isfinite(start.misfit))
        tilted = np.flatnonzero(start.misfit > _LARGEST_MISFIT)
        if len(unknown) or len(tilted) > 0.1 * len(self.image_ids):
            worst = int(unknown[0]) if len(unknown) else int(np.nanargmax(start.misfit))
            what = "shares too few points with others" if len(unknown) else "does not look straight down"
            raise InputError(
                f"Image '{self.image_ids[worst]}' {what}, as {max(len(unknown), len(tilted))} of "
                f"{len(self.image_ids)} do: it cannot be oriented from its position and its points.",
                expected='images that look down within a few degrees, over flat ground, for attitude = "vertical".',
                remedy="Name a table of rotations: attitude = { file = ..., angles = ..., angle_unit = ... }.",
                path=self.path,
            )
        return start.world_from_cam

    def _stations(self, world_from_cam: Poses) -> Poses:
        """world_from_rig of each exposure, from its first image whose camera is held, else from its first."""
        held = np.array([m.information is None for m in self.mountings])[self.mounting]
        out: list[Rigid3] = []
        for index in range(len(self.station_ids)):
            own = np.flatnonzero(self.station == index)
            image = int(own[np.argmax(held[own])])
            pose = world_from_cam[image] @ self.mountings[self.mounting[image]].rig_from_cam.inverse()
            if len(self.antennas):  # the position is that of the antenna
                pose = Rigid3(pose.rotation, self.positions[image] - pose.rotation @ self.antennas[0].lever_arm_m)
            out.append(pose)
        return Poses.of(out)


def images_of_block(
    project: Project, section: BlockSection, tables: BlockTables, measured: BingoTable, world: WorldFrame
) -> BlockImages:
    """The images of the measurements with what the tables say of them. Raises InputError."""
    ids = measured.image_ids
    cameras = _cameras(project, section, tables, measured)
    rows = None if tables.gnss is None else rows_of(tables.gnss, ids, measured)
    positions, attitude = _given(tables, rows, ids, measured, world)
    rig = None if section.rig is None else read_rig(project.data(section.rig))
    station_ids, station = _stations(tables.gnss, rows, ids, together=rig is not None)
    mountings, mounting = _mountings(rig, cameras, ids, str(section.rig))
    antennas, drift = _antennas(section)
    return BlockImages(
        *(str(measured.path), ids, cameras, station_ids, station, mountings, mounting, positions, attitude),
        priors=_priors(tables.gnss, rows, station, world, drift=len(drift) > 0),
        antennas=antennas,
        drift_information=drift,
        camera_sigma=section.camera_sigma,
    )


def _cameras(project: Project, section: BlockSection, tables: BlockTables, measured: BingoTable) -> tuple[Camera, ...]:
    """The camera of each image: as a table or a header of the measurements names it, or the only one."""
    table = CameraTable.read(project.data(section.cameras))
    names = dict(zip(measured.image_ids, measured.cameras, strict=True))
    stated = {image: name for image, name in names.items() if name in table.cameras}
    for source in (tables.attitude, tables.gnss):
        if source is None:
            continue
        rows = rows_of(source, measured.image_ids, measured)
        stated |= {
            image: source.cameras[row]
            for image, row in zip(measured.image_ids, rows, strict=True)
            if source.cameras[row] in table.cameras
        }
    lines = dict(zip(measured.image_ids, measured.image_rows.tolist(), strict=True))
    known = Stated(measured.path, stated, lines)
    return tuple(table.camera_of(image, known) for image in measured.image_ids)


def _given(
    tables: BlockTables, rows: IntArray | None, ids: Sequence[str], measured: BingoTable, world: WorldFrame
) -> tuple[Array, Poses | None]:
    """Positions (M, 3) in world, of the antenna where there is GNSS, and the poses to start from."""
    attitude = None
    if tables.attitude is not None:
        own = rows_of(tables.attitude, ids, measured)
        given = tables.attitude
        attitude = Poses.of(world_poses(world, given.positions_in_crs[own], given.axes_from_cam[own]))
    if tables.gnss is not None and rows is not None:
        return world.world_from_crs(tables.gnss.positions_in_crs[rows]), attitude
    assert attitude is not None, "a block has positions or orientations"
    return attitude.translation, attitude


def _stations(
    gnss: GnssTable | None, rows: IntArray | None, ids: Sequence[str], *, together: bool
) -> tuple[tuple[str, ...], IntArray]:
    """Ids of the exposures, and that of each image."""
    names = list(ids)
    if together and gnss is not None and rows is not None:
        names = [gnss.stations[row] or name for row, name in zip(rows, ids, strict=True)]
    index: dict[str, int] = {}
    station = np.array([index.setdefault(name, len(index)) for name in names], dtype=np.int64)
    return tuple(index), station


def _mountings(
    rig: Mapping[str, Mounting] | None, cameras: Sequence[Camera], ids: Sequence[str], path: str
) -> tuple[tuple[RigCamera, ...], IntArray]:
    """How the cameras are mounted; a camera that is not on a rig is one by itself."""
    if rig is None:
        return (RigCamera("camera", Rigid3.identity()),), np.zeros(len(ids), np.int64)
    index = {name: i for i, name in enumerate(rig)}
    for name, camera in zip(ids, cameras, strict=True):
        if camera.camera_id not in index:
            raise InputError(
                f"The camera '{camera.camera_id}' of image '{name}' is not mounted.",
                expected=f"one of {', '.join(list(rig)[:5])}.",
                remedy="Add the camera to the table of the rig.",
                path=path,
            )
    mountings = tuple(
        RigCamera(name, m.rig_from_cam, None if m.cov is None else cast(Array, np.linalg.inv(m.cov)))
        for name, m in rig.items()
    )
    return mountings, np.array([index[camera.camera_id] for camera in cameras], dtype=np.int64)


def _antennas(section: BlockSection) -> tuple[tuple[Antenna, ...], Array]:
    """The antenna, and the information (D, 3, 3) of the offset that all positions share."""
    gnss = section.gnss
    if gnss is None:
        return (), np.zeros((0, 3, 3))
    sigma = gnss.lever_arm_sigma_m
    weights = None if sigma is None else np.square(1.0 / np.array(sigma))
    antenna = Antenna("antenna", np.array(gnss.lever_arm_m), None if weights is None else np.diag(weights))
    offset = gnss.offset_sigma_m
    drift = np.zeros((0, 3, 3)) if offset is None else np.diag(np.square(1.0 / np.array(offset)))[None]
    return (antenna,), drift


def _priors(
    gnss: GnssTable | None, rows: IntArray | None, station: IntArray, world: WorldFrame, *, drift: bool
) -> PositionPriors:
    """One position an exposure: that of its first image. Raises InputError where images of one disagree."""
    if gnss is None or rows is None:
        return PositionPriors.none()
    _, first = np.unique(station, return_index=True)
    own = rows[first]
    positions = world.world_from_crs(gnss.positions_in_crs[own])
    apart = np.linalg.norm(world.world_from_crs(gnss.positions_in_crs[rows]) - positions[station], axis=1)
    if (apart > _SAME_PLACE_M).any():
        image = int(np.argmax(apart))
        raise InputError(
            f"Image '{gnss.image_ids[rows[image]]}' has a position {apart[image]:.3f} m from that of its exposure.",
            expected="one position of the antenna for all images of an exposure.",
            remedy="Correct the positions, or the column `station`.",
            path=gnss.path,
            row=int(gnss.rows[rows[image]]),
        )
    covs = np.zeros((len(own), 3, 3))
    covs[:, range(3), range(3)] = np.square(gnss.sigmas_m[own])
    node = np.full((len(own), 2), -1, np.int64)
    weight = np.zeros((len(own), 2))
    if drift:
        node[:, 0], weight[:, 0] = 0, 1.0
    return PositionPriors(
        station=np.arange(len(own)),
        position=positions,
        cov=world.world_cov_from_crs(gnss.positions_in_crs[own], covs),
        antenna=np.zeros(len(own), np.int64),
        drift_node=node,
        drift_weight=weight,
    )


def _calibration(camera: Camera, sigmas: Mapping[str, float]) -> Calibration:
    """What the table of cameras leaves unknown, about its values where a sigma is stated."""
    steps = [sigmas[name] / camera.unit(name) if name in sigmas else np.inf for name in camera.estimate]
    return Calibration(camera, np.diag(np.square(1.0 / np.array(steps, dtype=np.float64))))
