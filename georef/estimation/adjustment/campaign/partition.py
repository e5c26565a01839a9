"""A block cut into parts by space: stations inside of a part share no point with those inside of another.

Stations are split in two, again and again, where the fewest of them see across the cut. A point that stations of two
parts see makes those of the lower part separators: so all that is inside of a part belongs to that part alone, its
points too. Each part is a block by itself, with the separators that it touches and everything shared; the sum of the
normal equations of all parts is that of the block, exactly.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from georef.estimation.adjustment.block import Block, Indices, State
from georef.geometry.poses import Poses
from georef.geometry.rigid import Array

_UNEVEN = 0.12  # by how much the share of a part may be off


@dataclass(frozen=True, eq=False)
class Part:
    """One part as a block of its own: `inner` stations first, separators behind them.

    stations, points: which of the whole block's each one is; what is shared (mountings, calibrations, lever arms,
    drift, points that measured distances end at) is in every part, its weight in the first alone.
    """

    block: Block
    inner: int
    stations: Indices
    points: Indices

    def taken(self, state: State, *, points: bool) -> State:
        """The part of a state; without points none are copied."""
        own = state.points[self.points] if points else np.zeros((0, 3))
        return replace(state, world_from_rig=state.world_from_rig.take(self.stations), points=own)


@dataclass(frozen=True, eq=False)
class Partition:
    """Which part each station lies in, and whether parts share it; which part takes each point."""

    parts: int
    part: Indices  # (S,)
    separator: NDArray[np.bool_]  # (S,)
    of_point: Indices  # (P,) -1: ends of measured distances, in all parts

    @property
    def separators(self) -> Indices:
        return np.flatnonzero(self.separator)


def partition(block: Block, parts: int, positions: Array) -> Partition:
    """Splits the stations, at positions (S, 3), into parts of about equal numbers of observations."""
    obs, stations = block.observations, len(block.station_ids)
    load = np.bincount(block.station[obs.view], minlength=stations) + 1
    shared = np.zeros(len(block.points), bool)
    shared[block.distances.a] = shared[block.distances.b] = True
    point, station = _incidence(block, shared)
    part = np.zeros(stations, np.int64)
    _split(np.arange(stations), parts, 0, positions, load, (point, station), part)
    highest = np.zeros(len(block.points) + len(block.relative_poses), np.int64)
    np.maximum.at(highest, point, part[station])
    separator = np.zeros(stations, bool)
    separator[station[part[station] < highest[point]]] = True
    return Partition(parts, part, separator, np.where(shared, -1, highest[: len(block.points)]))


def _incidence(block: Block, shared: NDArray[np.bool_]) -> tuple[Indices, Indices]:
    """Which point (n,) is seen from which station (n,), once each; measured motions as points behind the others."""
    obs, motions, stations = block.observations, block.relative_poses, len(block.station_ids)
    free = ~shared[obs.point]
    seen = np.unique(obs.point[free] * stations + block.station[obs.view[free]])
    ends = np.tile(len(block.points) + np.arange(len(motions)), 2)
    return (
        np.concatenate([seen // stations, ends]),
        np.concatenate([seen % stations, motions.a, motions.b]),
    )


def _split(
    chosen: Indices,
    parts: int,
    first: int,
    positions: Array,
    load: Indices,
    incidence: tuple[Indices, Indices],
    out: Indices,
) -> None:
    """Numbers the chosen stations with parts first, first + 1, ..."""
    out[chosen] = first
    if parts < 2 or len(chosen) < 2:
        return
    lower = parts // 2
    left = _lower_side(chosen, lower / parts, positions, load, incidence)
    rest = np.setdiff1d(chosen, left)
    side = np.zeros(len(positions), bool)
    side[left] = True
    for stations, count, begin, kept in (
        (left, lower, first, side[incidence[1]]),
        (rest, parts - lower, first + lower, ~side[incidence[1]]),
    ):
        _split(stations, count, begin, positions, load, (incidence[0][kept], incidence[1][kept]), out)


def _lower_side(
    chosen: Indices, share: float, positions: Array, load: Indices, incidence: tuple[Indices, Indices]
) -> Indices:
    """The stations on one side of the best cut across four directions or the order of the stations, in both senses,
    near the asked share of the observations: few separators, one of which counts as much as a station too many."""
    best, least = chosen[:1], 2.0 * len(chosen)
    for angle in (None, *np.arange(4) * np.pi / 4):
        key = chosen if angle is None else positions[chosen, :2] @ [np.cos(angle), np.sin(angle)]
        along = chosen[np.argsort(key, kind="stable")]
        for order in (along, along[::-1]):
            reached = np.cumsum(load[order]) / load[order].sum()
            count = _separators(order, len(positions), incidence)
            allowed = (reached > share - _UNEVEN) & (reached < share + _UNEVEN)
            allowed[-1] = False
            uneven = len(chosen) * np.abs(reached - share)
            cut = int(np.argmin(np.where(allowed, count + uneven, 2 * len(chosen))))
            if allowed[cut] and count[cut] + uneven[cut] < least:
                best, least = order[: cut + 1], count[cut] + uneven[cut]
    return np.sort(best)


def _separators(order: Indices, stations: int, incidence: tuple[Indices, Indices]) -> Indices:
    """How many stations (n,) up to each place of an order share a point with later ones."""
    point, station = incidence
    place = np.empty(stations, np.int64)
    place[order] = np.arange(len(order))
    last = np.zeros(int(point.max(initial=0)) + 1, np.int64)
    np.maximum.at(last, point, place[station])
    reach = np.zeros(len(order), np.int64)
    np.maximum.at(reach, place[station], last[point])
    change = np.zeros(len(order) + 1, np.int64)
    np.add.at(change, np.arange(len(order)), 1)
    np.add.at(change, np.maximum(reach, np.arange(len(order))), -1)
    return np.cumsum(change)[:-1]


def part_of(block: Block, cut: Partition, index: int) -> Part:
    """One part of a block, with its own observations and constraints alone."""
    obs = block.observations
    seen_by = block.station[obs.view]
    of_point = cut.of_point[obs.point]
    taken = obs.take(np.where(of_point < 0, cut.part[seen_by], of_point) == index)
    relative = block.relative_poses.take(_owner_of_pairs(block, cut) == index)
    here = cut.part == index
    here[block.station[taken.view]] = here[relative.a] = here[relative.b] = True
    inner, edge = np.flatnonzero(here & ~cut.separator), np.flatnonzero(here & cut.separator)
    stations = np.concatenate([inner, edge])
    images = np.flatnonzero(here[block.station])
    points = np.flatnonzero((cut.of_point == index) | (cut.of_point < 0))
    station, image, point = (_places(found, count) for found, count in _numbered(block, stations, images, points))
    given = block.point_priors
    mine = (cut.of_point[given.point] == index) | ((cut.of_point[given.point] < 0) & (index == 0))
    poses, fixes = block.pose_priors, block.position_priors
    poses = poses.take(cut.part[block.station[poses.image]] == index)
    fixes = fixes.take(cut.part[fixes.station] == index)
    given = given.take(mine)
    own = replace(
        block,
        station_ids=tuple(block.station_ids[i] for i in stations),
        image_ids=tuple(block.image_ids[i] for i in images),
        station=station[block.station[images]],
        mounting=block.mounting[images],
        calibration=block.calibration[images],
        world_from_rig=block.world_from_rig.take(stations),
        points=block.points[points],
        observations=replace(taken, point=point[taken.point], view=image[taken.view]),
        pose_priors=replace(poses, image=image[poses.image]),
        position_priors=replace(fixes, station=station[fixes.station]),
        relative_poses=replace(relative, a=station[relative.a], b=station[relative.b]),
        point_priors=replace(given, point=point[given.point]),
        distances=replace(block.distances, a=point[block.distances.a], b=point[block.distances.b]),
        reference_rays=None,
    )
    return Part(own if index == 0 else _unweighted(own), len(inner), stations, points)


def _owner_of_pairs(block: Block, cut: Partition) -> Indices:
    """The part of each measured motion: that which one of its stations lies inside of, else the first station's."""
    a, b = block.relative_poses.a, block.relative_poses.b
    return np.where(cut.separator[a] & ~cut.separator[b], cut.part[b], cut.part[a])


def _numbered(
    block: Block, stations: Indices, images: Indices, points: Indices
) -> tuple[tuple[Indices, int], tuple[Indices, int], tuple[Indices, int]]:
    return (stations, len(block.station_ids)), (images, len(block.image_ids)), (points, len(block.points))


def _places(chosen: Indices, count: int) -> Indices:
    """Where each of `count` stands among the chosen ones; -1: not there."""
    out = np.full(count, -1)
    out[chosen] = np.arange(len(chosen))
    return out


def _unweighted(block: Block) -> Block:
    """The same unknowns, but nothing that is given of what all parts share."""
    free = np.zeros_like
    return replace(
        block,
        mountings=tuple(
            m if m.information is None else replace(m, information=free(m.information)) for m in block.mountings
        ),
        calibrations=tuple(replace(c, information=free(c.information)) for c in block.calibrations),
        antennas=tuple(
            a if a.information is None else replace(a, information=free(a.information)) for a in block.antennas
        ),
        drift_information=free(block.drift_information),
        distances=replace(block.distances, sigma_m=np.full(len(block.distances), np.inf)),
    )


def joined_poses(count: int, parts: list[tuple[Indices, Poses]]) -> Poses:
    """Poses (count) of which parts know some."""
    out = Poses(np.zeros((count, 3, 3)), np.zeros((count, 3)))
    for where, poses in parts:
        out.rotation[where], out.translation[where] = poses.rotation, poses.translation
    return out
