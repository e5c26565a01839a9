"""What a project declares beside the images of an epoch, read and added to its block. Errors name file, row, remedy."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import cast

import numpy as np

from georef.crs import crs_kind
from georef.epoch_sections import GnssOffsetSection, TrajectorySection
from georef.errors import InputError
from georef.estimation.adjustment.block import Antenna, Block
from georef.estimation.adjustment.epoch_constraints import (
    GnssOffset,
    with_antenna,
    with_gnss_offset,
    with_held_mountings,
    with_motions,
)
from georef.geometry.rigid import Array, Rigid3
from georef.io.columns import CrsKind
from georef.io.exterior_orientation import read_exterior_orientation
from georef.io.motions import MotionTable, read_motions
from georef.project import EpochSection, Project
from georef.stages.base import StageContext
from georef.stages.epoch_distances import read_declared_distances, with_measured_distances
from georef.stages.epoch_lenses import calibrated, declared_sigmas
from georef.stages.reference import world_poses
from georef.stages.survey import Survey, check_frame
from georef.types.campaign import Campaign

ANTENNA = "antenna"


def with_declared(context: StageContext, block: Block) -> Block:
    """The block with antenna, GNSS offset, motions, calibrations, mountings and distances as the project declares them.

    Raises InputError or ConfigError.
    """
    section = context.project.file.epochs[context.epoch]
    block = calibrated(context.project, context.survey, block)
    if section.mountings == "held":
        block = with_held_mountings(block)
    if section.antenna is not None and len(block.position_priors):
        information = _information(section.antenna.sigma_m)
        block = with_antenna(block, Antenna(ANTENNA, np.array(section.antenna.lever_arm_m), information))
    if section.gnss_offset is not None and len(block.position_priors):
        block = with_gnss_offset(block, _offset(context, block, section.gnss_offset))
    if section.motions is not None:
        block = _with_motions(context.project.data(section.motions), block, context.survey.epoch)
    if section.trajectory is not None:
        block = _with_trajectory(context, block, section.trajectory)
    return with_measured_distances(context.project, context.survey, block)


def check_declared(project: Project, survey: Survey) -> None:
    """Reads all that is declared, so that what is wrong with it is found before any work. Raises as `with_declared`."""
    section = project.file.epochs[survey.epoch.epoch]
    declared_sigmas(project, survey)
    read_declared_distances(project, survey)
    if section.motions is not None:
        _read_motions(project.data(section.motions), survey.epoch)
    if section.trajectory is not None:
        _read_trajectory(project, survey, section.trajectory)
    images = [image.image_id for image in survey.epoch.images]
    if section.gnss_offset is not None and section.gnss_offset.every_s is not None:
        _refuse_without_time(project, survey, images, "gnss_offset.every_s")
    if section.trajectory is not None and section.trajectory.by_time:
        _refuse_without_time(project, survey, images, "trajectory")


def lever_arms(context: StageContext, image_ids: Sequence[str]) -> list[Array]:
    """The antenna in the frame of each image's camera, as declared; the camera itself where nothing is."""
    section, mountings = context.project.file.epochs[context.epoch], context.survey.epoch.mountings
    if section.antenna is None:
        return [np.zeros(3) for _ in image_ids]
    arm = np.array(section.antenna.lever_arm_m)
    return [mountings[name].rig_from_cam.inverse().apply(arm) if name in mountings else arm for name in image_ids]


def offset_sigma_m(section: EpochSection) -> float:
    """How large an offset of GNSS the project declares possible, 1-sigma of the largest coordinate."""
    if section.gnss_offset is None:
        return 0.0
    sigma = section.gnss_offset.sigma_m
    return max(sigma) if isinstance(sigma, tuple) else 1e6


def _information(sigma_m: Sequence[float] | str | None) -> Array | None:
    """None: held; zeros: free."""
    if sigma_m is None:
        return None
    return np.zeros((3, 3)) if isinstance(sigma_m, str) else np.diag(1.0 / np.square(np.array(sigma_m)))


# --- GNSS -----------------------------------------------------------------------------------------


def _offset(context: StageContext, block: Block, section: GnssOffsetSection) -> GnssOffset:
    information = _information(section.sigma_m)
    assert information is not None, "an offset is never held"
    at = np.arange(len(block.station_ids), dtype=np.float64)
    if section.every_s is not None:
        at = _times(context, block, "gnss_offset.every_s")
    step = section.every_s or section.every_stations
    if step is None:
        return GnssOffset(information, np.zeros(1), at)
    first, last = float(at.min()), float(at.max())
    count = max(1, int(np.ceil((last - first) / step)))
    return GnssOffset(information, np.array([first + step * k for k in range(count + 1)]), at)


def _times(context: StageContext, block: Block, key: str) -> Array:
    """Time (S,) of each station: of its first image."""
    _refuse_without_time(context.project, context.survey, block.image_ids, key)
    given = [context.survey.epoch.times_s[name] for name in block.image_ids]
    first = np.unique(block.station, return_index=True)[1]
    return np.array(given, dtype=np.float64)[first]


def _refuse_without_time(project: Project, survey: Survey, image_ids: Sequence[str], key: str) -> None:
    missing = next((name for name in image_ids if name not in survey.epoch.times_s), None)
    if missing is None:
        return
    section = project.file.epochs[survey.epoch.epoch]
    raise InputError(
        f"Image '{missing}' has no time of exposure, and {key} goes by time.",
        expected="seconds in a column `time_s` of the table of positions, for every image.",
        remedy="Add them, or count by stations (gnss_offset.every_stations) and by metres (trajectory).",
        path=None if section.gnss is None else project.data(section.gnss),
    )


# --- motions --------------------------------------------------------------------------------------


def _with_motions(path: Path, block: Block, epoch: Campaign) -> Block:
    """Motions whose two stations take part."""
    table = _read_motions(path, epoch)
    station = dict(zip(block.image_ids, block.station.tolist(), strict=True))
    for name, place in list(station.items()):
        exposure = epoch[name].station
        if exposure is not None:
            station.setdefault(exposure, place)
    used = [k for k in range(len(table.a)) if table.a[k] in station and table.b[k] in station]
    a, b = (np.array([station[end[k]] for k in used], dtype=np.int64) for end in (table.a, table.b))
    return with_motions(block, a, b, [table.a_from_b[k] for k in used], table.cov[used].reshape(-1, 6, 6))


def _read_motions(path: Path, epoch: Campaign) -> MotionTable:
    """The table of motions; a name that is none of the epoch is refused."""
    table = read_motions(path)
    known = {name for image in epoch.images for name in (image.image_id, image.station)}
    for k, name in [(row, end[row]) for row in range(len(table.a)) for end in (table.a, table.b)]:
        if name not in known:
            raise InputError(
                f"The motion from '{table.a[k]}' to '{table.b[k]}' names '{name}', which is no station and no image.",
                expected="values of the column `station` of the table of positions, or names of images.",
                remedy="Correct the name, or delete the row.",
                path=table.path,
                row=int(table.rows[k]),
            )
    return table


def _with_trajectory(context: StageContext, block: Block, section: TrajectorySection) -> Block:
    """Motions between stations that follow each other in a trajectory, where it has no gap."""
    poses = _read_trajectory(context.project, context.survey, section)
    place = {name: i for i, name in enumerate(block.image_ids)}
    order: dict[int, Rigid3] = {}  # stations in the order of the file, by the first image of each
    for name, pose in poses.items():
        if name in place:
            mounting = block.mountings[block.mounting[place[name]]]
            order.setdefault(int(block.station[place[name]]), pose @ mounting.rig_from_cam.inverse())
    times = _times(context, block, "trajectory") if section.by_time else np.zeros(len(block.station_ids))
    pairs = [
        (a, b, order[a].inverse() @ order[b])
        for a, b in pairwise(order)
        if float(np.linalg.norm(order[b].translation - order[a].translation)) <= section.max_gap_m
    ]
    covs = [_motion_cov(section, motion, abs(float(times[b] - times[a]))) for a, b, motion in pairs]
    ends = np.array([[a, b] for a, b, _ in pairs], dtype=np.int64).reshape(-1, 2)
    return with_motions(block, ends[:, 0], ends[:, 1], [m for *_, m in pairs], np.array(covs).reshape(-1, 6, 6))


def _read_trajectory(project: Project, survey: Survey, section: TrajectorySection) -> dict[str, Rigid3]:
    """world_from_cam of the images of a trajectory, in its order. Raises InputError or CrsError."""
    path, world = project.data(section.file), survey.world
    kind = cast(CrsKind, crs_kind(world.definition))
    table = read_exterior_orientation(path, crs_kind=kind, angles=section.angles, angle_unit=section.angle_unit)
    check_frame(table, world.definition)
    names = {image.image_id for image in survey.epoch.images}
    if not names & set(table.image_ids):
        raise InputError(
            f"None of the {len(table.image_ids)} images of the trajectory is one of the epoch, the first is "
            f"'{table.image_ids[0]}'.",
            expected=f"names of images as in the epoch, such as '{survey.epoch.images[0].image_id}'.",
            remedy="Correct the names.",
            path=path,
        )
    poses = world_poses(world, table.positions_in_crs, table.axes_from_cam)
    return dict(zip(table.image_ids, poses, strict=True))


def _motion_cov(section: TrajectorySection, motion: Rigid3, seconds: float) -> Array:
    """Covariance (6, 6): constant, and growing with the root of length and duration as a random walk does."""
    length = float(np.linalg.norm(motion.translation))
    position = section.sigma_m**2 + section.sigma_m_per_root_m**2 * length + section.sigma_m_per_root_s**2 * seconds
    rotation = (
        section.sigma_deg**2 + section.sigma_deg_per_root_m**2 * length + section.sigma_deg_per_root_s**2 * seconds
    )
    return np.diag([np.radians(1.0) ** 2 * rotation] * 3 + [position] * 3)
