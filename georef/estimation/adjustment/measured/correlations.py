"""Shared unknowns of a solution with their sigmas, and which of them the observations can hardly tell apart."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from georef.estimation.adjustment.block import Block, Indices, State
from georef.estimation.adjustment.equations.reduced import Layout
from georef.estimation.adjustment.measured.check import BlockCheck
from georef.estimation.adjustment.measured.solutions import Solved
from georef.geometry.rigid import Array

STRONG = 0.9
_DEG = float(np.degrees(1.0))
_EAST_NORTH_UP = ("east", "north", "up")


@dataclass(frozen=True)
class SharedUnknown:
    """An unknown of the border: its value and 1-sigma in its own unit (px, m, rad, or none)."""

    name: str
    value: float
    sigma: float
    unit: str


@dataclass(frozen=True)
class Correlation:
    first: str
    second: str
    value: float


def shared_unknowns(solved: Solved) -> list[SharedUnknown]:
    """Calibrations, lever arms and GNSS offsets that are estimated."""
    sigmas = np.sqrt(np.diag(solved.cofactors.border))
    return [
        SharedUnknown(name, value, float(sigmas[at]) * per_step, unit)
        for at, name, value, per_step, unit in _entries(solved)
    ]


def strong_correlations(solved: Solved, least: float = STRONG) -> list[Correlation]:
    """Pairs of shared unknowns, and focal lengths with the height of the ground, that correlate strongly."""
    entries = list(_entries(solved))
    rows = [at for at, *_ in entries]
    names = [name for _, name, *_ in entries]
    cov = solved.cofactors.border[np.ix_(rows, rows)]
    sigma = np.sqrt(np.diag(cov))
    values = cov / np.outer(sigma, sigma) if rows else cov
    pairs = [
        Correlation(names[i], names[j], float(values[i, j]))
        for i in range(len(names))
        for j in range(i + 1, len(names))
        if abs(values[i, j]) >= least
    ]
    height = ground_height_correlations(solved.block, solved.check, solved.cofactors.border)
    return pairs + [c for c in (*height, *_with_poses(solved)) if abs(c.value) >= least]


def _with_poses(solved: Solved) -> list[Correlation]:
    """Of focal lengths with the mean height of the stations, of principal points with the mean attitude about the axes
    of their own camera, of lever arms with the mean position of the stations along the rig's axes.

    What each trades off with where the block is seen from one height, one heading, or without much tilt.
    """
    block, state, layout = solved.block, solved.solution.state, solved.cofactors.layout
    rotation, edge = state.world_from_rig.rotation, 6 * layout.stations
    pairs: list[tuple[int, str, Array, str]] = []
    for at, camera, index in zip(layout.calibration, state.cameras, range(len(state.cameras)), strict=True):
        for k, name in enumerate(camera.estimate if at >= 0 else ()):
            images = np.flatnonzero(block.calibration == index)
            if name == "focal":
                pairs.append(
                    (int(at) + k, f"{camera.camera_id} focal", _mean_height(rotation), "mean height of the stations")
                )
            elif name in ("cx", "cy"):
                axis, word = (1, "roll") if name == "cx" else (0, "pitch")
                attitude = _mean_turn(block, state, images, axis)
                pairs.append((int(at) + k, f"{camera.camera_id} {name}", attitude, f"mean {word} of its images"))
    for at, antenna in zip(layout.antenna, block.antennas, strict=True):
        for axis in range(3 if at >= 0 else 0):
            along = np.zeros((layout.stations, 6))
            along[:, 3 + axis] = 1.0 / layout.stations
            what = f"mean position of the stations along {'xyz'[axis]} of the rig"
            pairs.append((int(at) + axis, f"{antenna.name} lever arm {'xyz'[axis]}", along.ravel(), what))
    if not pairs:
        return []
    by = np.zeros((layout.size, len(pairs)))
    for i, (_, _, row, _) in enumerate(pairs):
        by[: len(row), i] = row
    applied = solved.cofactors.apply(by)
    variance = np.einsum("ui,ui->i", by, applied)
    border = solved.cofactors.border
    return [
        Correlation(name, what, float(applied[edge + at, i] / np.sqrt(variance[i] * border[at, at])))
        for i, (at, name, _, what) in enumerate(pairs)
    ]


def _mean_height(rotation: Array) -> Array:
    """Derivative (6 S,) of the mean height of stations."""
    row = np.zeros((len(rotation), 6))
    row[:, 3:] = rotation[:, 2] / len(rotation)
    return row.ravel()


def _mean_turn(block: Block, state: State, images: Indices, axis: int) -> Array:
    """Derivative (6 S + B,) of the mean turn of some images about an axis of their camera, mountings included."""
    layout = Layout.of(block)
    out = np.zeros(layout.size)
    for image in images:
        mounting = int(block.mounting[image])
        at = 6 * int(block.station[image])
        cam_from_rig = state.rig_from_cam[mounting].rotation.T
        out[at : at + 3] += cam_from_rig[axis] / len(images)
        if layout.mounting[mounting] >= 0:
            out[6 * layout.stations + int(layout.mounting[mounting]) + axis] += 1.0 / len(images)
    return out


def ground_height_correlations(block: Block, check: BlockCheck, border: Array) -> list[Correlation]:
    """How the mean height of the points that were intersected moves with each estimated focal length.

    At one flying height over flat ground the two trade off: a longer focal length and a lower ground look the same.
    """
    points = check.solved.shape[1] // 3
    if not points:
        return []
    up = np.zeros(3 * points)
    up[2::3] = 1.0 / points
    variance = float(up @ (check.by_unknowns @ check.solved) @ up)
    edge = check.solved.shape[0] - len(border)
    out = []
    for at, name in _focal_lengths(block):
        covariance = float(check.solved[edge + at] @ up)
        out.append(Correlation(name, "mean height of the ground", covariance / np.sqrt(variance * border[at, at])))
    return out


def _focal_lengths(block: Block) -> list[tuple[int, str]]:
    layout = Layout.of(block)
    return [
        (int(at) + c.camera.estimate.index("focal"), f"{c.camera.camera_id} focal")
        for at, c in zip(layout.calibration, block.calibrations, strict=True)
        if at >= 0 and "focal" in c.camera.estimate
    ]


def _entries(solved: Solved) -> list[tuple[int, str, float, float, str]]:
    """Place in the border, name, value, what a step changes the value by, unit; kept points left out. Mountings are
    told by what they differ by from the given ones, in their own axes: arc minutes would hide in degrees, so mdeg."""
    block, layout, state = solved.block, solved.cofactors.layout, solved.solution.state
    out: list[tuple[int, str, float, float, str]] = []
    for at, camera in zip(layout.calibration, state.cameras, strict=True):
        for k, name in enumerate(camera.estimate if at >= 0 else ()):
            unit = "px" if name in ("focal", "cx", "cy") else ""
            out.append((int(at) + k, f"{camera.camera_id} {name}", camera.value(name), camera.unit(name), unit))
    for at, given, found in zip(layout.mounting, block.mountings, state.rig_from_cam.to_list(), strict=True):
        if at >= 0:
            change = given.rig_from_cam.local(found)
            for k, axis in enumerate("xyz"):
                out.append(
                    (int(at) + k, f"mounting {given.name} turn {axis}", float(np.degrees(change[k])), _DEG, "deg")
                )
            for k, axis in enumerate("xyz"):
                out.append((int(at) + 3 + k, f"mounting {given.name} shift {axis}", float(change[3 + k]), 1.0, "m"))
    names = [f"{a.name} lever arm" for a in block.antennas]
    groups = (
        (names, layout.antenna, state.lever_arms_m, ("x", "y", "z")),
        (drift_names(len(state.drift_m)), layout.drift, state.drift_m, _EAST_NORTH_UP),
    )
    for titles, starts, values, axes in groups:
        for what, at, row in zip(titles, starts, values, strict=True):
            if at >= 0:
                out += [(int(at) + k, f"{what} {axis}", float(row[k]), 1.0, "m") for k, axis in enumerate(axes)]
    return out


def drift_names(count: int) -> list[str]:
    """One offset needs no number."""
    return ["GNSS offset"] if count == 1 else [f"GNSS drift {k + 1}" for k in range(count)]
