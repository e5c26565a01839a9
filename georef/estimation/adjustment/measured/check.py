"""Surveyed points against an adjusted block: intersected from its images, with what was predicted of the differences.

The points take no part in the adjustment. Stations, mountings and calibrations err together, and their errors move all
intersected points: the covariance of the differences is G Q G' plus the noise of the marks and the points' own, with Q
the inverse of the reduced normal matrix and G the derivative of the intersected points by its unknowns.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import cast

import numpy as np

from georef.estimation.adjustment.block import Block, State
from georef.estimation.adjustment.equations.reduced import Layout
from georef.evaluation.check_points import CheckPointErrors, NotDetermined, point_error
from georef.evaluation.forward_intersection import Intersection, PosedImages, intersect
from georef.geometry.camera import intrinsic_derivatives
from georef.geometry.covariance import symmetric
from georef.geometry.rigid import Array
from georef.types.constraints import CheckPoint

Solve = Callable[[Array], Array]
"""The inverse of the reduced normal matrix times vectors (6 S + B, m)."""


@dataclass(frozen=True, eq=False)
class BlockCheck:
    """Differences of P points, and how they depend on the unknowns of the block."""

    errors: CheckPointErrors
    by_unknowns: Array  # (3 P, 6 S + B) G, of the points that are determined
    solved: Array  # (6 S + B, 3 P) Q G'


@dataclass(frozen=True, eq=False)
class Offset:
    """One translation between the block and surveyed points: that of their differences, with its covariance."""

    offset_m: Array  # (3,) block minus surveyed points, east, north, up
    cov: Array  # (3, 3)
    statistic: float  # offset' cov^-1 offset: chi-square with 3 degrees of freedom where there is none
    left_over: float  # the same of the differences without the offset, over its degrees of freedom

    @property
    def sigma_m(self) -> Array:
        return np.sqrt(np.diag(self.cov))


def check_block(
    block: Block, state: State, solve: Solve, points: Sequence[CheckPoint], *, variance_factor: float = 1.0
) -> BlockCheck:
    """Intersects points from the images of an adjusted block. variance_factor scales the covariance of the block and
    of the marks, as the image observations have shown; not that of the points."""
    world_from_cam = block.world_from_cam(state)
    cameras = tuple(state.cameras[c] for c in block.calibration)
    images = PosedImages(block.image_ids, cameras, tuple(world_from_cam.to_list()))
    found = [intersect(point, images) for point in points]
    pairs = [(p, entry) for p, entry in zip(points, found, strict=True) if isinstance(entry, Intersection)]
    layout = Layout.of(block)
    by_unknowns = np.vstack(
        [np.zeros((0, layout.size)), *(_derivative(block, state, images, layout, *p) for p in pairs)]
    )
    solved = solve(by_unknowns.T) if pairs else np.zeros((layout.size, 0))
    joint = variance_factor * symmetric(by_unknowns @ solved)
    for i, (point, entry) in enumerate(pairs):
        joint[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] += variance_factor * entry.mark_cov + point.cov
    missing = [
        NotDetermined(p.point_id, p.kind, sum(mark.image_id in images.index for mark in p.marks), entry)
        for p, entry in zip(points, found, strict=True)
        if isinstance(entry, str)
    ]
    errors = [
        point_error(point, entry, joint[3 * i : 3 * i + 3, 3 * i : 3 * i + 3]) for i, (point, entry) in enumerate(pairs)
    ]
    return BlockCheck(CheckPointErrors(tuple(errors), tuple(missing), joint), by_unknowns, solved)


def common_offset(check: BlockCheck) -> Offset | None:
    """The translation that all differences share, weighted by their joint covariance; None without points."""
    errors, joint = check.errors.determined, check.errors.joint_cov
    if not errors or joint is None:
        return None
    differences = np.concatenate([error.difference_m for error in errors])
    shared = np.tile(np.eye(3), (len(errors), 1))
    weight = np.linalg.inv(joint)
    cov = cast(Array, np.linalg.inv(shared.T @ weight @ shared))
    offset = cov @ shared.T @ weight @ differences
    rest = differences - shared @ offset
    dof = max(3 * len(errors) - 3, 1)
    return Offset(offset, cov, float(offset @ np.linalg.solve(cov, offset)), float(rest @ weight @ rest) / dof)


def with_points_as_control(check: BlockCheck, control: Sequence[int]) -> CheckPointErrors:
    """What the differences of the other points become where those of some (by index among the determined) are used.

    The block follows surveyed points as far as its own covariance lets it: with differences d and their joint
    covariance C, d_x - C_xc C_cc^-1 d_c and C_xx - C_xc C_cc^-1 C_cx. To first order this is the adjustment with these
    points as control, whose marks and coordinates are in C_cc; corrections of centimetres are small enough for it.
    """
    errors, joint = check.errors.determined, check.errors.joint_cov
    assert joint is not None, "a block that was checked knows its covariance"
    others = [i for i in range(len(errors)) if i not in set(control)]
    rows, used = (
        np.array([3 * i + k for i in chosen for k in range(3)], dtype=np.int64) for chosen in (others, control)
    )
    differences = np.concatenate([error.difference_m for error in errors])
    gain = np.linalg.solve(joint[np.ix_(used, used)], joint[np.ix_(used, rows)]).T
    left = differences[rows] - gain @ differences[used]
    cov = symmetric(joint[np.ix_(rows, rows)] - gain @ joint[np.ix_(used, rows)])
    changed = [
        replace(
            errors[i], difference_m=left[3 * k : 3 * k + 3], predicted_cov=cov[3 * k : 3 * k + 3, 3 * k : 3 * k + 3]
        )
        for k, i in enumerate(others)
    ]
    return CheckPointErrors(tuple(changed), check.errors.not_determined, cov)


def _derivative(
    block: Block, state: State, images: PosedImages, layout: Layout, point: CheckPoint, found: Intersection
) -> Array:
    """Derivative (3, 6 S + B) of an intersected point by the unknowns of the block."""
    out, by_image = np.zeros((3, layout.size)), found.point_by_poses
    edge = 6 * layout.stations
    for k, image in enumerate(found.images):
        by_pose, mounting = by_image[:, 6 * k : 6 * k + 6], block.mounting[image]
        at = 6 * block.station[image]
        out[:, at : at + 6] += by_pose @ state.rig_from_cam[int(mounting)].inverse().adjoint()
        if layout.mounting[mounting] >= 0:
            at = edge + layout.mounting[mounting]
            out[:, at : at + 6] += by_pose
    by_marks = -found.mark_cov @ found.by_point.T
    marks = [mark for mark in point.marks if mark.image_id in images.index]
    for row, mark in enumerate(marks):
        image = images.index[mark.image_id]
        first = layout.calibration[block.calibration[image]]
        names = block.calibrations[block.calibration[image]].camera.estimate
        if first < 0:
            continue
        in_cam = images.world_from_cams[image].inverse().apply(found.point[None])
        by_camera = intrinsic_derivatives(images.cameras[image], in_cam, names)[0] / mark.sigma_px
        out[:, edge + first : edge + first + len(names)] += by_marks[:, 2 * row : 2 * row + 2] @ by_camera
    return out
