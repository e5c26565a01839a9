"""Compiled lenses against those of georef.geometry: images, derivatives by point and unknowns."""

from __future__ import annotations

import numpy as np
import pytest

from georef.estimation.adjustment.equations.prepared import code_of, counting_order
from georef.estimation.adjustment.kernels.observations import by_unknown, lens
from georef.estimation.adjustment.kernels.points import loss, root_weight
from georef.geometry.camera import Camera, intrinsic_derivatives, project
from georef.geometry.projection import MODEL_NAMES
from georef.geometry.rigid import Array

_CAMERAS = [
    Camera("pinhole", 6000, 4000, 2000.0, 2010.0, 3010.0, 1990.0),
    Camera("brown", 6000, 4000, 2000.0, 2010.0, 3010.0, 1990.0, (-0.2, 0.05, 2e-3, -1e-3, 0.02)),
    Camera("folding", 6000, 4000, 2000.0, 2010.0, 3010.0, 1990.0, (-0.4, 0.0, 1e-3, 1e-3)),
    Camera("fisheye", 6000, 6000, 1200.0, 1190.0, 3010.0, 2990.0, (0.01, -2e-3, 3e-4, -1e-4), "fisheye"),
    Camera(
        "rational",
        6000,
        4000,
        2000.0,
        2010.0,
        3010.0,
        1990.0,
        (0.2, -0.05, 2e-3, -1e-3, 0.01, 0.3, -0.02, 0.01),
        "rational",
    ),
]
_ALL = ("focal", "aspect", "cx", "cy")


def _points() -> Array:
    """Points in all directions, some on the axis before and behind the camera."""
    points = np.random.default_rng(0).normal(size=(400, 3)) * [2.0, 2.0, 1.0]
    points[:3] = [[0.0, 0.0, 2.0], [1e-12, 0.0, 3.0], [0.0, 0.0, -2.0]]
    return points


@pytest.mark.parametrize("camera", _CAMERAS, ids=lambda c: c.camera_id)
def test_lens_is_that_of_geometry(camera: Camera) -> None:
    points, model, parameters = _points(), MODEL_NAMES.index(camera.model), camera.parameters[None]
    found = [lens(model, parameters, 0, *p) for p in points]
    shown, out = np.array([row[0] for row in found]), np.array([row[1:] for row in found])
    image, by_point, _ = camera.lens.derivatives(points, camera.coefficients, np.asarray(camera.limit))
    assert np.array_equal(shown, np.isfinite(project(camera, points)).all(axis=1))
    assert 10 < shown.sum() < len(points)
    assert np.allclose(out[shown, :2], image[shown], rtol=1e-12, atol=1e-12)
    assert np.allclose(out[shown, 2:].reshape(-1, 2, 3), by_point[shown], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("camera", _CAMERAS, ids=lambda c: c.camera_id)
def test_derivatives_by_unknowns_are_those_of_geometry(camera: Camera) -> None:
    names = (*_ALL, *camera.lens.parameters)
    points = _points()
    points = points[np.isfinite(project(camera, points)).all(axis=1)]
    expected = intrinsic_derivatives(camera, points, names)
    image = (project(camera, points) - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    model, parameters = MODEL_NAMES.index(camera.model), camera.parameters[None]
    for j, name in enumerate(names):
        found = [
            by_unknown(code_of(camera, name), model, parameters, 0, *p, *m) for p, m in zip(points, image, strict=True)
        ]
        assert np.allclose(found, expected[:, :, j], rtol=1e-9, atol=1e-9), name


def test_loss_and_its_weight_belong_together() -> None:
    """The weight is twice the derivative of the cost by the squared residual."""
    for square in (0.01, 1.0, 30.0):
        rate = (loss(square + 1e-6, 2.0) - loss(square - 1e-6, 2.0)) / 2e-6
        assert root_weight(square, 2.0) ** 2 == pytest.approx(2.0 * rate, rel=1e-6)
        assert (loss(square, 0.0), root_weight(square, 0.0)) == (0.5 * square, 1.0)


def test_counting_order_is_stable() -> None:
    key = np.random.default_rng(0).integers(0, 7, 100)
    assert np.array_equal(counting_order(key, 7), np.argsort(key, kind="stable"))
