"""A camera held upside down: its file says so, and every stage goes on with the features of the turned picture."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image as Picture

from georef.features.images import read_image, turned
from georef.geometry.rigid import Rigid3, exp_so3
from georef.stages.adjusted_epoch import read_adjusted
from georef.stages.base import feature_id, open_features
from georef.stages.localize import read_outcomes
from georef.types.results import Localized
from tests.stages.bench import Bench
from tests.worlds.tiny import CAMERA, EPOCH, TinyWorld, camera_row

_TURN_BACK = "localize.try_turned=true"


def _upside_down(data: Path) -> None:
    """The new images as a camera that was held upside down would have stored them."""
    camera = replace(CAMERA, cx=CAMERA.width - CAMERA.cx, cy=CAMERA.height - CAMERA.cy)
    (data / "held.csv").write_text(f"camera,width,height,fx,fy,cx,cy\n{camera_row(camera)}\n", encoding="utf-8")
    for path in (data / EPOCH).glob("*.jpg"):
        exif = Picture.Exif()
        exif[0x0112] = 3
        Picture.fromarray(turned(read_image(path), 2)).save(path, quality=95, exif=exif)
    text = (data / "project.toml").read_text(encoding="utf-8")
    without_marks = text[: text.index("[points]")] + text[text.index("[config.features]") :]
    head, epoch, rest = without_marks.partition(f"[epochs.{EPOCH}]")
    (data / "project.toml").write_text(head + epoch + rest.replace("camera.csv", "held.csv", 1), encoding="utf-8")


def test_images_held_upside_down_come_out_right(
    finished: Bench, copied: Callable[..., Bench], tiny_world: TinyWorld
) -> None:
    bench = copied(data=True)
    _upside_down(bench.data)
    shutil.rmtree(bench.output / "epochs")
    results = bench.run(_TURN_BACK)
    outcomes = list(read_outcomes(results["localize"].context.folder, results["localize"].context.survey.epoch))
    store = open_features(results["adjust"].context.before["store"])
    adjusted = read_adjusted(results["adjust"].context.folder)
    assert len(adjusted.image_ids) == len(outcomes) == 3
    assert adjusted.data["image_observations"] > 500
    half_turn = Rigid3(exp_so3([0.0, 0.0, np.pi]), np.zeros(3))
    for outcome, pose in zip(outcomes, adjusted.world_from_cams, strict=True):
        assert isinstance(outcome, Localized), outcome
        assert outcome.quarter_turns == 2
        image = results["localize"].context.survey.epoch[outcome.image_id]
        features = store.read(feature_id(image, 2))
        assert features.quarter_turns == 2
        assert features.image_size == (CAMERA.width, CAMERA.height)
        error = (tiny_world.truth[outcome.image_id] @ half_turn).local(pose)
        assert np.linalg.norm(error[3:]) < 0.02
        assert np.linalg.norm(error[:3]) < np.radians(0.05)
