"""What stays the same over the iterations of a block: the order of observations, the pattern of station pairs."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from georef.estimation.adjustment.block import Block, Indices, State
from georef.estimation.adjustment.equations.block_cholesky import Pattern
from georef.estimation.adjustment.equations.reduced import Layout
from georef.estimation.adjustment.kernels.batches import Back, Pairs, Tracks, Work, work_for
from georef.estimation.adjustment.kernels.observations import (
    ASPECT,
    CENTRE_X,
    CENTRE_Y,
    FIRST_COEFFICIENT,
    FOCAL,
    Images,
    Placed,
    kernel,
)
from georef.geometry.camera import Camera
from georef.geometry.poses import Poses
from georef.geometry.projection import MODEL_NAMES

_CODES = {"focal": FOCAL, "aspect": ASPECT, "cx": CENTRE_X, "cy": CENTRE_Y}


@dataclass(frozen=True, eq=False)
class Prepared:
    """A block in the order of its kernels. `order` (n,): which observation of the block each row of `tracks` is.

    `first` and `column` are the pattern of `Reduced`: pairs of stations that share a point or a constraint.
    """

    layout: Layout
    tracks: Tracks
    images: Images
    order: NDArray[np.int64]
    first: Indices
    column: Indices

    @staticmethod
    def of(block: Block) -> Prepared:
        layout = Layout.of(block)
        order, points, start = _sorted_by_point(block)
        tracks = _tracks(block, layout, order, points, start)
        stations = block.station.astype(np.int32)
        tied = np.stack([block.relative_poses.a, block.relative_poses.b], axis=1)
        first, column = station_pairs(tracks, stations, layout, np.sort(tied, axis=1))
        return Prepared(layout, tracks, _images(block, layout), order, first, column)

    @cached_property
    def pattern(self) -> Pattern:
        """The order in which stations are eliminated, found once for all matrices of this pattern."""
        return Pattern.of(self.first, self.column)

    @cached_property
    def pairs(self) -> Pairs:
        tracks, station = self.tracks, self.images.station
        slot, first = _slots(tracks.start, tracks.image, tracks.kept, station)
        return Pairs(slot, first, _entries(tracks, station, first, self.first, self.column))

    def back(self) -> Back:
        """Memory for what one iteration leaves to its back-substitution."""
        return Back.empty(int(self.pairs.slot[-1]), len(self.tracks.point))

    def restricted(self, block: Block, kept: NDArray[np.bool_] | None = None) -> Prepared:
        """The same for a block that lacks some of the observations or constraints: what is left is not sorted again.

        kept (n,): which observations of the prepared block are left, in their order (None: all). Sigmas, and values of
        priors, may differ. The pattern keeps pairs of stations that share nothing any more, and is not ordered again.
        Measured distances must be as many: their ends are not eliminated; where they are fewer all is made anew.
        """
        layout = Layout.of(block)
        if not np.array_equal(layout.kept_point, self.layout.kept_point):
            return Prepared.of(block)
        order, points, start = self.order, self.tracks.point, self.tracks.start
        if kept is not None:
            left = kept[order]
            order = (np.cumsum(kept) - 1)[order[left]]
            start = np.concatenate([[0], np.cumsum(left)])[start]
        counts = np.diff(start)
        needed = counts > 0
        prior = np.zeros(len(block.points), bool)
        prior[block.point_priors.point] = True
        needed |= prior[points]
        start = np.concatenate([[0], np.cumsum(counts[needed])])
        tracks = _tracks(block, layout, order, points[needed], start)
        out = replace(self, layout=layout, tracks=tracks, images=_images(block, layout), order=order)
        if "pattern" in self.__dict__:
            out.__dict__["pattern"] = self.pattern
        return out

    def work(self) -> Work:
        return work_for(self.tracks.start, 6 + self.images.code.shape[1] + 3, self.layout.border)


def _tracks(
    block: Block, layout: Layout, order: Indices, points: NDArray[np.int32], start: NDArray[np.int64]
) -> Tracks:
    prior_row = np.full(len(block.points), -1)
    prior_row[block.point_priors.point] = np.arange(len(block.point_priors))
    obs = block.observations
    return Tracks(
        point=points,
        start=start,
        image=obs.view[order].astype(np.int32),
        pixel=obs.pixel[order],
        weight=1.0 / obs.sigma_px[order],
        kept=layout.kept_point[points],
        prior=prior_row[points],
    )


def placed(state: State) -> Placed:
    """The stations, mountings and calibrations of a state as the kernels take them."""
    rig_from_world, cam_from_rig = state.world_from_rig.inverse(), state.rig_from_cam.inverse()
    return Placed(
        *_arrays(rig_from_world),
        *_arrays(cam_from_rig),
        np.array([MODEL_NAMES.index(c.model) for c in state.cameras], dtype=np.int64),
        np.array([c.parameters for c in state.cameras], dtype=np.float64),
    )


def _arrays(poses: Poses) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    return np.ascontiguousarray(poses.rotation), np.ascontiguousarray(poses.translation)


def code_of(camera: Camera, name: str) -> int:
    """The kernels' number of one of ESTIMABLE."""
    return _CODES[name] if name in _CODES else FIRST_COEFFICIENT + camera.lens.parameters.index(name)


def _images(block: Block, layout: Layout) -> Images:
    names = [[code_of(c.camera, name) for name in c.camera.estimate] for c in block.calibrations]
    most = max((len(row) for row in names), default=0)
    return Images(
        station=block.station.astype(np.int32),
        mounting=block.mounting.astype(np.int32),
        calibration=block.calibration.astype(np.int32),
        mounting_column=layout.mounting.astype(np.int64),
        calibration_column=layout.calibration.astype(np.int64),
        code=np.array([row + [0] * (most - len(row)) for row in names], dtype=np.int64).reshape(len(names), most),
        unknowns=np.array([len(row) for row in names], dtype=np.int64),
    )


def _sorted_by_point(block: Block) -> tuple[NDArray[np.int64], NDArray[np.int32], NDArray[np.int64]]:
    """Observations point by point, within a point by station; points by their first station, so that what one pass
    touches lies together. Points without observations or prior are left out."""
    obs = block.observations
    by_station = np.argsort(block.station, kind="stable")
    rank = np.empty_like(by_station)
    rank[by_station] = np.arange(len(by_station))
    order = counting_order(rank[obs.view], len(rank))
    first_station = np.full(len(block.points), len(block.station_ids))
    first_station[obs.point[order[::-1]]] = block.station[obs.view[order[::-1]]]
    by_place = np.argsort(first_station, kind="stable")
    counts = np.bincount(obs.point, minlength=len(block.points))
    needed = counts > 0
    needed[block.point_priors.point] = True
    points = by_place[needed[by_place]]
    rank_of_point = np.zeros(len(block.points), np.int64)
    rank_of_point[points] = np.arange(len(points))
    order = order[counting_order(rank_of_point[obs.point[order]], len(points))]
    start = np.concatenate([[0], np.cumsum(counts[points])])
    return order, points.astype(np.int32), start


@kernel
def counting_order(key, count):
    """Stable order of keys (n,) in 0 .. count - 1."""
    start = np.zeros(count + 1, np.int64)
    for k in key:
        start[k + 1] += 1
    for k in range(count):
        start[k + 1] += start[k]
    order = np.empty(key.shape[0], np.int64)
    for i in range(key.shape[0]):
        order[start[key[i]]] = i
        start[key[i]] += 1
    return order


def station_pairs(tracks: Tracks, station: NDArray[np.int32], layout: Layout, tied: Indices) -> tuple[Indices, Indices]:
    """The pattern (first, column) of `Reduced`; tied (K, 2): further pairs, the smaller station first."""
    at_station, track, slot = _incidence(tracks.start, tracks.image, tracks.kept, station)
    by_station = counting_order(at_station, layout.stations)
    begin = np.searchsorted(at_station[by_station], np.arange(layout.stations + 1))
    tied = tied[np.argsort(tied[:, 0], kind="stable")]
    tied_begin = np.searchsorted(tied[:, 0], np.arange(layout.stations + 1))
    first, found = _pairs(
        begin, by_station, at_station, track, slot, tied_begin, np.ascontiguousarray(tied[:, 1]), layout.stations
    )
    return first, found


@kernel
def _incidence(start, image, kept, station):
    """All (station, track) pairs, by track: station (m,), track (m,), and the end of the track's own pairs (m,)."""
    total = 0
    for track in range(start.shape[0] - 1):
        last = -1
        for at in range(start[track], start[track + 1]):
            if station[image[at]] != last and kept[track] < 0:
                last = station[image[at]]
                total += 1
    stations, tracks, ends = np.empty(total, np.int64), np.empty(total, np.int32), np.empty(total, np.int64)
    m = 0
    for track in range(start.shape[0] - 1):
        last, begin = -1, m
        for at in range(start[track], start[track + 1]):
            if station[image[at]] != last and kept[track] < 0:
                last = station[image[at]]
                stations[m], tracks[m] = last, track
                m += 1
        ends[begin:m] = m
    return stations, tracks, ends


@kernel
def _slots(start, image, kept, station):
    """First slot (T + 1,) and first pair (T + 1,) of each track; tracks that are kept have no pairs."""
    slot, first = np.zeros(start.shape[0], np.int64), np.zeros(start.shape[0], np.int64)
    for track in range(start.shape[0] - 1):
        last, count = -1, 0
        for at in range(start[track], start[track + 1]):
            if station[image[at]] != last:
                last = station[image[at]]
                count += 1
        slot[track + 1] = slot[track] + count
        first[track + 1] = first[track] + (count * (count + 1) // 2 if kept[track] < 0 else 0)
    return slot, first


@kernel
def _entries(tracks, station, first_pair, first, column):
    """Place in the pattern (first, column) of all pairs of stations of tracks that are eliminated, as in `Pairs`."""
    out = np.empty(first_pair[-1], np.int32)
    for track in range(tracks.start.shape[0] - 1):
        pair, end = first_pair[track], tracks.start[track + 1]
        if first_pair[track + 1] == pair:
            continue
        row = -1
        for at in range(tracks.start[track], end):
            if station[tracks.image[at]] == row:
                continue
            row, last = station[tracks.image[at]], -1
            entry = first[row]
            for other in range(at, end):
                there = station[tracks.image[other]]
                if there == last:
                    continue
                last = there
                while column[entry] != there:
                    entry += 1
                out[pair] = entry
                pair += 1
    return out


@kernel
def _pairs(begin, by_station, at_station, track, end, tied_begin, tied, stations):
    """Rows of rising columns from pairs at the same track, and tied ones."""
    seen = np.full(stations, -1)
    first = np.zeros(stations + 1, np.int64)
    column = np.empty(16 * stations + 16, np.int64)
    total = 0
    for row in range(stations):
        if total + stations + 1 > column.shape[0]:
            grown = np.empty(2 * column.shape[0] + stations, np.int64)
            grown[:total] = column[:total]
            column = grown
        column[total], seen[row] = row, row
        total += 1
        for k in range(begin[row], begin[row + 1]):
            m = by_station[k]
            for other in range(m + 1, end[m]):
                there = at_station[other]
                if seen[there] != row:
                    seen[there], column[total] = row, there
                    total += 1
        for k in range(tied_begin[row], tied_begin[row + 1]):
            if seen[tied[k]] != row:
                seen[tied[k]], column[total] = row, tied[k]
                total += 1
        column[first[row] + 1 : total].sort()
        first[row + 1] = total
    return first, column[:total].copy()
