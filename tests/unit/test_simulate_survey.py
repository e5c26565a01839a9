"""The simulated survey: its errors have the sigmas that it states, and its files say what is true."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import cv2
import laspy
import numpy as np
import pytest
from scipy.stats import chi2

from georef.errors import InputError
from georef.geometry.rigid import Array, Rigid3, log_so3
from georef.io.exterior_orientation import read_exterior_orientation
from georef.project import open_project
from georef.simulate import project_files
from georef.simulate.axis import straight_axis
from georef.simulate.capture import Phone, session, tracked, write_capture
from georef.simulate.project_files import TRUTH, RenderTask, project_toml, write_images, write_project, write_tables
from georef.simulate.reference_errors import Deformation, ReferenceQuality, published
from georef.simulate.rigs import first_rig, handheld_rigs, second_rig
from georef.simulate.scan import Scanner, scan, write_scan
from georef.simulate.survey import survey_points
from georef.simulate.trajectory import GnssImu, SmoothProcess, Trajectory, drive, gauss_markov, measure
from georef.simulate.world import REFERENCE, StreetWorld, WorldOptions
from georef.stages.survey import Survey, load_survey
from georef.types.constraints import CheckKind

OPTIONS = WorldOptions(seed=3, length_m=60.0, max_stations=6)
RUNS = 150


@pytest.fixture(scope="module")
def world() -> StreetWorld:
    return StreetWorld(OPTIONS)


@pytest.fixture(scope="module")
def folder(world: StreetWorld, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """All files, the images empty but for those whose size the reader looks at."""
    path = tmp_path_factory.mktemp("street")
    write_tables(world, path)
    for name in project_files.image_files(world):
        image = project_files.image_path(world, name, path)
        image.parent.mkdir(exist_ok=True)
        lens = world.images[name].lens
        image.write_bytes(_blank_jpeg(lens.width, lens.height))
    return path


@pytest.fixture(scope="module")
def survey(folder: Path) -> Survey:
    return load_survey(open_project(folder), "second")


def _blank_jpeg(width: int, height: int) -> bytes:
    return cv2.imencode(".jpg", np.zeros((height, width, 3), np.uint8))[1].tobytes()


def _within(squares: Array, sigma: float, effective: float) -> bool:
    """Whether a mean square agrees with a sigma, two-sided (99.9 %), for so many independent values."""
    ratio = float(np.mean(squares)) / sigma**2
    low, high = (chi2.ppf(tail, effective) / effective for tail in (0.0005, 0.9995))
    return bool(low < ratio < high)


# --- rigs and trajectories ---


def test_heads_look_where_their_names_say() -> None:
    heads = {head.name: head for head in first_rig("large").heads}
    assert len(heads) == 11
    assert len(second_rig("large").heads) == 6
    forward = {name: head.rig_from_cam.rotation[:, 2] for name, head in heads.items()}
    assert forward["front_left"][1] > 0.99
    assert forward["right_front"][0] > 0.99
    assert forward["rear_left"][1] < -0.99
    assert heads["front_left"].rig_from_cam.translation[0] < 0 < heads["front_right"].rig_from_cam.translation[0]
    assert all(head.rig_from_cam.rotation[2, 1] < -0.9 for head in heads.values())  # the image's down is down
    assert all(abs(np.linalg.det(head.rig_from_cam.rotation) - 1) < 1e-12 for head in heads.values())


def test_a_fisheye_sees_its_angle_into_the_corners() -> None:
    action = next(rig for rig in handheld_rigs(0.1) if rig.name == "action").heads[0].design.lens()
    corners = [[x, y] for x in (0.0, action.width) for y in (0.0, action.height)]
    angles = np.degrees(np.arccos(action.rays(np.array(corners))[:, 2]))
    assert np.allclose(angles, 60.0, atol=0.5)


def test_a_vehicle_goes_along_the_street() -> None:
    axis, rig = straight_axis(100.0), second_rig()
    trajectory = drive(axis, rig, np.random.default_rng(0))
    positions = np.array([pose.translation for pose in trajectory.world_from_rigs])
    assert np.allclose(np.linalg.norm(np.diff(positions, axis=0), axis=1), 4.0, atol=0.5)
    for s, pose in zip(trajectory.s_m, trajectory.world_from_rigs, strict=True):
        heading = axis.heading_rad(np.array([s]))[0]
        assert pose.rotation[:, 1] @ [np.sin(heading), np.cos(heading), 0.0] > 0.999
        offset = (pose.translation - axis.at(np.array([s]))[0]) @ pose.rotation[:, 0]
        assert abs(offset - rig.lateral_m) < 0.6


# --- errors have their sigmas, two-sided ---


def test_smooth_errors_have_their_sigma_and_slope() -> None:
    s = np.array([10.0, 200.0])
    drawn = [SmoothProcess.draw(np.random.default_rng([1, i]), [0.02, 0.02], 30.0) for i in range(RUNS)]
    values = np.array([process.at(s) for process in drawn])
    assert _within(np.square(values), 0.02, 4 * RUNS)
    slopes = np.array([process.slope(s) for process in drawn])
    assert _within(np.square(slopes), 0.02 / 30.0, 4 * RUNS / 3)  # random frequencies scatter more
    ahead = drawn[0].at(s + 1e-4)
    assert np.allclose((ahead - drawn[0].at(s)) / 1e-4, drawn[0].slope(s), atol=1e-7)


def test_gauss_markov_errors_have_their_sigma_and_correlation() -> None:
    s = np.array([0.0, 4.0, 14.0])
    drawn = np.array([gauss_markov(s, np.array([0.1]), 20.0, np.random.default_rng([2, i])) for i in range(10 * RUNS)])
    drawn = drawn[..., 0] / 0.1
    expected = np.exp(-np.abs(s[:, None] - s[None, :]) / 20.0)
    assert np.allclose(drawn.T @ drawn / len(drawn), expected, atol=4.0 / np.sqrt(len(drawn)))


def test_gnss_errors_have_the_sigmas_that_the_receiver_states() -> None:
    axis, rig = straight_axis(200.0), second_rig()
    squares, factors = [], []
    for i in range(RUNS):
        rng = np.random.default_rng([3, i])
        trajectory = drive(axis, rig, rng)
        measured = measure(trajectory, GnssImu(), rng)
        truth = np.array([pose.apply(rig.antenna) for pose in trajectory.world_from_rigs])
        squares.append(np.square((measured.antenna_in_world - truth) / measured.sigma_m))
        factors.append(measured.sigma_m[:, 0] / GnssImu().sigma_m[0])
        back = np.array([pose.apply(rig.antenna) for pose in measured.world_from_rigs])
        assert np.allclose(back, measured.antenna_in_world)  # the lever arm was taken off
    assert _within(np.array(squares), 1.0, RUNS * 3 * 200.0 / (2 * 60.0))  # drift: few independent values a drive
    assert 1.0 <= np.min(factors) < 1.01
    assert 2.5 < np.max(factors) <= GnssImu().outage_factor


def test_published_orientation_has_the_errors_of_its_quality() -> None:
    quality, axis = ReferenceQuality(), straight_axis(100.0)
    rig = first_rig()
    truth = [
        pose @ rig.heads[2].rig_from_cam for pose in drive(axis, rig, np.random.default_rng(9)).world_from_rigs[::3]
    ]
    smooth, relative, turns = [], [], []
    for i in range(RUNS // 2):
        rng = np.random.default_rng([4, i])
        deformation = Deformation.draw(axis, quality, rng)
        moved = [deformation.moved_pose(pose) for pose in truth]
        given = published(truth, deformation, quality, rng)
        smooth.append([deformation.moved(pose.translation[None])[0] - pose.translation for pose in truth[::7]])
        relative.append([g.translation - m.translation for g, m in zip(given, moved, strict=True)])
        turns.append([m.local(g)[:3] for g, m in zip(given, moved, strict=True)])
    assert _within(np.square(smooth), quality.absolute_m, 3 * RUNS / 2)
    assert _within(np.square(relative), quality.relative_m, np.size(relative))
    assert _within(np.square(turns), np.radians(quality.relative_deg), np.size(turns))


def test_a_deformation_takes_points_and_cameras_along() -> None:
    """What deformed cameras see of deformed points is what exact cameras see of exact ones, to second order."""
    axis = straight_axis(100.0)
    deformation = Deformation.draw(axis, ReferenceQuality(absolute_m=0.05), np.random.default_rng(5))
    pose = Rigid3(np.eye(3), axis.beside(40.0, 1.0, 2.0)[0])
    near = axis.beside(np.linspace(36.0, 44.0, 9), 8.0, 3.0)
    exact = pose.inverse().apply(near)
    deformed = deformation.moved_pose(pose).inverse().apply(deformation.moved(near))
    assert np.abs(deformed - exact).max() < 0.004  # of 50 mm: stretching along the street is what is left
    assert np.linalg.norm(deformation.moved(near) - near, axis=1).min() > 0.01


# --- files ---


def test_tables_read_back_as_they_were_simulated(world: StreetWorld, survey: Survey) -> None:
    def in_frame(points: Array) -> Array:
        return survey.world.world_from_crs(world.frame.crs_from_world(points))

    assert {i.image_id for i in survey.reference.images} == {i.image_id for i in world.images_of(REFERENCE)}
    turn = survey.world.crs_axes_from_world(survey.world.origin_in_crs[None])[0].T
    turn = turn @ world.frame.crs_axes_from_world(survey.world.origin_in_crs[None])[0]
    for image in survey.reference.images:
        given, read = world.published_poses[image.image_id], image.world_from_cam
        assert read is not None
        assert np.abs(read.translation - in_frame(given.translation[None])[0]).max() < 2e-5
        assert np.abs(read.rotation - turn @ given.rotation).max() < 1e-8
        camera = world.images[image.image_id].lens.camera
        assert camera is not None
        assert np.allclose(
            [image.camera.fx, image.camera.cx, image.camera.cy], [camera.fx, camera.cx, camera.cy], atol=1e-4
        )
    for image in survey.epoch.images:
        simulated, measured = world.images[image.image_id], world.measured["second"]
        pose = measured.world_from_rigs[simulated.station] @ simulated.head.rig_from_cam
        assert image.gnss is not None
        assert image.heading_rad is not None
        assert np.abs(image.gnss.position_in_world - in_frame(pose.translation[None])[0]).max() < 1e-3
        forward = pose.rotation[:, 2]
        assert abs(np.sin(image.heading_rad - np.arctan2(forward[0], forward[1]))) < 1e-3
        assert image.camera.distortion == simulated.lens.camera.distortion  # type: ignore[union-attr]


def test_points_and_marks_read_back(world: StreetWorld, survey: Survey) -> None:
    simulated = survey_points(world)
    read = {point.point_id: point for point in (*survey.control, *survey.check)}
    assert set(read) == {point.point_id for point in simulated.points}
    assert len(survey.control) >= 3
    assert {point.kind for point in survey.check} == set(CheckKind)
    for point in simulated.points:
        expected = survey.world.world_from_crs(world.frame.crs_from_world(point.given[None]))[0]
        assert np.abs(read[point.point_id].point_in_world - expected).max() < 1e-4
        assert len(read[point.point_id].marks) >= 3
    marks = {(name, m.image_id): m.pixel for name, point in read.items() for m in point.marks}
    errors = []
    for mark in simulated.marks:
        image = world.images[mark.image_id]
        exact = next(p.exact for p in simulated.points if p.point_id == mark.point_id)
        pixel = image.lens.project(image.world_from_cam.inverse().apply(exact[None]))[0]
        assert np.abs(marks[mark.point_id, mark.image_id] - mark.pixel).max() < 1e-3
        errors.append(mark.pixel - pixel)
    assert _within(np.square(errors), 0.3, np.size(errors))


def test_points_are_as_good_as_they_say(world: StreetWorld) -> None:
    """Absolute ones against the exact coordinates, relative ones against these as the reference deforms them."""
    points = survey_points(world).points
    absolute = [p.given - p.exact for p in points if p.kind is CheckKind.ABSOLUTE]
    assert _within(np.square(absolute), 0.005, np.size(absolute))
    relative = [p for p in points if p.kind is CheckKind.RELATIVE]
    errors = [(p.given - world.deformation.moved(p.exact[None])[0]) / p.sigma_m for p in relative]
    assert 0.2 < np.sqrt(np.mean(np.square(errors))) < 1.4  # sigmas are those of the worst direction


def test_the_project_does_not_name_the_truth(folder: Path, world: StreetWorld) -> None:
    assert TRUTH not in (folder / "project.toml").read_text(encoding="utf-8")
    outside = [path for path in folder.rglob("*.csv") if path.parent.name != TRUTH]
    assert len(outside) >= 5
    exact = world.images_of("second")[0].world_from_cam.translation
    first = f"{world.frame.crs_from_world(exact[None])[0][0]:.3f}"
    assert not any(first in path.read_text(encoding="utf-8") for path in outside)
    names = {path.name for path in (folder / TRUTH).iterdir()}
    assert {"second_eo.csv", "second_eo_relative.csv", "points.csv", "tie_marks.csv", "changes.json"} <= names


def test_truth_is_exact(folder: Path, world: StreetWorld) -> None:
    table = read_exterior_orientation(
        folder / TRUTH / "second_eo.csv", crs_kind="projected", angles="omega-phi-kappa", angle_unit="deg"
    )
    positions = world.frame.world_from_crs(table.positions_in_crs)
    truth = [world.images[name].world_from_cam for name in table.image_ids]
    assert np.abs(positions - [pose.translation for pose in truth]).max() < 2e-5
    changes = json.loads((folder / TRUTH / "changes.json").read_text(encoding="utf-8"))
    assert len(changes) == len(world.street.changes) > 0


def test_tie_points_are_seen_in_both_epochs(world: StreetWorld) -> None:
    ties = survey_points(world).ties
    assert len(ties) >= 20
    for tie in ties:
        for campaign in (REFERENCE, "second"):
            own = [name for name in tie.pixels if world.images[name].campaign == campaign]
            assert len(own) >= 2
        for name, pixel in tie.pixels.items():
            image = world.images[name]
            again = image.lens.project(image.world_from_cam.inverse().apply(tie.point_in_world[None]))[0]
            assert np.allclose(again, pixel, atol=1e-6)


def test_the_shipped_project_is_the_one_that_is_written() -> None:
    shipped = Path(__file__).parents[2] / "projects" / "demo" / "project.toml"
    assert shipped.read_text(encoding="utf-8") == project_toml(StreetWorld())


# --- determinism and resuming ---


def test_the_same_seed_is_the_same_survey(world: StreetWorld, folder: Path, tmp_path: Path) -> None:
    write_tables(StreetWorld(OPTIONS), tmp_path)
    for path in tmp_path.rglob("*.*"):
        assert path.read_bytes() == (folder / path.relative_to(tmp_path)).read_bytes(), path.name
    other = StreetWorld(WorldOptions(seed=4, max_stations=6))
    assert not np.allclose(
        other.images_of("second")[0].world_from_cam.translation, world.images_of("second")[0].world_from_cam.translation
    )


class Interrupted(Exception):
    pass


class Breaking:
    """Runs a few items, then is interrupted."""

    def map_items(self, task, items: Sequence[str], label: str) -> Iterator[str]:
        for item in items[:3]:
            yield task(item)
        raise Interrupted


class Counting:
    def __init__(self) -> None:
        self.items: list[str] = []

    def map_items(self, task, items: Sequence[str], label: str) -> Iterable[str]:
        self.items += items
        return map(task, items)


def test_an_interrupted_write_goes_on(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(
        StreetWorld, "render_image", lambda self, name: np.zeros((8, 8, 3), np.uint8) + len(name), raising=True
    )
    small = StreetWorld(WorldOptions(seed=3, length_m=60.0, max_stations=2, scale=0.5))
    with pytest.raises(Interrupted):
        write_project(small, tmp_path, runner=Breaking())
    assert len(list(tmp_path.rglob("*.jpg"))) == 3
    assert not list(tmp_path.rglob("*.tmp"))
    rest = Counting()
    done = write_images(small, tmp_path, rest)
    assert len(done) == len(rest.items) == len(small.images) - 3
    assert write_project(small, tmp_path, runner=rest) == []


def test_a_folder_holds_one_world(tmp_path: Path) -> None:
    project_files.claim(StreetWorld(WorldOptions(seed=1)), tmp_path)
    with pytest.raises(InputError, match="other options"):
        project_files.claim(StreetWorld(WorldOptions(seed=2)), tmp_path)


def test_a_render_task_travels_without_its_world() -> None:
    task = RenderTask(OPTIONS, Path("somewhere"))
    assert task.world.options == OPTIONS
    assert set(task.__getstate__()) == {"options", "folder"}


def test_large_worlds_have_every_camera_and_no_images_in_memory() -> None:
    large = StreetWorld(WorldOptions(seed=1, length_m=300.0, rigs="large", scale=0.1, max_stations=None, handheld=True))
    stations = len(large.trajectories[REFERENCE])
    assert stations > 70
    assert len(large.images_of(REFERENCE)) == 11 * stations
    assert {epoch.campaign for epoch in project_files.new_epochs(large)} >= {"second", "pedestrian_24", "phone"}
    assert len([e for e in project_files.new_epochs(large) if e.campaign == "second"]) == 6
    assert "action" not in project_toml(large)
    assert isinstance(large.trajectories["phone"], Trajectory)


# --- scans and captures ---


def test_a_scan_is_on_the_surfaces_and_in_the_crs(world: StreetWorld, tmp_path: Path) -> None:
    scanner = Scanner(profile_spacing_m=1.0, points_per_profile=300)
    path = write_scan(world, "second", tmp_path, scanner)
    stored: Any = laspy.read(path)
    assert (str(stored.header.version), stored.header.point_format.id) == ("1.4", 7)
    crs = stored.header.parse_crs()
    assert crs is not None
    assert crs.to_epsg() == 25832
    chunks = list(scan(world, "second", scanner))
    noisy, exact = (np.concatenate([getattr(c, n) for c in chunks]) for n in ("points_in_world", "exact_in_world"))
    assert len(stored) == len(noisy) > 3000
    read = world.frame.world_from_crs(np.column_stack([stored.x, stored.y, stored.z]))
    assert np.abs(read - noisy).max() < 1e-3
    assert _within(np.sum(np.square(noisy - exact), axis=1), scanner.range_sigma_m, len(exact))
    assert len(np.unique(stored.red)) > 50
    before = path.stat().st_mtime_ns
    assert write_scan(world, "second", tmp_path, scanner).stat().st_mtime_ns == before


def test_the_scan_of_the_first_epoch_lies_in_the_reference(world: StreetWorld) -> None:
    chunk = next(scan(world, "first", Scanner(profile_spacing_m=1.0, points_per_profile=200, range_sigma_m=1e-9)))
    assert np.allclose(chunk.points_in_world, world.deformation.moved(chunk.exact_in_world), atol=1e-6)
    assert np.linalg.norm(chunk.points_in_world - chunk.exact_in_world, axis=1).max() > 0.002


def test_a_capture_is_laid_out_as_phones_do(world: StreetWorld, tmp_path: Path) -> None:
    phone = Phone(frames=3, scale=0.1)
    walk = write_capture(world, tmp_path / "capture", tmp_path / "truth", phone)
    names = {path.name for path in (tmp_path / "capture").iterdir()}
    assert {"info.json", "frame_00000.json", "frame_00000.jpg", "frame_00002.json", "depth_00002.png"} <= names
    assert "frame_00001.jpg" not in names
    depth_mm = cv2.imread(str(tmp_path / "capture" / "depth_00000.png"), cv2.IMREAD_UNCHANGED)
    sure = cv2.imread(str(tmp_path / "capture" / "conf_00000.png"), cv2.IMREAD_UNCHANGED)
    assert depth_mm is not None
    assert sure is not None
    assert (depth_mm.dtype, depth_mm.shape, sure.max()) == (np.uint16, (192, 256), 2)
    lens, pose = walk.trajectory.rig.lenses["phone"], walk.world_from_cams[0]
    middle = lens.rays(np.array([[100.5 / 256 * lens.width, 150.5 / 192 * lens.height]]))
    hit = world.scene("second").cast(pose.translation, middle @ pose.rotation.T)
    assert abs(depth_mm[150, 100] / 1000.0 - hit.distance_m[0] * middle[0, 2]) < 0.15
    frame = json.loads((tmp_path / "capture" / "frame_00000.json").read_text(encoding="utf-8"))
    matrix = np.array(frame["cameraPoseARFrame"]).reshape(4, 4)
    assert np.allclose(matrix[:3, 3], 0.0)
    assert -matrix[2, 2] < -0.9  # looks along -z,
    assert -0.4 < -matrix[1, 2] < -0.1  # slightly down
    camera = lens.camera
    assert camera is not None
    assert np.isclose(frame["intrinsics"][2], camera.cx - 0.5)


def test_tracking_drifts_as_it_says(world: StreetWorld) -> None:
    phone = Phone(frames=100, scale=0.1)
    truth = session(world, phone).world_from_cams
    walked = np.sum(np.linalg.norm(np.diff([pose.translation for pose in truth], axis=0), axis=1))
    turns = []
    for i in range(RUNS):
        found = tracked(truth, phone, np.random.default_rng([7, i]))
        relative = found[0].rotation.T @ found[-1].rotation @ (truth[0].rotation.T @ truth[-1].rotation).T
        turns.append(np.linalg.norm(log_so3(relative)))
    expected = np.radians(np.hypot(phone.yaw_drift_deg * np.sqrt(walked), 2.0 * phone.tilt_deg))
    assert 0.7 * expected < np.sqrt(np.mean(np.square(turns))) < 1.4 * expected
