"""An error in the computation of one image: it is that image's outcome; what all images would meet ends the run."""

from __future__ import annotations

import logging
import shutil
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from georef.config import FeaturesConfig
from georef.errors import StageError, WeightsError
from georef.estimation.guided import PosedFeatures
from georef.features.base import Extractor, extract_features
from georef.geometry.camera import Camera
from georef.geometry.rigid import Rigid3
from georef.io.items import item_path, read_outcome
from georef.stages import features, global_map
from georef.stages.failures import internal_failure
from georef.stages.features import ExtractTask, extractor_version
from georef.stages.localize import ITEMS
from georef.types.campaign import Image
from georef.types.features import Features
from georef.types.results import Localized, Rejected, RejectReason
from tests.stages.bench import Bench
from tests.worlds.tiny import EPOCH

MARK = (1, 2, 3)  # colour of the first pixel of the image that fails
BAD = 2  # place of a reference
GLOBAL_MODEL = "localize.method=global-model"


def raising(error: Exception) -> Callable[..., Features]:
    def extract(extractor: Extractor, pixels: np.ndarray, *limits: int | None) -> Features:
        if tuple(pixels[0, 0]) == MARK:
            raise error
        return extract_features(extractor, pixels, *limits)

    return extract


def infinite(extractor: Extractor, pixels: np.ndarray, *limits: int | None) -> Features:
    found = extract_features(extractor, pixels, *limits)
    if tuple(pixels[0, 0]) != MARK:
        return found
    return replace(found, descriptors=np.full(found.descriptors.shape, np.nan, np.float32))


def add_marked(images: Path) -> None:
    pixels = cv2.imread(str(images / "n0.jpg"))
    assert pixels is not None
    pixels[0, 0] = MARK[::-1]
    cv2.imwrite(str(images / "marked.png"), pixels)


@pytest.mark.parametrize(
    ("extract", "detail"),
    [
        (raising(RuntimeError("no kernel for this")), "RuntimeError: no kernel for this"),
        (raising(cv2.error("an assertion")), "error: an assertion"),
        (infinite, "ValueError: descriptors with values that are not finite"),
    ],
)
def test_an_extraction_that_fails_is_one_images_outcome(
    copied: Callable[..., Bench],
    finished: Bench,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    extract: Callable[..., Features],
    detail: str,
) -> None:
    bench = copied(data=True)
    add_marked(bench.data / EPOCH)
    monkeypatch.setattr(features, "extract_features", extract)
    results = bench.run()
    assert list(results["features"].summary.data["failed"]) == [f"{EPOCH}/marked.png"]
    found = read_outcome(item_path(bench.states()["localize"].folder / ITEMS, "marked.png"))
    assert isinstance(found, Rejected)
    assert found.reason == RejectReason.INTERNAL
    assert found.detail.startswith(detail)
    logged = [record for record in caplog.records if record.levelno == logging.ERROR]
    assert [record.message for record in logged] == [f"extraction of {EPOCH}/marked.png failed"]
    assert logged[0].exc_info is not None
    others = read_outcome(item_path(bench.states()["localize"].folder / ITEMS, "n1.jpg"))
    assert isinstance(others, Localized)


@pytest.mark.parametrize("error", [MemoryError("full"), torch.cuda.OutOfMemoryError("full"), OSError(28, "disk full")])
def test_what_every_image_would_meet_ends_the_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    cv2.imwrite(str(tmp_path / "a.png"), np.full((48, 64, 3), MARK[::-1], np.uint8))
    monkeypatch.setattr(features, "extract_features", raising(error))
    task = ExtractTask(tmp_path, "1", FeaturesConfig(extractor="sift"))
    image = Image("a", tmp_path / "a.png", Camera("c", 64, 48, 60.0, 60.0, 32.0, 24.0), EPOCH)
    with pytest.raises(type(error)):
        task(image)


@pytest.mark.parametrize(
    ("error", "ends"),
    [
        (WeightsError("missing"), True),
        (ImportError("missing"), True),
        (StageError("damaged"), False),
        (KeyError("name"), False),
        (RuntimeError("singular"), False),
    ],
)
def test_kinds_of_errors(error: Exception, ends: bool) -> None:
    if ends:
        with pytest.raises(type(error)):
            internal_failure(error, "it")
    else:
        assert internal_failure(error, "it") == ("internal", f"{type(error).__name__}: {error}")


def damage_reference(bench: Bench) -> str:
    """Cuts off the stored features of a reference whose stage is finished; returns the image's id."""
    stored = sorted(bench.open().feature_folder.rglob("reference%2F*.safetensors"))[3]
    stored.write_bytes(stored.read_bytes()[:500])
    return stored.name.removeprefix("reference%2F").removesuffix(".safetensors")


def test_a_damaged_reference_is_the_outcome_of_those_that_need_it(copied: Callable[..., Bench]) -> None:
    bench = copied()
    name = damage_reference(bench)
    shutil.rmtree(bench.states()["localize"].folder)
    results = bench.run()
    assert results["features"].reused
    folder = bench.states()["localize"].folder / ITEMS
    found = [read_outcome(path) for path in sorted(folder.glob("*.npz"))]
    assert len(found) == 3
    failed = [outcome for outcome in found if isinstance(outcome, Rejected)]
    assert failed
    for outcome in failed:
        assert outcome.reason == RejectReason.INTERNAL
        assert outcome.detail.startswith(f"StageError: The features of image 'reference/{name}' are damaged")


def test_a_damaged_reference_has_no_points_in_the_map(copied: Callable[..., Bench]) -> None:
    bench = copied()
    name = damage_reference(bench)
    summary = bench.run(GLOBAL_MODEL)["global-map"].summary
    assert summary.data["without_points"] == [name]
    assert f"1 without any: {name}" in summary.line
    assert summary.data["points"] > 500


@pytest.mark.parametrize("function", ["match_pair", "block_structure"])
def test_what_fails_in_the_map_is_the_loss_of_one_reference(
    copied: Callable[..., Bench], monkeypatch: pytest.MonkeyPatch, function: str
) -> None:
    bench, original = copied(), getattr(global_map, function)
    poses: list[Rigid3] = []

    def remembering(task: global_map.MapTask, indices: Iterable[int]) -> dict[int, PosedFeatures]:
        poses.append(task.localize.map.poses[BAD])
        return posed(task, indices)

    def failing(first, second, *others):
        in_block = function == "block_structure" and BAD in first
        if in_block or (function == "match_pair" and any(f.world_from_cam is poses[-1] for f in (first, second))):
            raise RuntimeError("it does not converge")
        return original(first, second, *others)

    posed = global_map.MapTask.posed
    monkeypatch.setattr(global_map.MapTask, "posed", remembering)
    monkeypatch.setattr(global_map, function, failing)
    summary = bench.run(GLOBAL_MODEL)["global-map"].summary
    assert len(summary.data["without_points"]) == 1
    assert summary.data["points"] > 500


def test_a_change_of_what_all_extractors_share_is_another_version(monkeypatch: pytest.MonkeyPatch) -> None:
    config = FeaturesConfig(extractor="sift")
    before = extractor_version(config)
    assert extractor_version(config) == before
    monkeypatch.setattr(features, "EXTRACTION_VERSION", features.EXTRACTION_VERSION + 1)
    assert extractor_version(config) != before
