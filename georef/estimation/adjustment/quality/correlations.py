"""Unknowns that the observations of a block hardly tell apart: shared ones among themselves and with its stations.

A focal length trades off with the distance to the scene and so with height, the boresight of a camera with the attitude
of all stations, a lever arm with their position. What all stations do together is the mean of their steps, along world
axes and along those of the rig; its correlation with a shared unknown is exact, by one solve for each.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from georef.estimation.adjustment.block import Block, State
from georef.estimation.adjustment.equations.cofactors import Cofactors
from georef.estimation.adjustment.equations.reduced import Layout
from georef.geometry.rigid import Array

STRONG = 0.9
_WORLD, _RIG = ("east", "north", "up"), ("x", "y", "z")


@dataclass(frozen=True)
class SharedUnknown:
    """An unknown of several stations: its value and 1-sigma in its own unit (px, m, deg, or none)."""

    name: str
    value: float
    sigma: float
    unit: str


@dataclass(frozen=True)
class Correlation:
    first: str
    second: str
    value: float


@dataclass(frozen=True)
class _Entry:
    """place: in the border; per_step: what a step of the unknown changes the value by."""

    place: int
    name: str
    value: float
    per_step: float
    unit: str


def shared_unknowns(block: Block, state: State, found: Cofactors) -> list[SharedUnknown]:
    """Mountings, calibrations, lever arms and GNSS offsets that are estimated."""
    sigma = np.sqrt(np.diag(found.border))
    return [
        SharedUnknown(e.name, e.value, float(sigma[e.place] * e.per_step), e.unit)
        for e in _entries(block, state, found)
    ]


def strong_correlations(block: Block, state: State, found: Cofactors, least: float = STRONG) -> list[Correlation]:
    """Pairs of shared unknowns, and of them with what all stations do together, that correlate by `least` or more."""
    entries = list(_entries(block, state, found))
    if not entries:
        return []
    rows = [e.place for e in entries]
    cov = found.border[np.ix_(rows, rows)]
    sigma = np.sqrt(np.diag(cov))
    among = cov / np.outer(sigma, sigma)
    pairs = [
        Correlation(entries[i].name, entries[j].name, float(among[i, j]))
        for i in range(len(entries))
        for j in range(i + 1, len(entries))
        if abs(among[i, j]) >= least
    ]
    means = _means(block, state, found.layout)
    vectors = np.column_stack(list(means.values()))
    solved = found.apply(vectors)
    variance = np.einsum("um,um->m", vectors, solved)
    with_means = solved[6 * found.layout.stations :][rows] / sigma[:, None] / np.sqrt(variance)
    pairs += [
        Correlation(entry.name, name, float(with_means[i, k]))
        for i, entry in enumerate(entries)
        for k, name in enumerate(means)
        if abs(with_means[i, k]) >= least
    ]
    return sorted(pairs, key=lambda pair: -abs(pair.value))


def _means(block: Block, state: State, layout: Layout) -> dict[str, Array]:
    """Means of the steps of all stations, (6 S + B,) each: position along world and rig axes, attitude about the axes
    of cameras whose mountings are estimated; of the images of estimated cameras, distance along the optical axis and
    attitude."""
    count = len(block.station_ids)
    rotation = state.world_from_rig.rotation
    out: dict[str, Array] = {}

    def mean(name: str, columns: slice, weights: Array) -> None:
        out[name] = np.zeros(layout.size)
        out[name][: 6 * count].reshape(count, 6)[:, columns] = weights / count

    for axis, label in enumerate(_WORLD):
        mean(f"mean position of the stations {label}", slice(3, 6), rotation[:, axis])
    for index, mounting in enumerate(block.mountings):
        for axis, label in enumerate(_RIG if mounting.information is not None else ()):
            turned = state.rig_from_cam[index].rotation[:, axis]
            mean(f"mean attitude of the stations about {mounting.name} {label}", slice(0, 3), turned)
    for axis, label in enumerate(_RIG):
        mean(f"mean position of the stations along rig {label}", slice(3, 6), np.eye(3)[axis])
    for index, calibration in enumerate(block.calibrations):
        camera = calibration.camera
        if "focal" in camera.estimate:
            out[f"distance of {camera.camera_id} to its scene"] = _backwards(block, state, layout, index)
        for name, axis, turn in (("cx", 1, "roll"), ("cy", 0, "pitch")):
            if name in camera.estimate:
                out[f"mean {turn} of the images of {camera.camera_id}"] = _turned(block, state, layout, index, axis)
    return out


def _turned(block: Block, state: State, layout: Layout, calibration: int, axis: int) -> Array:
    """The mean turn (6 S + B,) of the images of a camera about an axis of it, that of their mountings included."""
    images = np.flatnonzero(block.calibration == calibration)
    mounting, out, edge = block.mounting[images], np.zeros(layout.size), 6 * layout.stations
    rows = out[:edge].reshape(-1, 6)
    np.add.at(rows[:, :3], block.station[images], state.rig_from_cam.rotation[mounting][:, :, axis] / len(images))
    at = layout.mounting[mounting]
    np.add.at(out, edge + at[at >= 0] + axis, 1.0 / len(images))
    return out


def _backwards(block: Block, state: State, layout: Layout, calibration: int) -> Array:
    """The mean step of the images of a camera against their optical axes, by their stations (6 S + B,)."""
    images = np.flatnonzero(block.calibration == calibration)
    out = np.zeros(layout.size)
    rows = out[: 6 * layout.stations].reshape(-1, 6)
    mountings = state.rig_from_cam.take(block.mounting[images])
    axis = mountings.rotation[:, :, 2]  # in the rig
    np.add.at(rows[:, 3:], block.station[images], -axis / len(images))
    np.add.at(rows[:, :3], block.station[images], -np.cross(mountings.translation, axis) / len(images))
    return out


def _entries(block: Block, state: State, found: Cofactors) -> Iterator[_Entry]:
    layout = found.layout
    degree = float(np.degrees(1.0))
    for index, at in enumerate(layout.mounting.tolist()):
        if at >= 0:
            given, now = block.mountings[index], state.rig_from_cam[index]
            step = given.rig_from_cam.local(now)
            for k, axis in enumerate(_RIG):
                name = f"boresight of {given.name} about camera {axis}"
                yield _Entry(at + k, name, degree * float(step[k]), degree, "deg")
            for k, axis in enumerate(_RIG):
                name = f"mounting of {given.name} along camera {axis}"
                yield _Entry(at + 3 + k, name, float(step[3 + k]), 1.0, "m")
    for at, camera in zip(layout.calibration.tolist(), state.cameras, strict=True):
        for k, name in enumerate(camera.estimate if at >= 0 else ()):
            unit = "px" if name in ("focal", "cx", "cy") else ""
            yield _Entry(at + k, f"{name} of {camera.camera_id}", camera.value(name), camera.unit(name), unit)
    for at, antenna, arm in zip(layout.antenna.tolist(), block.antennas, state.lever_arms_m, strict=True):
        for k, axis in enumerate(_RIG if at >= 0 else ()):
            yield _Entry(at + k, f"lever arm of {antenna.name} {axis}", float(arm[k]), 1.0, "m")
    nodes = layout.drift.tolist()
    for node, (at, drift) in enumerate(zip(nodes, state.drift_m, strict=True)):
        for k, axis in enumerate(_WORLD):
            which = "GNSS offset" if len(nodes) == 1 else f"GNSS drift {node + 1}"
            yield _Entry(at + k, f"{which} {axis}", float(drift[k]), 1.0, "m")
