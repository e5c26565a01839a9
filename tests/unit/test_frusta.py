"""Overlap of viewing frusta: what it is for cameras of known geometry."""

from __future__ import annotations

import numpy as np
import pytest

from georef.geometry.camera import Camera
from georef.geometry.frusta import Frusta
from georef.geometry.rigid import Rigid3, exp_so3

CAMERA = Camera("c", 1000, 800, 700.0, 700.0, 500.0, 400.0)
REACH_M = 30.0


def posed(turn_deg: float = 0.0, position: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Rigid3:
    """Turned about the vertical image axis."""
    return Rigid3(exp_so3(np.array([0.0, np.radians(turn_deg), 0.0])), np.array(position))


def shared(*poses: Rigid3, index: int = 0) -> np.ndarray:
    frusta = Frusta.of(poses, [CAMERA] * len(poses), REACH_M)
    return frusta.shared(index, frusta, np.arange(len(poses)))


def test_an_image_shares_all_with_itself() -> None:
    assert shared(posed())[0] == pytest.approx(1.0)


@pytest.mark.parametrize(
    "other", [posed(180.0), posed(90.0), posed(0.0, (0.0, 0.0, 31.0)), posed(0.0, (80.0, 0.0, 0.0))]
)
def test_images_that_look_elsewhere_share_nothing(other: Rigid3) -> None:
    """Turned away, at a right angle (the view is 71 deg wide), beyond the reach, far aside."""
    assert shared(posed(), other)[1] == 0.0


def test_images_that_face_each_other_do_not_see_the_same_side() -> None:
    assert shared(posed(), posed(180.0, (0.0, 0.0, 20.0)))[1] == 0.0


def test_it_falls_with_the_turn_as_the_field_of_view_does() -> None:
    turns = np.array([0.0, 15.0, 30.0, 45.0, 60.0])
    values = shared(*(posed(turn) for turn in turns))
    assert (np.diff(values) < 0).all()
    slopes = np.tan(np.radians(35.5 - turns[1:3]))  # where the edge of one image lies in the other
    assert values[1:3] == pytest.approx((1.0 + slopes / np.tan(np.radians(35.5))) / 2.0, abs=0.12)


def test_it_is_the_same_both_ways() -> None:
    poses = [posed(), posed(20.0, (3.0, 0.5, -2.0))]
    assert shared(*poses, index=0)[1] == pytest.approx(shared(*poses, index=1)[0])
    assert 0.2 < shared(*poses)[1] < 0.8
