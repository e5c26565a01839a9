"""What is given of a simulated drive besides its images: GNSS, localized poses, automatic and surveyed control.

Every error is drawn from the covariance that is stated for it, with one exception that is stated as well: localized
poses and automatic control points of one stretch share the error of the reference images they were found in.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from georef.estimation.adjustment.block import (
    KINDS_OF_POINT,
    KINDS_OF_POSE,
    PointPriors,
    PosePriors,
    PositionPriors,
    RelativePoses,
)
from georef.geometry.poses import Poses
from georef.geometry.rigid import Array
from georef.simulate.drive_city import Route

_NO_STRETCH = -1
_FULL, _LEVEL, _HEIGHT = np.array([1.0, 1.0, 1.0]), np.array([1.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class DrivePriors:
    """What is given, and how good it is; sigmas are of each coordinate.

    Stretches are passages of streets. Shares of them have localized poses, or automatic control points, never both.
    """

    gnss: bool = True
    gnss_m: tuple[float, float] = (0.02, 0.05)  # sigma by street, between these
    outages: float = 0.15  # share of the streets without GNSS
    drift_m: float = 0.03  # at each corner, linear between; 0: none
    poses: float = 0.4  # share of the stretches with localized poses
    poses_a_station: int = 2
    pose_m: tuple[float, float] = (0.01, 0.03)
    pose_deg: tuple[float, float] = (0.02, 0.05)
    points: float = 0.3  # share of the stretches with automatic control points
    points_a_station: float = 4.0
    point_m: tuple[float, float] = (0.008, 0.03)
    reference_m: float = 0.007  # of what those of one group of reference images have in common
    reference_stations: int = 5  # of a group
    control: int = 30  # surveyed points; every fifth a height alone, every fifth without its height
    control_m: float = 0.01
    motions: bool = False  # an IMU between consecutive stations
    motion_m: float = 0.005
    motion_deg: float = 0.01


@dataclass(frozen=True, eq=False)
class Given:
    """Constraints with errors, and the groups (K,) of reference images that their shared errors belong to, -1: none."""

    positions: PositionPriors
    drift_m: Array  # (D, 3) true
    poses: PosePriors
    pose_reference: NDArray[np.int64]
    points: PointPriors
    point_reference: NDArray[np.int64]
    motions: RelativePoses


def draw_given(
    design: DrivePriors, route: Route, world_from_cam: Poses, points: Array, anchor: NDArray[np.int64], seed: int
) -> Given:
    """All of it for a drive with true poses of images (station by station) and true points (P, 3) with anchors (P,).

    Each part has its own stream of numbers, so that one can be changed and the others stay.
    """
    kind = _stretches(design, route, _stream(seed, "stretches"))
    group = np.arange(len(route.s_m)) // design.reference_stations
    shared = design.reference_m * _stream(seed, "references").normal(size=(int(group.max()) + 1, 3))
    heads = len(world_from_cam) // len(route.s_m)
    poses, pose_reference = _poses(design, kind, world_from_cam, heads, group, shared, _stream(seed, "poses"))
    given_points, point_reference = _points(design, kind, points, anchor, group, shared, _stream(seed, "points"))
    positions, drift = _positions(design, route, _stream(seed, "gnss"))
    motions = _motions(design, route.world_from_rig, _stream(seed, "motions"))
    return Given(positions, drift, poses, pose_reference, given_points, point_reference, motions)


def _stream(seed: int, name: str) -> np.random.Generator:
    return np.random.default_rng([seed, *name.encode()])


def _stretches(design: DrivePriors, route: Route, rng: np.random.Generator) -> NDArray[np.int64]:
    """What the map gives at each station (S,): 0 localized poses, 1 automatic control points, 2 nothing."""
    streets = int(route.street.max()) + 1
    counts = np.round(np.array([design.poses, design.poses + design.points]) * streets).astype(np.int64)
    place = np.empty(streets, np.int64)
    place[rng.permutation(streets)] = np.arange(streets)
    return np.searchsorted(counts, place, side="right")[route.street]


def _poses(
    design: DrivePriors,
    kind: NDArray[np.int64],
    world_from_cam: Poses,
    heads: int,
    group: NDArray[np.int64],
    shared: Array,
    rng: np.random.Generator,
) -> tuple[PosePriors, NDArray[np.int64]]:
    """Localized poses of the first cameras of stations; their errors of rotation and position are correlated."""
    station = np.repeat(np.flatnonzero(kind == 0), design.poses_a_station)
    image = station * heads + np.tile(np.arange(design.poses_a_station), len(station) // design.poses_a_station)
    n = len(image)
    sigma = np.repeat([np.radians(rng.uniform(*design.pose_deg, n)), rng.uniform(*design.pose_m, n)], 3, axis=0).T
    correlation = np.eye(6)  # a camera that is turned too far to the right is put too far to the left
    correlation[1, 3] = correlation[3, 1] = -0.6
    correlation[0, 4] = correlation[4, 0] = 0.6
    own = sigma[:, :, None] * correlation * sigma[:, None, :]
    xi = np.einsum("nij,nj->ni", np.linalg.cholesky(own), rng.normal(size=(n, 6)))
    true = world_from_cam.take(image)
    xi[:, 3:] += np.einsum("nji,nj->ni", true.rotation, shared[group[station]])
    cov = own.copy()
    cov[:, 3:, 3:] += design.reference_m**2 * np.eye(3)
    which = np.full(n, KINDS_OF_POSE.index("localized"))
    return PosePriors(image, true.retract(xi), cov, which), group[station]


def _points(
    design: DrivePriors,
    kind: NDArray[np.int64],
    points: Array,
    anchor: NDArray[np.int64],
    group: NDArray[np.int64],
    shared: Array,
    rng: np.random.Generator,
) -> tuple[PointPriors, NDArray[np.int64]]:
    """Automatic control points of the stretches that have them, and surveyed ones anywhere."""
    automatic, control = _chosen(design, kind, anchor, rng)
    n, m = len(automatic), len(control)
    sigma = rng.uniform(*design.point_m, n)[:, None] * rng.uniform(0.5, 1.5, (n, 3))
    axes = np.linalg.qr(rng.normal(size=(n, 3, 3)))[0] if n else np.zeros((0, 3, 3))
    own = np.einsum("nij,nj,nkj->nik", axes, sigma**2, axes)
    error = np.einsum("nij,nj->ni", axes, sigma * rng.normal(size=(n, 3))) + shared[group[anchor[automatic]]]
    cov = own + design.reference_m**2 * np.eye(3)
    known = np.array([_HEIGHT if i % 5 == 3 else _LEVEL if i % 5 == 4 else _FULL for i in range(m)]).reshape(-1, 3)
    control_error = np.where(known > 0, design.control_m * rng.normal(size=(m, 3)), 0.0)
    which = np.repeat([KINDS_OF_POINT.index("automatic"), KINDS_OF_POINT.index("control")], [n, m])
    information = np.concatenate([np.linalg.inv(cov), known[:, :, None] * np.eye(3) / design.control_m**2])
    names = (*(f"A{i}" for i in automatic), *(f"C{i}" for i in control))
    index = np.concatenate([automatic, control])
    given = points[index] + np.concatenate([error, control_error])
    reference = np.concatenate([group[anchor[automatic]], np.full(m, _NO_STRETCH)])
    return PointPriors(index, given, information, which, names), reference


def _chosen(
    design: DrivePriors, kind: NDArray[np.int64], anchor: NDArray[np.int64], rng: np.random.Generator
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Points that are automatic control points, and others that are surveyed."""
    order = rng.permutation(len(anchor))
    here = order[kind[anchor[order]] == 1]
    automatic = np.sort(here[: round(design.points_a_station * int((kind == 1).sum()))])
    others = np.setdiff1d(order, automatic, assume_unique=True)
    return automatic, np.sort(rng.permutation(others)[: design.control])


def _positions(design: DrivePriors, route: Route, rng: np.random.Generator) -> tuple[PositionPriors, Array]:
    """An observation a station, but not in streets with outages; before the lever arm is added (the caller does)."""
    streets = int(route.street.max()) + 1
    sigma = rng.uniform(*design.gnss_m, streets)[route.street]
    dark = np.zeros(streets, bool)
    dark[rng.permutation(streets)[: round(design.outages * streets)]] = True
    nodes = streets + 1 if design.gnss and design.drift_m > 0 else 0
    drift = design.drift_m * rng.normal(size=(nodes, 3))
    station = np.flatnonzero(~dark[route.street]) if design.gnss else np.zeros(0, np.int64)
    node, weight = _between(route, station) if nodes else (np.full((len(station), 2), -1), np.zeros((len(station), 2)))
    error = sigma[station, None] * rng.normal(size=(len(route.s_m), 3))[station]
    if nodes:
        error = error + np.einsum("nk,nkj->nj", weight, drift[node])
    cov = sigma[station, None, None] ** 2 * np.eye(3)
    position = route.world_from_rig.translation[station] + error
    return PositionPriors(station, position, cov, np.zeros(len(station), np.int64), node, weight), drift


def _between(route: Route, station: NDArray[np.int64]) -> tuple[NDArray[np.int64], Array]:
    """Drift nodes (K, 2) at the two ends of the streets of stations (K,), and their weights (K, 2)."""
    streets = int(route.street.max()) + 1
    first = np.searchsorted(route.street, np.arange(streets + 1))
    starts = route.s_m[np.minimum(first, len(route.s_m) - 1)]
    street = route.street[station]
    share = (route.s_m[station] - starts[street]) / np.maximum(starts[street + 1] - starts[street], 1e-9)
    share = np.clip(share, 0.0, 1.0)
    return np.column_stack([street, street + 1]), np.column_stack([1.0 - share, share])


def _motions(design: DrivePriors, poses: Poses, rng: np.random.Generator) -> RelativePoses:
    if not design.motions:
        return RelativePoses.none()
    a = np.arange(len(poses) - 1)
    b = a + 1
    sigma = np.repeat([np.radians(design.motion_deg), design.motion_m], 3)
    true = poses.take(a).inverse() @ poses.take(b)
    return RelativePoses(
        a, b, true.retract(sigma * rng.normal(size=(len(a), 6))), np.tile(np.diag(sigma**2), (len(a), 1, 1))
    )
