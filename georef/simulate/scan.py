"""A laser scan of an epoch: a scanner on the vehicle turns about a tilted axis while it drives; LAS 1.4 in the CRS.

Rays are cast along the true way of the vehicle. The scan of the first epoch lies in the reference, with its smooth
error; that of the second is exact but for the noise of the ranges.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import laspy
import numpy as np
from pyproj import CRS as PyprojCrs

from georef.crs import WorldFrame
from georef.geometry.angles import rotation_x, rotation_z
from georef.geometry.rigid import Array
from georef.replacing import replacing
from georef.simulate.street import Epoch
from georef.simulate.trajectory import Motion, rig_rotations
from georef.simulate.world import CRS, REFERENCE, StreetWorld

_FORMAT, _VERSION, _RESOLUTION_M = 7, "1.4", 0.001
_PROFILES_AT_ONCE, _KNOT_EVERY, _SHADES = 64, 60, 65535


@dataclass(frozen=True)
class Scanner:
    """A profile scanner behind the roof, tilted so that it meets walls from the side."""

    position_in_rig_m: tuple[float, float, float] = (0.0, -1.2, 2.4)
    tilt_deg: float = 30.0  # of its axis from the driving direction, up
    turn_deg: float = 30.0  # and to the right
    profile_spacing_m: float = 0.06
    points_per_profile: int = 900
    range_sigma_m: float = 0.01
    nearest_m: float = 1.5
    reach_m: float = 60.0

    def directions_in_rig(self) -> Array:
        """Unit directions (P, 3) of one turn of the mirror."""
        angle = 2.0 * np.pi * np.arange(self.points_per_profile) / self.points_per_profile
        across = np.column_stack([np.sin(angle), np.zeros_like(angle), np.cos(angle)])
        return across @ (rotation_z(-np.radians(self.turn_deg)) @ rotation_x(np.radians(self.tilt_deg))).T


@dataclass(frozen=True, eq=False)
class ScanChunk:
    """Points of some profiles."""

    points_in_world: Array  # (N, 3) with noise
    exact_in_world: Array  # (N, 3)
    colour: Array  # (N, 3) albedo, 0 to 1
    intensity: Array  # (N,) 0 to 1
    time_s: Array  # (N,)


def scan_file(epoch: Epoch) -> str:
    """LAZ where a compressor is installed, else LAS."""
    return f"scan_{epoch}.{'laz' if laspy.LazBackend.detect_available() else 'las'}"


def scan(world: StreetWorld, epoch: Epoch, scanner: Scanner | None = None) -> Iterator[ScanChunk]:
    """The points of an epoch in the order of time, some profiles at once."""
    scanner = scanner or Scanner()
    motion, rng = world.motion(REFERENCE if epoch == "first" else "second"), world.rng("scan", epoch)
    places = np.arange(0.0, world.street.axis.length_m, scanner.profile_spacing_m)
    for start in range(0, len(places), _PROFILES_AT_ONCE):
        yield _profiles(world, epoch, scanner, motion, places[start : start + _PROFILES_AT_ONCE], rng)


def _profiles(
    world: StreetWorld, epoch: Epoch, scanner: Scanner, motion: Motion, places: Array, rng: np.random.Generator
) -> ScanChunk:
    """Points of some profiles; the vehicle moves on while the mirror turns."""
    per = scanner.points_per_profile
    share = np.arange(per) / per * scanner.profile_spacing_m
    s = (places[:, None] + share).ravel()
    positions, turns = _path(motion, s)
    origins = positions + turns @ np.array(scanner.position_in_rig_m)
    directions = np.einsum("nij,nj->ni", turns, np.tile(scanner.directions_in_rig(), (len(places), 1)))
    hits = world.scene(epoch).cast(origins, directions, with_colour=True)
    kept = (hits.distance_m > scanner.nearest_m) & (hits.distance_m < scanner.reach_m)
    distance, directions = hits.distance_m[kept, None], directions[kept]
    exact = origins[kept] + distance * directions
    noise = scanner.range_sigma_m * rng.normal(size=(len(exact), 1))
    noisy = exact + noise * directions
    colour = np.asarray(hits.colour, dtype=np.float64)[kept]
    slant = np.abs(np.sum(hits.normal[kept] * directions, axis=1))
    moved = world.deformation.moved(noisy) if epoch == "first" else noisy
    return ScanChunk(moved, exact, colour, colour.mean(axis=1) * slant, s[kept] / motion.speed_mps)


def _path(motion: Motion, s: Array) -> tuple[Array, Array]:
    """Positions (N, 3) and rotations (N, 3, 3) at rising places (N,): straight between places a few mm apart."""
    knots = np.append(s[::_KNOT_EVERY], s[-1])
    way = np.column_stack(motion.at(knots))
    between = np.column_stack([np.interp(s, knots, column) for column in way.T])
    return between[:, :3], rig_rotations(between[:, 3:])


def write_scan(world: StreetWorld, epoch: Epoch, folder: Path, scanner: Scanner | None = None) -> Path:
    """Writes an epoch's scan chunk by chunk, under a temporary name until it is complete; kept if it is there."""
    path = folder / scan_file(epoch)
    if path.is_file():
        return path
    header = _header(world.frame)
    with replacing(path, path.suffix) as temporary, laspy.open(str(temporary), mode="w", header=header) as writer:
        for chunk in scan(world, epoch, scanner):
            writer.write_points(_record(chunk, header, world.frame))
    return path


def _header(frame: WorldFrame) -> laspy.LasHeader:
    header = laspy.LasHeader(point_format=_FORMAT, version=_VERSION)
    header.scales, header.offsets = np.full(3, _RESOLUTION_M), frame.origin_in_crs
    header.add_crs(PyprojCrs(CRS.horizontal))
    return header


def _record(chunk: ScanChunk, header: laspy.LasHeader, frame: WorldFrame) -> Any:
    record = laspy.ScaleAwarePointRecord.zeros(len(chunk.points_in_world), header=header)
    record["x"], record["y"], record["z"] = frame.crs_from_world(chunk.points_in_world).T
    record["intensity"] = np.clip(chunk.intensity * _SHADES, 0, _SHADES).astype(np.uint16)
    record["gps_time"] = chunk.time_s
    record["return_number"] = record["number_of_returns"] = np.ones(len(chunk.time_s), np.uint8)
    shades = np.clip(np.sqrt(chunk.colour) * _SHADES, 0, _SHADES).astype(np.uint16)
    record["red"], record["green"], record["blue"] = shades.T
    return record
