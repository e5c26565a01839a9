"""Headings of images that look down."""

from __future__ import annotations

import numpy as np

from georef.estimation.vertical_start import vertical_start
from georef.geometry.camera import Camera, project
from georef.geometry.poses import Poses, log_so3s
from georef.types.scene import Observations
from tests.worlds.aerial import Flight, flight

_NOMINAL = Camera("n", 4000, 3000, 4000.0, 4000.0, 2000.0, 1500.0)


def _observed(made: Flight, rng: np.random.Generator, *, wrong: float = 0.0) -> Observations:
    point, view, pixel = [], [], []
    for k, pose in enumerate(made.world_from_cam.to_list()):
        px = project(_NOMINAL, pose.inverse().apply(made.points))
        seen = np.flatnonzero(((px > 0) & (px < [4000, 3000])).all(axis=1))
        blunder = rng.random(len(seen)) < wrong
        px[seen[blunder]] = rng.uniform(0, 3000, (int(blunder.sum()), 2))
        point.append(seen)
        view.append(np.full(len(seen), k))
        pixel.append(px[seen])
    count = sum(map(len, point))
    joined = [np.concatenate(parts) for parts in (point, view, pixel)]
    return Observations(joined[0], joined[1], joined[2], np.ones(count), np.full(count, -1))


def _off_deg(made: Flight, found: Poses) -> np.ndarray:
    turned = np.swapaxes(found.rotation, 1, 2) @ made.world_from_cam.rotation
    return np.degrees(np.linalg.norm(log_so3s(turned), axis=1))


def test_rotations_are_found_but_for_the_tilt() -> None:
    made, rng = flight(), np.random.default_rng(0)
    start = vertical_start(made.world_from_cam.translation, [_NOMINAL] * 28, _observed(made, rng))
    off = _off_deg(made, start.world_from_cam)
    assert 1.0 < np.median(off) < 5.0  # the tilt itself is two degrees about each axis
    assert off.max() < 12.0
    assert start.misfit.max() < 0.1


def test_blunders_do_little() -> None:
    made, rng = flight(), np.random.default_rng(0)
    start = vertical_start(made.world_from_cam.translation, [_NOMINAL] * 28, _observed(made, rng, wrong=0.1))
    assert _off_deg(made, start.world_from_cam).max() < 15.0


def test_points_that_are_not_the_same_do_not_fit_a_map() -> None:
    made, rng = flight(), np.random.default_rng(0)
    observed = _observed(made, rng)
    mixed = observed.with_points(np.where(observed.view == 3, observed.point[::-1], observed.point))
    once = np.unique(mixed.view * 1000 + mixed.point, return_index=True)[1]
    start = vertical_start(made.world_from_cam.translation, [_NOMINAL] * 28, mixed.take(once))
    assert start.misfit[3] > 0.1
    assert np.median(start.misfit) < 0.1


def test_an_image_without_common_points_has_no_heading() -> None:
    made, rng = flight(), np.random.default_rng(0)
    observed = _observed(made, rng)
    start = vertical_start(made.world_from_cam.translation, [_NOMINAL] * 28, observed.take(observed.view != 3))
    assert np.isnan(start.misfit[3])
    assert np.isfinite(np.delete(start.misfit, 3)).all()
