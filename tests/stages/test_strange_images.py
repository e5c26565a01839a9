"""Images that a survey brings along though it should not: each has an outcome, and none disturbs the others."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from georef.cli import app
from georef.errors import StageError
from georef.geometry.angles import rotation_from_yaw_pitch_roll
from georef.geometry.rigid import Rigid3
from georef.io.items import item_path, read_outcome
from georef.stages.localize import ITEMS
from georef.terminal import exit_code
from georef.types.results import Localized, Outcome, Rejected, RejectReason
from tests.stages.bench import Bench
from tests.worlds.tiny import EPOCH, render, save_image, wall_textures

GNSS_ROW = "{name},{e:.3f},{n:.3f},{h:.3f},0.5,0.5,1.0"


@pytest.fixture(scope="module")
def strange(finished: Bench, tmp_path_factory: pytest.TempPathFactory) -> Bench:
    """The small world with strange images beside its own, run."""
    folder = tmp_path_factory.mktemp("strange")
    bench = Bench(
        Path(shutil.copytree(finished.data, folder / "data")), Path(shutil.copytree(finished.output, folder / "output"))
    )
    images = bench.data / EPOCH
    _cut_off(images / "n0.jpg", images / "cut.jpg")
    pose = Rigid3(rotation_from_yaw_pitch_roll(np.radians([42.0, -4.0, 0.0])), np.array([-3.0, -3.2, 3.4]))
    save_image(images / "elsewhere.jpg", render(pose, wall_textures(seed=1), "elsewhere.jpg"))
    picture = render(pose, wall_textures(), "far.jpg")
    save_image(images / "far.jpg", picture)
    save_image(images / "nowhere.jpg", render(pose, wall_textures(), "nowhere.jpg"))
    save_image(images / "small.jpg", np.ascontiguousarray(picture[:240, :320]))
    save_image(images / "plain.jpg", np.full((480, 640, 3), 128, np.uint8))
    (images / "text.jpg").write_text("not an image", encoding="utf-8")
    _add_gnss(bench.data / f"{EPOCH}_gnss.csv", {"far.jpg": 200.0, "elsewhere.jpg": 0.0, "absent.jpg": 0.0})
    bench.run()
    return bench


def _cut_off(whole: Path, cut: Path) -> None:
    content = whole.read_bytes()
    cut.write_bytes(content[: len(content) // 2])


def _add_gnss(path: Path, offsets_m: dict[str, float]) -> None:
    rows = [GNSS_ROW.format(name=name, e=456577.0 + offset, n=5421021.8, h=173.4) for name, offset in offsets_m.items()]
    path.write_text(path.read_text(encoding="utf-8") + "\n".join(rows) + "\n", encoding="utf-8")


def outcome(bench: Bench, image_id: str) -> Outcome:
    return read_outcome(item_path(bench.states()["localize"].folder / ITEMS, image_id))


@pytest.mark.parametrize(
    ("image_id", "reason"),
    [
        ("cut.jpg", RejectReason.UNREADABLE),
        ("text.jpg", RejectReason.UNREADABLE),
        ("absent.jpg", RejectReason.UNREADABLE),
        ("small.jpg", RejectReason.WRONG_SIZE),
        ("plain.jpg", RejectReason.FEW_FEATURES),
    ],
)
def test_a_file_that_cannot_be_used_is_rejected(strange: Bench, image_id: str, reason: RejectReason) -> None:
    found = outcome(strange, image_id)
    assert isinstance(found, Rejected)
    assert found.reason == reason
    assert found.detail


def test_an_image_of_another_place_is_rejected(strange: Bench) -> None:
    found = outcome(strange, "elsewhere.jpg")
    assert isinstance(found, Rejected)
    assert found.reason in (RejectReason.FEW_MATCHES, RejectReason.FEW_INLIERS, RejectReason.NO_CANDIDATES)


def test_a_gnss_position_200_m_off_is_overruled_and_not_used(strange: Bench) -> None:
    found = outcome(strange, "far.jpg")
    if isinstance(found, Rejected):
        assert found.reason == RejectReason.PRIOR_CONTRADICTS
        return
    assert found.gnss_rejected
    assert found.gnss_offset_m == pytest.approx(200.0, abs=5.0)
    assert np.linalg.norm(found.world_from_cam.translation - [-3.0, -3.2, 3.4]) < 0.03


def test_an_image_without_a_position_is_found_in_the_whole_reference(strange: Bench) -> None:
    found = outcome(strange, "nowhere.jpg")
    assert isinstance(found, Localized)
    assert any("no position prior" in note for note in found.notes)
    assert np.linalg.norm(found.world_from_cam.translation - [-3.0, -3.2, 3.4]) < 0.03


def test_the_others_are_what_they_were(strange: Bench, finished: Bench) -> None:
    ours, theirs = (_rows(bench.published("localization.csv")) for bench in (strange, finished))
    assert len(ours) == 3 + 8
    assert theirs.items() <= ours.items()


def test_every_image_has_a_row_and_rejected_ones_have_no_numbers(strange: Bench) -> None:
    rows = _rows(strange.published("poses.csv"))
    for image_id in ("cut.jpg", "text.jpg", "absent.jpg", "small.jpg", "plain.jpg", "elsewhere.jpg"):
        cells = rows[image_id].split(",")
        assert cells[7].startswith("rejected: ")
        assert not any(cells[1:7] + cells[8:])


def test_no_image_at_all_can_be_used(copied: Callable[..., Bench]) -> None:
    """A run in which nothing is localized still ends with a report, and says so by its exit code."""
    bench = copied(data=True)
    for image in (bench.data / EPOCH).iterdir():
        cv2.imwrite(str(image), np.full((480, 640, 3), 90, np.uint8))
    assert exit_code(app, ["run", str(bench.data), "-o", str(bench.output)]) == 3
    assert all(",rejected: few_features" in row for row in _rows(bench.published("poses.csv")).values())


def test_a_reference_that_cannot_be_read_is_said(tiny_tables: Path) -> None:
    with pytest.raises(StageError, match=r"Only 0 of 8 reference images can be used\."):
        Bench(tiny_tables, tiny_tables).run()


def _rows(table: bytes) -> dict[str, str]:
    lines = [line for line in table.decode().splitlines() if not line.startswith(("#", "image,"))]
    return {line.split(",", 1)[0]: line for line in lines}
