"""A real photograph upside down: it is found out by votes, and its pose is that of the upright one."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image as Picture

from georef.config import CandidatesConfig, FeaturesConfig, LocalizeConfig
from georef.errors import WeightsError
from georef.estimation.localization import localize_image
from georef.estimation.reference_map import ReferenceMap
from georef.features.aliked import AlikedN16
from georef.features.base import extract_features
from georef.features.images import read_image, turned
from georef.features.lightglue import LightGlueAliked
from georef.features.weights import locate
from georef.geometry.rigid import Rigid3, exp_so3
from georef.project import open_project
from georef.stages.survey import load_survey
from georef.stages.turned import TurnableImage
from georef.types.campaign import Campaign, Image
from georef.types.features import Features
from georef.types.results import Localized, Outcome, ReferenceNoise

_PROJECT = Path(__file__).parents[2] / "projects" / "castle"
_NOISE = ReferenceNoise(0.4, (0.005, 0.005, 0.005), (2e-4, 2e-4, 2e-4), "declared")
_CONFIG = FeaturesConfig(device="cpu")


@pytest.mark.accuracy
@pytest.mark.parametrize("quarter_turns", [1, 2])
def test_a_photograph_on_its_side_has_the_pose_of_the_upright_one(
    georef_data: Path, tmp_path: Path, quarter_turns: int
) -> None:
    try:
        locate("aliked-n16")
        locate("aliked_lightglue")
    except WeightsError as error:
        pytest.skip(f"weights: {error}")
    survey = load_survey(open_project(_PROJECT, data=georef_data, output=tmp_path), "new_epoch")
    upright = survey.epoch["b0009.jpg"]
    assert upright.gnss is not None
    place = upright.gnss.position_in_world
    near = sorted(survey.reference.images, key=lambda image: float(np.linalg.norm(_position(image) - place)))[:5]
    extractor = AlikedN16(device="cpu")
    found = {image.image_id: _extract(extractor, image.path) for image in near}
    reference = ReferenceMap(
        Campaign("reference", tuple(near)),
        lambda name, count: found[name] if count is None else found[name].head(count),
        _NOISE,
    )

    def localized(image: Image) -> Localized:
        picture = TurnableImage(image, tmp_path / "store", _CONFIG, lambda: extractor, None)
        outcome: Outcome = localize_image(
            image,
            _extract(extractor, image.path),
            reference,
            LightGlueAliked(),
            CandidatesConfig(ranking="votes", count=4, first_count=3),
            LocalizeConfig(),
            1024,
            picture=picture,
        )
        assert isinstance(outcome, Localized), outcome
        return outcome

    expected, on_its_side = localized(upright), localized(_taken_turned(upright, quarter_turns, tmp_path))
    assert (expected.quarter_turns, on_its_side.quarter_turns) == (0, 4 - quarter_turns)
    roll = Rigid3(exp_so3([0.0, 0.0, -0.5 * np.pi * quarter_turns]), np.zeros(3))
    difference = (expected.world_from_cam @ roll).local(on_its_side.world_from_cam)
    assert np.linalg.norm(difference[3:]) < 1e-3  # keypoints are rounded once more, and a few matches change by it
    assert np.linalg.norm(difference[:3]) < 5e-5
    assert abs(on_its_side.correspondence_count - expected.correspondence_count) <= 0.02 * expected.correspondence_count
    assert expected.correspondence_count > 300


def _position(image: Image) -> np.ndarray:
    assert image.world_from_cam is not None
    return image.world_from_cam.translation


def _extract(extractor: AlikedN16, path: Path) -> Features:
    return extract_features(extractor, read_image(path), _CONFIG.longest_side_px, None)


def _taken_turned(image: Image, quarter_turns: int, folder: Path) -> Image:
    """The same photograph by a camera that was turned about its axis; its picture without loss."""
    path = folder / f"turned_{quarter_turns}.png"
    Picture.fromarray(turned(read_image(image.path), quarter_turns)).save(path, compress_level=1)
    camera = image.camera
    if quarter_turns == 1:
        turned_camera = replace(
            camera,
            width=camera.height,
            height=camera.width,
            fx=camera.fy,
            fy=camera.fx,
            cx=camera.height - camera.cy,
            cy=camera.cx,
        )
    else:
        turned_camera = replace(camera, cx=camera.width - camera.cx, cy=camera.height - camera.cy)
    return replace(image, image_id=path.name, path=path, camera=turned_camera)
