"""Geometry that fixes a pose badly is named for what it is; good geometry is not."""

from __future__ import annotations

import numpy as np
import pytest

from georef.estimation.local_model import LocalModel
from georef.estimation.pnp import refine_pose
from georef.estimation.reference_errors import ReferenceErrors
from georef.estimation.weak_geometry import arrangement, weak_geometry, weakness
from georef.geometry.camera import project
from georef.geometry.rigid import Array
from tests.unit.test_pnp import Run
from tests.worlds.points import CAMERA, NOISE, court, scaled_noise

RUN = Run(court(1, points=400), np.random.default_rng(1), scaled_noise(NOISE, poses=1e-6))


def judged(model: LocalModel) -> str:
    estimate = refine_pose(RUN.start, RUN.query, model, ReferenceErrors.independent(np.zeros((6, 6, 6))))
    assert estimate is not None
    return weak_geometry(estimate.relative_cov, RUN.query, model.take(estimate.inliers))


def part(low: tuple[float, float], high: tuple[float, float]) -> LocalModel:
    """The points that the query sees in a part of its image, from shares of its width and height."""
    share = RUN.query.pixels[RUN.model.keypoint] / [CAMERA.width, CAMERA.height]
    return RUN.model.take(np.asarray(((share >= low) & (share <= high)).all(axis=1)))


def test_points_all_over_the_image_are_not_weak() -> None:
    assert judged(RUN.model) == ""


def test_points_in_a_corner_are_weak_and_the_corner_is_named() -> None:
    text = judged(part((0.05, 0.3), (0.28, 0.75)))
    assert text.startswith("weak geometry: position ")
    assert " times what it would be were the rotation known; 90 % of " in text
    assert "of the image's width (left part)" in text
    assert "deg of their middle" in text
    assert "upper" not in text


def weak_cov(kind: str) -> Array:
    """The covariance of a pose from points that are seen within 4 deg, on a plane or in depth."""
    rng = np.random.default_rng(2)
    across = rng.uniform(-4.0, 4.0, (200, 2))
    depth = np.full(200, 60.0) if kind == "plane" else rng.uniform(8.0, 60.0, 200)
    points = np.column_stack([across * depth[:, None] / 60.0, depth])
    rows = []
    for axis in range(6):
        step = 1e-6 * np.eye(6)[axis]
        moved = points - np.cross(step[:3], points) - step[3:]
        rows.append(((project(CAMERA, moved) - project(CAMERA, points)) / 1e-6).ravel())
    design = np.array(rows).T
    return np.linalg.inv(design.T @ design) * 0.4**2


def test_the_weak_direction_and_its_measure_are_those_of_the_normal_equations() -> None:
    cov = weak_cov("plane")
    plane, deep = weakness(cov), weakness(weak_cov("depth"))
    information = np.linalg.inv(cov)
    direction = np.array(plane.direction_in_cam)
    alone = 1.0 / (direction @ information[3:, 3:] @ direction)
    assert plane.magnified == pytest.approx(plane.sigma_m / np.sqrt(alone), rel=1e-6)
    assert abs(direction[2]) < 0.2  # depth shows in the scale; shifts across the view look like turns
    assert plane.magnified > 5.0 * deep.magnified
    assert plane.magnified > 20.0 > deep.magnified


def test_planes_lines_and_single_places_are_told_apart() -> None:
    model, count = RUN.model, len(RUN.model)
    rng = np.random.default_rng(3)
    u, v = rng.uniform(-5.0, 5.0, (2, count))

    def with_points(points: Array) -> list[str]:
        return arrangement(RUN.query, LocalModel(model.keypoint, points, model.cov, model.views, model.observations))

    ahead = np.array([0.0, 14.0, 3.0])
    flat = with_points(ahead + np.column_stack([u, 0.2 * u, v]))
    assert any(text.startswith("all on one plane, 1") for text in flat)
    assert "all on one line" in with_points(ahead + np.column_stack([u, 0.2 * u, 0.1 * u]))
    assert "all in one place" in with_points(np.repeat(ahead[None], count, axis=0))
    assert not any("all on" in text for text in arrangement(RUN.query, model))
