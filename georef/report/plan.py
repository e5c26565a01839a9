"""Where everything lies: stations, directions and residuals in one metric frame, and the axes of the CRS at images."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from georef.crs import WorldFrame
from georef.geometry.rigid import Array, Rigid3
from georef.types.constraints import CheckPoint, ControlPoint

MAX_REFERENCE = 400
_METRIC_KINDS = ("projected", "local")


@dataclass(frozen=True, eq=False)
class Placed:
    """What lies where, in the world frame."""

    world: WorldFrame
    new: Mapping[str, Rigid3]  # adjusted world_from_cam
    position_covs: Mapping[str, Array]  # (3, 3) of the adjusted positions
    gnss_covs: Mapping[str, Array]  # (3, 3) of the GNSS positions
    reference: Mapping[str, Rigid3]  # given world_from_cam
    check: Sequence[CheckPoint]
    control: Sequence[ControlPoint]

    def axes_at(self, poses: Mapping[str, Rigid3]) -> dict[str, Array]:
        """The turn (3, 3) from world axes to those of the CRS at each camera."""
        if not poses:
            return {}
        positions = self.world.crs_from_world(np.array([pose.translation for pose in poses.values()]))
        return dict(zip(poses, self.world.crs_axes_from_world(positions), strict=True))


def plan_section(placed: Placed, check: Mapping[str, Array], control: Mapping[str, Array]) -> dict[str, Any]:
    """Positions (metres, to 0.1 mm), viewing directions and residuals (by point id, world axes) as JSON values.

    They are in the CRS where its coordinates are metric and plane, else in the topocentric world frame; `frame` says
    which. Only the reference images nearest to the new ones are listed.
    """
    in_crs = placed.world.describe()["kind"] in _METRIC_KINDS
    frame = _CrsPlan(placed.world) if in_crs else _WorldPlan()
    new = [pose.translation for pose in placed.new.values()]
    given = [pose.translation for pose in placed.reference.values()]
    near = nearest(np.array(given).reshape(-1, 3), np.array(new).reshape(-1, 3), MAX_REFERENCE)
    names = list(placed.reference)
    return {
        "frame": "crs" if in_crs else "world",
        "new": _stations(placed.new, frame),
        "reference": _stations({names[i]: placed.reference[names[i]] for i in near}, frame),
        "reference_total": len(names),
        "check": _points(placed.check, check, frame),
        "control": _points(placed.control, control, frame),
    }


def placed_in_plan(placed: Placed, places: Sequence[Sequence[float]]) -> list[list[float]]:
    """Places in world (N, 3) in the frame of the plan."""
    if not len(places):
        return []
    in_crs = placed.world.describe()["kind"] in _METRIC_KINDS
    frame = _CrsPlan(placed.world) if in_crs else _WorldPlan()
    return [_round(position) for position in frame.positions(np.array(places, dtype=np.float64))]


def nearest(positions: Array, targets: Array, limit: int) -> NDArray[np.int64]:
    """Indices of at most `limit` of the positions (N, 3), those nearest to any target (M, 3), in their order."""
    if len(positions) <= limit:
        return np.arange(len(positions))
    if not len(targets):
        return np.linspace(0, len(positions) - 1, limit).astype(np.int64)
    distance, _ = KDTree(targets).query(positions)
    return np.sort(np.argsort(distance, kind="stable")[:limit])


class _WorldPlan:
    """The world frame as it is."""

    def positions(self, points: Array) -> Array:
        return points

    def axes(self, points: Array) -> Array:
        """Rotations (N, 3, 3) from world axes to those of the plan."""
        return np.tile(np.eye(3), (len(points), 1, 1))


class _CrsPlan:
    """The coordinates and axes of the CRS."""

    def __init__(self, world: WorldFrame) -> None:
        self._world = world

    def positions(self, points: Array) -> Array:
        return self._world.crs_from_world(points)

    def axes(self, points: Array) -> Array:
        """Rotations (N, 3, 3) from world axes to those of the plan."""
        return self._world.crs_axes_from_world(self.positions(points))


def _stations(poses: Mapping[str, Rigid3], frame: _WorldPlan | _CrsPlan) -> list[dict[str, Any]]:
    if not poses:
        return []
    centres = np.array([pose.translation for pose in poses.values()])
    views = np.array([pose.rotation[:, 2] for pose in poses.values()])
    turned = np.einsum("nij,nj->ni", frame.axes(centres), views)
    rows = zip(poses, frame.positions(centres), turned, strict=True)
    return [{"image": name, "position_m": _round(p), "direction": _round(d)} for name, p, d in rows]


def _points(
    points: Sequence[CheckPoint] | Sequence[ControlPoint], residuals: Mapping[str, Array], frame: _WorldPlan | _CrsPlan
) -> list[dict[str, Any]]:
    if not points:
        return []
    given = np.array([point.point_in_world for point in points])
    out = []
    for point, position, turn in zip(points, frame.positions(given), frame.axes(given), strict=True):
        residual = residuals.get(point.point_id)
        row: dict[str, Any] = {"point_id": point.point_id, "position_m": _round(position)}
        if isinstance(point, CheckPoint):
            row["kind"] = str(point.kind)
        row["residual_m"] = None if residual is None else _round(turn @ residual, 6)
        out.append(row)
    return out


def _round(values: Iterable[float], digits: int = 4) -> list[float]:
    return [round(float(value), digits) for value in values]
