"""The images of a block: which camera took each, and the block without points that they make."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from georef.crs import WorldFrame
from georef.errors import InputError
from georef.estimation.adjustment.block import Antenna, Block, Calibration, PositionPriors, RigCamera
from georef.estimation.vertical_start import vertical_start
from georef.geometry.camera import Camera
from georef.geometry.poses import Poses
from georef.geometry.rigid import Array
from georef.io.bingo import BingoTable
from georef.io.table import IntArray
from georef.project import BlockSection, Project
from georef.stages.block_positions import antennas_of, position_priors
from georef.stages.block_rig import mountings_of, orientation_rows, posed_stations, stations_of
from georef.stages.block_tables import BlockTables, by_pattern, require_rows, rows_of
from georef.stages.cameras import CameraTable, Stated
from georef.stages.reference import world_poses
from georef.types.scene import Observations

_LARGEST_MISFIT = 0.1  # of half the image: the mark of a tilt of about six degrees, or of steep ground


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
    oriented: NDArray[np.bool_]  # (M,) which have a pose to start from, or are to get one as looking down
    poses: Poses | None  # M, to start from; None: they look down
    positions: Array  # (M, 3) in world: of the antenna, or of the camera where no GNSS is given
    priors: PositionPriors
    antennas: tuple[Antenna, ...]
    antenna: IntArray  # (M,)
    drift_information: Array  # (D, 3, 3)
    camera_sigma: Mapping[str, float]

    def started(self, observations: Observations) -> Block:
        """The block without points: approximate poses from the tables, or from observations of points by images."""
        world_from_cam = self.poses if self.poses is not None else self._looking_down(observations)
        world_from_rig = posed_stations(world_from_cam, self.oriented, self.station, self.mountings, self.mounting)
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
            world_from_rig=self._at_antennas(world_from_rig),
            points=np.zeros((0, 3)),
            observations=Observations(none, none, np.zeros((0, 2)), np.zeros(0), none),
            position_priors=self.priors,
            antennas=self.antennas,
            drift_information=self.drift_information,
        )

    def _at_antennas(self, world_from_rig: Poses) -> Poses:
        """Exposures that GNSS tells the place of, moved there."""
        if not len(self.priors):
            return world_from_rig
        place = world_from_rig.translation.copy()
        lever = np.array([self.antennas[a].lever_arm_m for a in self.priors.antenna])
        turned = np.einsum("kij,kj->ki", world_from_rig.rotation[self.priors.station], lever)
        place[self.priors.station] = self.priors.position - turned
        return Poses(world_from_rig.rotation, place)

    def _looking_down(self, observations: Observations) -> Poses:
        """Poses (M) of the oriented images, seen as maps; the others' are meaningless."""
        images = np.flatnonzero(self.oriented)
        number = np.cumsum(self.oriented) - 1
        here = observations.take(self.oriented[observations.view])
        own = Observations(here.point, number[here.view], here.pixel, here.sigma_px, here.keypoint)
        start = vertical_start(self.positions[images], [self.cameras[i] for i in images], own)
        unknown = np.flatnonzero(~np.isfinite(start.misfit))
        tilted = np.flatnonzero(start.misfit > _LARGEST_MISFIT)
        if len(unknown) or len(tilted) > 0.1 * len(images):
            worst = int(images[unknown[0]] if len(unknown) else images[np.nanargmax(start.misfit)])
            what = "shares too few points with others" if len(unknown) else "does not look straight down"
            raise InputError(
                f"Image '{self.image_ids[worst]}' {what}, as {max(len(unknown), len(tilted))} of {len(images)} do: it "
                "cannot be oriented from its position and its points.",
                expected='images that look down within a few degrees, over flat ground, for attitude = "vertical".',
                remedy="Name a table of rotations: attitude = { file = ..., angles = ..., angle_unit = ... }.",
                path=self.path,
            )
        return start.world_from_cam.take(np.where(self.oriented, number, 0))


def images_of_block(
    project: Project, section: BlockSection, tables: BlockTables, measured: BingoTable, world: WorldFrame
) -> BlockImages:
    """The images of the measurements with what the tables say of them. Raises InputError."""
    ids, rig = measured.image_ids, section.mounted
    cameras = _cameras(project, section, tables, measured)
    names = stations_of(rig, tables, ids)
    index = {name: i for i, name in enumerate(dict.fromkeys(names))}
    station = np.array([index[name] for name in names], dtype=np.int64)
    gnss_rows = np.full(len(ids), -1) if tables.gnss is None else rows_of(tables.gnss, ids, names)
    poses, oriented, positions = _starts(tables, section, ids, gnss_rows, station, cameras, world)
    mountings, mounting = mountings_of(project, rig, cameras, ids, station, poses, oriented)
    if poses is None:  # of a rig, the camera that is held looks down
        held = np.array([m.information is None for m in mountings])[mounting]
        oriented = oriented & (held if rig is not None and held.any() else True)
    _require_starts(tables, oriented, station, ids, measured)
    antennas, antenna = antennas_of(section.gnss, cameras, rig=rig is not None)
    priors, drift = position_priors(section.gnss, tables, gnss_rows, ids, station, antenna, world)
    return BlockImages(
        *(str(measured.path), ids, cameras, tuple(index), station, mountings, mounting),
        *(oriented, poses, positions, priors, antennas, antenna, drift),
        camera_sigma=section.camera_sigma,
    )


def _cameras(project: Project, section: BlockSection, tables: BlockTables, measured: BingoTable) -> tuple[Camera, ...]:
    """The camera of each image: as the pattern of names, a table or a header of the measurements names it, or the only
    one."""
    table = CameraTable.read(project.data(section.cameras))
    ids = measured.image_ids
    stated = {image: name for image, name in zip(ids, measured.cameras, strict=True) if name in table.cameras}
    for source in (tables.attitude, tables.gnss):
        if source is None:
            continue
        rows = rows_of(source, ids)
        known = {image: source.cameras[row] for image, row in zip(ids, rows, strict=True) if row >= 0}
        stated |= {image: name for image, name in known.items() if name in table.cameras}
    if section.camera_pattern is not None:
        stated |= dict(zip(ids, by_pattern(section.camera_pattern, ids, "camera"), strict=True))
    lines = dict(zip(ids, measured.image_rows.tolist(), strict=True))
    return tuple(table.camera_of(image, Stated(measured.path, stated, lines)) for image in ids)


def _starts(
    tables: BlockTables,
    section: BlockSection,
    ids: Sequence[str],
    gnss_rows: IntArray,
    station: IntArray,
    cameras: Sequence[Camera],
    world: WorldFrame,
) -> tuple[Poses | None, NDArray[np.bool_], Array]:
    """Poses (M) of a table of attitudes and which images have one (M,); positions (M, 3), of the antenna where there is
    GNSS. Without a table: no poses, and which images have a position."""
    positions = np.full((len(ids), 3), np.nan)
    if tables.gnss is not None:
        there = gnss_rows >= 0
        positions[there] = world.world_from_crs(tables.gnss.positions_in_crs[gnss_rows[there]])
        for image in np.flatnonzero(~there):
            known = np.flatnonzero(there & (station == station[image]))
            positions[image] = positions[known[0]] if len(known) else np.nan
    if tables.attitude is None:
        return None, np.isfinite(positions[:, 0]), positions
    rows = orientation_rows(tables.attitude, ids)
    there, given = rows >= 0, tables.attitude
    used = np.where(there, rows, 0)
    poses = Poses.of(world_poses(world, given.positions_in_crs[used], given.axes_from_cam[used]))
    return poses, there, np.where(np.isfinite(positions), positions, poses.translation)


def _require_starts(
    tables: BlockTables, oriented: NDArray[np.bool_], station: IntArray, ids: Sequence[str], measured: BingoTable
) -> None:
    """Every exposure has an image to start from. Raises InputError."""
    source = tables.attitude or tables.gnss
    assert source is not None, "validated: a block has positions or attitudes"
    has = np.zeros(int(station.max()) + 1, bool)
    has[station[oriented]] = True
    require_rows(has[station], source.path, ids, measured)


def _calibration(camera: Camera, sigmas: Mapping[str, float]) -> Calibration:
    """What the table of cameras leaves unknown, about its values where a sigma is stated."""
    steps = [sigmas[name] / camera.unit(name) if name in sigmas else np.inf for name in camera.estimate]
    return Calibration(camera, np.diag(np.square(1.0 / np.array(steps, dtype=np.float64))))
