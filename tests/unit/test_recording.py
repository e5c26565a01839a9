"""The recording, read back: entities, positions, residuals, bounded size; and what `georef view` refuses."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image as PillowImage
from rerun.chunk import RrdReader

from georef.config import ReportConfig
from georef.errors import StageError
from georef.geometry.camera import Camera, project
from georef.geometry.rigid import Rigid3
from georef.types.campaign import Image
from georef.types.constraints import CheckKind, CheckPoint, ControlPoint, Mark
from georef.types.results import Rejected, RejectReason
from georef.viewer import scene as scene_module
from georef.viewer.pictures import picture_jpeg, small_pinhole
from georef.viewer.recording import write_recording
from georef.viewer.scene import Scene, exaggeration, new_with_picture, reference_with_picture
from georef.viewer.show import has_display, show_recording

CAMERA = Camera("cam", 640, 480, 500.0, 505.0, 322.0, 238.0)
CONFIG = ReportConfig(recording_image_side_px=160, recording_max_points=50)


def read_back(path: Path) -> dict[str, dict[str, np.ndarray | list]]:
    """Entity path -> component -> values of the only row."""
    out: dict = {}
    for chunk in RrdReader(str(path)).stream():
        batch = chunk.to_record_batch()
        columns = {name: batch.column(name).to_pylist()[0] for name in batch.schema.names}
        out.setdefault(chunk.entity_path, {}).update(columns)
    return out


def image_at(folder: Path, name: str, position: list[float], epoch: str) -> Image:
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    pixels = np.random.default_rng(len(name)).integers(0, 255, (480, 640, 3), dtype=np.uint8)
    PillowImage.fromarray(pixels).save(path, "JPEG")
    return Image(name, path, CAMERA, epoch, world_from_cam=Rigid3(np.eye(3), np.array(position)))


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    rng = np.random.default_rng(7)
    reference = [image_at(tmp_path / "old", f"r{i}.jpg", [2.0 * i, 0.0, 1.5], "reference") for i in range(4)]
    new = [image_at(tmp_path / "new", f"day 1/n{i}.jpg", [2.0 * i, 1.0, 1.5], "new") for i in range(3)]
    adjusted = {i.image_id: i.world_from_cam for i in new[:2] if i.world_from_cam is not None}
    cov = 1e-4 * np.eye(3)
    marks = (Mark(new[0].image_id, np.array([322.0, 238.0]), 0.5),)
    check = [
        CheckPoint("K1", CheckKind.RELATIVE, np.array([0.0, 1.0, 9.0]), cov, marks),
        CheckPoint("K2", CheckKind.RELATIVE, np.array([3.0, 1.0, 9.0]), cov, marks),
        CheckPoint("A1", CheckKind.ABSOLUTE, np.array([1.0, 2.0, 9.0]), cov, marks),
    ]
    by_kind = {"relative": {"count": 1, "rmse_e_m": 0.004, "rmse_n_m": 0.0, "rmse_h_m": 0.003, "rmse_3d_m": 0.005}}
    return Scene(
        title="castle, new",
        run="castle-new-1",
        reference=[(i, i.world_from_cam) for i in reference if i.world_from_cam is not None],
        new=new,
        adjusted=adjusted,
        localized={name: replace(pose, translation=pose.translation + 0.01) for name, pose in adjusted.items()},
        rejected=[Rejected(new[2].image_id, RejectReason.FEW_INLIERS, "9 of 12")],
        position_covs=dict.fromkeys(adjusted, np.diag([1e-4, 4e-4, 9e-4])),
        points=rng.normal(size=(200, 3)),
        colors_rgb=rng.integers(0, 255, (200, 3), dtype=np.uint8),
        check=check,
        control=[ControlPoint("G1", np.array([5.0, 5.0, 5.0]), cov, marks)],
        residuals={"K1": np.array([0.004, 0.0, -0.003]), "A1": np.array([0.0, 0.02, 0.0])},
        report={"images": {"localized": 2, "total": 3, "rejected": 1}, "check_points": {"by_kind": by_kind}},
    )


def test_entities_positions_and_pictures(scene: Scene, tmp_path: Path) -> None:
    path = tmp_path / "out" / "recording.rrd"
    write_recording(scene, CONFIG, path)
    read = read_back(path)
    camera = read[r"/world/new/day\ 1\/n1.jpg"]
    np.testing.assert_allclose(camera["Transform3D:translation"][0], [2.0, 1.0, 1.5])
    np.testing.assert_allclose(camera["Pinhole:resolution"][0], [160, 120])
    np.testing.assert_allclose(np.array(camera["Pinhole:image_from_camera"][0]).reshape(3, 3).T[0], [125, 0, 80.5])
    assert bytes(camera["EncodedImage:blob"][0])[:2] == b"\xff\xd8"
    assert {f"/world/reference/r{i}.jpg" for i in range(4)} <= read.keys()
    np.testing.assert_allclose(read[r"/world/new/day\ 1\/n0.jpg/marks"]["Points2D:positions"][0], [80.5, 59.5])
    assert len(read["/world/points"]["Points3D:positions"]) == 50  # bounded
    positions = [v for e in read.values() for key, v in e.items() if key.endswith((":positions", ":translation"))]
    assert all(np.isfinite(np.array(p, dtype=float)).all() for p in positions)


def test_residuals_are_exaggerated_by_the_stated_factor_and_kinds_stay_apart(scene: Scene, tmp_path: Path) -> None:
    write_recording(scene, CONFIG, tmp_path / "recording.rrd")
    read = read_back(tmp_path / "recording.rrd")
    for kind, name in (("relative", "K1"), ("absolute", "A1")):
        prefix = f"/world/check_points/{kind}/residuals_times_"
        entity = next(e for e in read if e.startswith(prefix))
        factor = int(entity.removeprefix(prefix))
        np.testing.assert_allclose(read[entity]["Arrows3D:vectors"], [factor * scene.residuals[name]], rtol=1e-6)
        assert f"drawn {factor} times" in read[entity]["Arrows3D:labels"][0]
    np.testing.assert_allclose(read["/world/check_points/relative/points"]["Points3D:positions"][0], [0, 1, 9])
    assert read["/world/check_points/relative/points"]["Points3D:labels"] == ["K1  5.0 mm", "K2"]
    assert "/world/control_points/points" in read
    assert not any(e.startswith("/world/control_points/residuals") for e in read)  # control did not take part


def test_texts_name_the_rejected_and_what_is_shown(scene: Scene, tmp_path: Path) -> None:
    write_recording(scene, CONFIG, tmp_path / "recording.rrd")
    read = read_back(tmp_path / "recording.rrd")
    rejected = read["/rejected_images"]["TextDocument:text"][0]
    assert "day 1/n2.jpg" in rejected
    assert "9 of 12" in rejected
    summary = read["/summary"]["TextDocument:text"][0]
    assert "2 of 3 images localized" in summary
    assert "3D 5.0 mm" in summary
    assert "not absolute accuracy" in summary


def test_written_whole_or_not_at_all(scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "recording.rrd"
    path.write_bytes(b"the one before")

    def fail(*_: object) -> None:
        raise RuntimeError("half-way")

    monkeypatch.setattr("georef.viewer.recording.log_sigmas", fail)
    with pytest.raises(RuntimeError, match="half-way"):
        write_recording(scene, CONFIG, path)
    assert path.read_bytes() == b"the one before"
    assert list(tmp_path.glob("*.rrd")) + list(tmp_path.glob(".*.rrd")) == [path]


def test_nothing_localized_and_an_unreadable_picture(scene: Scene, tmp_path: Path) -> None:
    scene.reference[0][0].path.write_bytes(b"no image")
    bare = replace(scene, adjusted={}, localized={}, position_covs={}, points=np.zeros((0, 3)), residuals={})
    write_recording(bare, CONFIG, tmp_path / "recording.rrd")
    read = read_back(tmp_path / "recording.rrd")
    assert "EncodedImage:blob" not in read["/world/reference/r0.jpg"]
    assert "EncodedImage:blob" in read["/world/reference/r1.jpg"]
    assert not any(entity.startswith("/world/new") for entity in read)


def test_large_campaigns_keep_the_pictures_near_new_images(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scene_module, "MOST_PICTURES", 4)
    monkeypatch.setattr(scene_module, "_LEAST_REFERENCE_PICTURES", 1)
    assert reference_with_picture(scene).tolist() == [0, 1]  # two of four beside the two new ones
    assert len(new_with_picture(scene)) == 2


def test_exaggeration_is_round_and_never_shrinks() -> None:
    assert exaggeration(np.array([0.01]), 50.0) == 200
    assert exaggeration(np.array([10.0]), 50.0) == 1
    assert exaggeration(np.zeros(3), 50.0) == 1
    assert exaggeration(np.zeros(0), 50.0) == 1


def test_pictures_are_undistorted(tmp_path: Path) -> None:
    """A bright spot lands where the distortion-free pinhole projects its ray."""
    camera = replace(CAMERA, distortion=(-0.25, 0.05, 0.002, -0.001))
    ray = np.array([0.42, -0.3, 1.0])
    x, y = project(camera, ray[None])[0]
    rows, columns = np.mgrid[0:480, 0:640] + 0.5
    spot = 255 * np.exp(-0.5 * ((columns - x) ** 2 + (rows - y) ** 2) / 6.0**2)
    path = tmp_path / "spot.png"
    PillowImage.fromarray(np.repeat(spot.astype(np.uint8)[:, :, None], 3, axis=2)).save(path)
    small = small_pinhole(camera, 320)
    jpeg = picture_jpeg(path, camera, small)
    assert jpeg is not None
    (tmp_path / "out.jpg").write_bytes(jpeg)
    grey = np.asarray(PillowImage.open(tmp_path / "out.jpg").convert("L"), dtype=float)
    grey[grey < 30] = 0
    v, u = np.mgrid[0 : small.height, 0 : small.width] + 0.5
    found = np.array([np.sum(grey * u), np.sum(grey * v)]) / grey.sum()
    np.testing.assert_allclose(found, small.focal * ray[:2] + small.centre, atol=0.4)


def test_view_says_what_is_missing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "recording.rrd"
    with pytest.raises(StageError, match="no recording of this epoch"):
        show_recording(path)
    path.write_bytes(b"")
    monkeypatch.setattr("sys.platform", "linux")
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    with pytest.raises(StageError, match="no display") as caught:
        show_recording(path)
    assert str(path) in str(caught.value)
    assert has_display({"WAYLAND_DISPLAY": "wayland-0"}, "linux")
    assert has_display({}, "darwin")


def test_viewer_is_bound_to_this_machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A stand-in for the viewer writes down its arguments; its failure is an error."""
    said = tmp_path / "arguments"
    monkeypatch.setattr(
        "georef.viewer.show._RERUN",
        f"import sys; open({str(said)!r}, 'a').write(' '.join(sys.argv[1:]) + '\\n'); sys.exit('x.rrd' in sys.argv[1])",
    )
    monkeypatch.setenv("DISPLAY", ":0")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    good, bad = tmp_path / "good.rrd", tmp_path / "x.rrd"
    good.touch()
    bad.touch()
    show_recording(good, 9999)
    assert said.read_text().splitlines() == ["analytics disable", f"{good} --bind 127.0.0.1 --port 9999"]
    with pytest.raises(StageError, match="ended with code 1"):
        show_recording(bad)
