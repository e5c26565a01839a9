"""GNSS of a block: positions of antennas as observations, lever arms, and offsets by flight and time."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from georef.crs import WorldFrame
from georef.errors import InputError
from georef.estimation.adjustment.block import Antenna, PositionPriors
from georef.geometry.camera import Camera
from georef.geometry.rigid import Array
from georef.io.gnss import GnssTable
from georef.io.table import IntArray
from georef.sections import BlockGnss, GnssDrift
from georef.stages.block_tables import BlockTables, by_pattern

_SAME_PLACE_M = 0.01


def antennas_of(
    section: BlockGnss | None, cameras: Sequence[Camera], *, rig: bool
) -> tuple[tuple[Antenna, ...], IntArray]:
    """Antennas, and that of each image (M,): one on a rig; without a rig one for each camera."""
    if section is None:
        return (), np.zeros(len(cameras), np.int64)
    ids = tuple(dict.fromkeys(camera.camera_id for camera in cameras))
    sigma, levers = section.lever_arm_sigma_m, section.lever_arm_m
    information = None if sigma is None else np.diag(np.square(1.0 / np.array(sigma)))
    if rig and isinstance(levers, dict):
        raise InputError(
            "gnss.lever_arm_m states lever arms by camera, and the cameras are mounted on a rig.",
            expected="one lever arm, in the frame of the rig.",
            remedy="State lever_arm_m = [x, y, z] in project.toml.",
        )
    if not isinstance(levers, dict) and (rig or len(ids) == 1):
        antenna = Antenna("antenna", np.array(levers, dtype=np.float64), information)
        return (antenna,), np.zeros(len(cameras), np.int64)
    missing = [name for name in ids if isinstance(levers, dict) and name not in levers]
    if missing:
        raise InputError(
            f"gnss.lever_arm_m states none for camera '{missing[0]}'.",
            expected=f"one for each of {', '.join(ids)}.",
            remedy="Add it in project.toml.",
        )
    antennas = tuple(
        Antenna(name, np.array(levers[name] if isinstance(levers, dict) else levers, dtype=np.float64), information)
        for name in ids
    )
    return antennas, np.array([ids.index(camera.camera_id) for camera in cameras], dtype=np.int64)


def position_priors(
    section: BlockGnss | None,
    tables: BlockTables,
    rows: IntArray,
    image_ids: Sequence[str],
    station: IntArray,
    antenna: IntArray,
    world: WorldFrame,
) -> tuple[PositionPriors, Array]:
    """One position an exposure that has one, that of its first image with a row (rows (M,), -1: none), and the
    information (D, 3, 3) of the drift. Raises InputError where images of one exposure disagree."""
    gnss = tables.gnss
    if gnss is None or section is None:
        return PositionPriors.none(), np.zeros((0, 3, 3))
    there = np.flatnonzero(rows >= 0)
    stations, first = np.unique(station[there], return_index=True)
    images = there[first]
    own = rows[images]
    positions = world.world_from_crs(gnss.positions_in_crs[own])
    _refuse_apart(gnss, rows, there, station, dict(zip(stations.tolist(), positions, strict=True)), world)
    covs = np.zeros((len(own), 3, 3))
    covs[:, range(3), range(3)] = np.square(gnss.sigmas_m[own])
    node, weight, information = _drift(section, tables, own, [image_ids[int(i)] for i in images])
    return PositionPriors(
        station=stations,
        position=positions,
        cov=world.world_cov_from_crs(gnss.positions_in_crs[own], covs),
        antenna=antenna[images],
        drift_node=node,
        drift_weight=weight,
    ), information


def _refuse_apart(
    gnss: GnssTable, rows: IntArray, there: IntArray, station: IntArray, known: dict[int, Array], world: WorldFrame
) -> None:
    of_images = world.world_from_crs(gnss.positions_in_crs[rows[there]])
    apart = np.linalg.norm(of_images - np.array([known[int(s)] for s in station[there]]).reshape(-1, 3), axis=1)
    if (apart > _SAME_PLACE_M).any():
        row = int(rows[there[int(np.argmax(apart))]])
        raise InputError(
            f"Image '{gnss.image_ids[row]}' has a position {apart.max():.3f} m from that of its exposure.",
            expected="one position of the antenna for all images of an exposure.",
            remedy="Correct the positions or what says the exposures; where each camera has its own, adjust without "
            "rig, or name the rows of one camera only.",
            path=gnss.path,
            row=int(gnss.rows[row]),
        )


def _drift(
    section: BlockGnss, tables: BlockTables, rows: IntArray, image_ids: Sequence[str]
) -> tuple[IntArray, Array, Array]:
    """Nodes (K, 2) and weights (K, 2) of K positions, and the information (D, 3, 3) of D nodes."""
    count = len(rows)
    node, weight = np.full((count, 2), -1, np.int64), np.zeros((count, 2))
    sigma = section.offset_sigma_m if section.drift is None else section.drift.sigma_m
    if sigma is None:
        return node, weight, np.zeros((0, 3, 3))
    drift = section.drift or GnssDrift(sigma_m=sigma)
    flights = _flights(drift, tables, rows, image_ids)
    nodes = 0
    for name in dict.fromkeys(flights):
        here = np.flatnonzero([flight == name for flight in flights])
        if drift.interval_s is None:
            node[here, 0], weight[here, 0] = nodes, 1.0
            nodes += 1
            continue
        times = _times(tables, rows[here], drift.interval_s)
        pieces = max(int(np.ceil(np.ptp(times) / drift.interval_s)), 1)
        along = (times - times.min()) / max(float(np.ptp(times)), 1e-9) * pieces
        piece = np.minimum(along.astype(np.int64), pieces - 1)
        node[here] = nodes + np.stack([piece, piece + 1], axis=1)
        weight[here] = np.stack([1.0 - (along - piece), along - piece], axis=1)
        nodes += pieces + 1
    information = np.tile(np.diag(np.square(1.0 / np.array(sigma))), (nodes, 1, 1))
    return node, weight, information


def _flights(drift: GnssDrift, tables: BlockTables, rows: IntArray, image_ids: Sequence[str]) -> tuple[str, ...]:
    if tables.flights is not None:
        return tuple(tables.flights[row] for row in rows)
    if drift.flight_pattern is not None:
        return by_pattern(drift.flight_pattern, image_ids, "flight")
    return ("",) * len(rows)


def _times(tables: BlockTables, rows: IntArray, interval_s: float) -> Array:
    if tables.times_s is None:
        raise InputError(
            f"gnss.drift.interval_s = {interval_s:g} asks for times, and the table of positions has none.",
            expected="a column `time`: seconds, or a date and time.",
            remedy='Add the column, or map it: table.columns = { time = "..." }.',
            path=None if tables.gnss is None else tables.gnss.path,
        )
    return tables.times_s[rows]
