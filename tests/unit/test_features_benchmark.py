"""The measurement of extraction, on images small enough for a test."""

from __future__ import annotations

from pathlib import Path

import pytest
from PIL import Image

from georef.benchmarks.extraction import as_table, compared_with_kornia, extraction_costs
from georef.errors import WeightsError
from georef.features.weights import locate
from tests.contracts.synthetic import textured_image


@pytest.fixture
def picture(tmp_path: Path) -> Path:
    path = tmp_path / "a.png"
    Image.fromarray(textured_image(320, 240)).save(path)
    return path


def test_the_cost_of_sift(picture: Path) -> None:
    (cost,) = extraction_costs([picture, picture], ["sift"], [320])
    assert cost.images == 2
    assert cost.keypoints > 100
    assert 0.001 < cost.cpu_s < 5
    assert 30 < cost.peak_mb < 2000
    assert [line.split()[0] for line in as_table([cost])] == ["extractor", "---------", "sift"]


def test_aliked_finds_what_kornias_module_finds(picture: Path) -> None:
    try:
        locate("aliked-n16")
    except WeightsError as error:
        pytest.skip(f"weights are not in the cache: {str(error).splitlines()[0]}")
    found = compared_with_kornia([picture], 320)
    assert found.own.keypoints == found.shipped.keypoints > 50
    assert found.same_share == 1
