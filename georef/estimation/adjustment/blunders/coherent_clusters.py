"""Few points that are wrong by one shift: single contradictions near each other that turn out to be the same.

A stretch of two or three stations is too short to stand out against its neighbours on the drive. Gates reject its
points one by one; that they agree with each other says that they have one cause.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import numpy as np
from scipy.stats import chi2

from georef.estimation.adjustment.block import KINDS_OF_POINT, KINDS_OF_POSE, Block, Indices, State
from georef.estimation.adjustment.blunders.coherent import FEWEST_POINTS, CoherentBlock, detectable, references_of
from georef.estimation.adjustment.blunders.shift_rows import AUTOMATIC, stations_of_points
from georef.estimation.adjustment.equations.cofactors import Cofactors
from georef.geometry.rigid import Array

_REACH = 30  # contradicting points before and after that are compared with one
_STATIONS = 10  # that two of a cluster may be apart
_AGREES = 0.99


@dataclass(frozen=True, eq=False)
class Offsets:
    """How far given points or projection centres are from where all else puts them; points in the order of their
    stations."""

    row: Indices  # (K,) of the point priors, or of the pose priors
    station: Indices  # (K,)
    off_m: Array  # (K, 3) given minus adjusted
    own: Array  # (K, 3, 3) covariances of what is given
    cov: Array  # (K, 3, 3) of the offsets; NaN where nothing else determines the point

    @staticmethod
    def of_points(block: Block, state: State, points: Array) -> Offsets:
        """Of the automatic GCPs; points: cofactors (P, 3, 3) of an adjustment without the doubtful ones."""
        priors = block.point_priors
        station = stations_of_points(block)[priors.point]
        row = np.flatnonzero((priors.kind == KINDS_OF_POINT.index(AUTOMATIC)) & (station >= 0))
        row = row[np.argsort(station[row], kind="stable")]
        point = priors.point[row]
        own = cast(Array, np.linalg.inv(priors.information[row]))
        return Offsets(row, station[row], priors.position[row] - state.points[point], own, own + points[point])

    @staticmethod
    def of_poses(block: Block, state: State, found: Cofactors) -> Offsets:
        """Of the localized poses; found: cofactors of an adjustment without the doubtful ones."""
        row = np.flatnonzero(block.pose_priors.kind == KINDS_OF_POSE.index("localized"))
        priors = block.pose_priors
        image, given = priors.image[row], priors.world_from_cam.take(row)
        adjusted = block.world_from_cam(state).take(image)
        own = given.rotation @ priors.cov[row, 3:, 3:] @ np.swapaxes(given.rotation, 1, 2)
        place = found.images(block, state, image)[:, 3:, 3:]
        place = adjusted.rotation @ place @ np.swapaxes(adjusted.rotation, 1, 2)
        return Offsets(row, block.station[image], given.translation - adjusted.translation, own, own + place)

    def take(self, chosen: Indices) -> Offsets:
        arrays = self.off_m[chosen], self.own[chosen], self.cov[chosen]
        return Offsets(self.row[chosen], self.station[chosen], *arrays)

    def squares(self, shift: Array | float = 0.0) -> Array:
        """Their statistics (K,), 3 degrees of freedom, with a shift taken off."""
        off = self.off_m - shift
        return np.einsum("ki,ki->k", off, np.linalg.solve(self.cov, off[:, :, None])[:, :, 0])


def clusters(block: Block, offsets: Offsets, shared: float, limit: float) -> list[CoherentBlock]:
    """Blocks among single contradictions, the largest first; each of three points or more whose common shift has a
    statistic above a limit, `shared` being the variance that what is right may have in common."""
    known = np.flatnonzero(np.isfinite(offsets.cov).all(axis=(1, 2)))
    left, found = offsets.take(known), []
    while len(left.row) >= FEWEST_POINTS:
        agree = _agreement(left)
        members = np.flatnonzero(agree[np.argmax(agree.sum(axis=1))])
        if len(members) < FEWEST_POINTS:
            break
        cluster = named(block, left.take(members), False, shared, limit)
        found += [cluster] if cluster.statistic > limit else []
        left = left.take(np.delete(np.arange(len(left.row)), members))
    return found


def _agreement(offsets: Offsets) -> Array:
    """Which (K, K) are near each other and may have the same offset; each with itself."""
    count = len(offsets.row)
    agree, limit = np.eye(count, dtype=bool), float(chi2.ppf(_AGREES, 3))
    for step in range(1, min(_REACH, count - 1) + 1):
        a, b = np.arange(count - step), np.arange(step, count)
        off = offsets.off_m[a] - offsets.off_m[b]
        square = np.einsum("ki,ki->k", off, np.linalg.solve(offsets.cov[a] + offsets.cov[b], off[:, :, None])[:, :, 0])
        same = (square <= limit) & (offsets.station[b] - offsets.station[a] <= _STATIONS)
        agree[a[same], b[same]] = agree[b[same], a[same]] = True
    return agree


def common_shift(members: Offsets) -> tuple[Array, Array]:
    """The weighted mean (3,) of offsets and its covariance; what the solution's errors do to them is taken to be common
    to all. Members that nothing else determines do not count."""
    known = members.take(np.flatnonzero(np.isfinite(members.cov).all(axis=(1, 2))))
    weight = np.linalg.inv(known.cov)
    shift = np.linalg.solve(weight.sum(axis=0), np.einsum("kij,kj->i", weight, known.off_m))
    return shift, np.linalg.inv(np.linalg.inv(known.own).sum(axis=0)) + np.median(known.cov - known.own, axis=0)


def named(block: Block, members: Offsets, poses: bool, shared: float, limit: float) -> CoherentBlock:
    """A block of these members, poses or points, with the shift that they have in common."""
    shift, cov = common_shift(members)
    statistic = float(shift @ np.linalg.solve(cov + shared * np.eye(3), shift))
    names = tuple(block.station_ids[i] for i in np.unique(members.station))
    rows, none = np.sort(members.row), np.zeros(0, np.int64)
    pose_rows, point_rows = (rows, none) if poses else (none, rows)
    least = detectable(shift, statistic, limit)
    return CoherentBlock(names, pose_rows, point_rows, references_of(block, point_rows), shift, cov, statistic, least)
