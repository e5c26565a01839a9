"""The street for evaluations: what is delivered, and that tables and truth say what was rendered."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from georef.errors import ConfigError, InputError
from georef.features.images import read_image
from georef.features.panorama import cut_head
from georef.geometry.angles import rotation_from_yaw_pitch_roll
from georef.geometry.panorama import RIG_FROM_PANO, directions_from_head, head_from_directions
from georef.geometry.rigid import Rigid3, log_so3
from georef.io.exif import size_and_focal
from georef.io.exterior_orientation import read_exterior_orientation
from georef.project import Project, open_project
from georef.simulate.evaluation import (
    PANORAMAS,
    REFERENCES,
    EvaluationOptions,
    EvaluationWorld,
    declared_heads,
    drawn_positions,
    evaluation_options,
    panorama_heads,
)
from georef.simulate.evaluation_files import PRIORS, project_toml, write_evaluation_images, write_evaluation_tables
from georef.simulate.evaluation_images import panorama_layout, products
from georef.simulate.project_files import TRUTH
from georef.simulate.tables import position_table
from georef.simulate.world import small_options
from georef.stages.demo import demo_options
from georef.stages.survey import load_survey

SMALL = EvaluationOptions(2, 40.0, scale=0.12, max_stations=2, new_stations=1, panorama_stations=1)


@pytest.fixture(scope="module")
def world() -> EvaluationWorld:
    return EvaluationWorld(SMALL)


@pytest.fixture(scope="module")
def folder(world: EvaluationWorld, tmp_path_factory: pytest.TempPathFactory) -> Path:
    where = tmp_path_factory.mktemp("street") / "data"
    write_evaluation_tables(world, where)
    made = write_evaluation_images(world, where)
    assert sorted(made) == sorted(p.file for p in products(world))
    return where


@pytest.fixture(scope="module")
def project(folder: Path) -> Project:
    return open_project(folder, output=folder.parent / "results")


def test_the_common_demo_is_the_street_that_it_was() -> None:
    """Its images are kept under this name in many caches."""
    assert small_options(0).fingerprint == demo_options(0, 1.0, large=False).fingerprint == "4f0314a7dc1ce01b"
    assert demo_options(0, 1.0, large=False, evaluation=True) == evaluation_options(0)
    with pytest.raises(ConfigError, match="two different streets"):
        demo_options(0, 1.0, large=True, evaluation=True)


def test_every_epoch_is_an_ordinary_one(project: Project, world: EvaluationWorld) -> None:
    models = {}
    for epoch in project.file.epochs:
        survey = load_survey(project, epoch)
        assert {image.epoch for image in survey.reference.images} == set(REFERENCES)
        assert len(survey.reference.images) == 2 * 2 * 3 + 5  # two references of three cameras, and five heads
        models[epoch] = {(i.camera.model, i.camera.estimate) for i in survey.epoch.images}
        assert all(image.gnss is not None for image in survey.epoch.images)
    assert models == {
        "vehicle": {("brown", ())},
        "vehicle_undistorted": {("pinhole", ())},
        "fisheye": {("fisheye", ())},
        "phone": {("brown", ("focal", "k1", "cx", "cy"))},
        "phone_rolled": {("brown", ())},
        "panorama": {("pinhole", ())},
    }


def test_weaker_positions_are_a_matter_of_one_key(folder: Path) -> None:
    setting = "epochs.vehicle.gnss=vehicle_gnss_100m.csv"
    survey = load_survey(open_project(folder, settings=(setting,)), "vehicle")
    gnss = survey.epoch.images[0].gnss
    assert gnss is not None
    assert np.sqrt(gnss.cov[0, 0]) == pytest.approx(100.0, rel=1e-3)


@pytest.mark.parametrize("ending", PRIORS)
def test_positions_and_headings_are_as_wrong_as_is_stated(world: EvaluationWorld, ending: str) -> None:
    """Two-sided, 99.9 % of chi-square with 3 x 600 and 600 degrees of freedom."""
    system = PRIORS[ending]
    pose = world.images_of("vehicle")[0].world_from_cam
    positions, headings = drawn_positions(world, [pose] * 600, system, f"test{ending}")
    errors = (np.array(positions) - pose.translation) / system.sigmas_m
    assert 0.89 < np.mean(np.square(errors)) < 1.12
    exact = np.degrees(np.arctan2(pose.rotation[0, 2], pose.rotation[1, 2]))
    turns = (np.array(headings) - exact + 180.0) % 360.0 - 180.0
    assert 0.82 < np.mean(np.square(turns / system.heading_deg)) < 1.2


def test_the_truth_has_each_image_that_results_name(project: Project, world: EvaluationWorld, folder: Path) -> None:
    """Poses of the heads of panoramas are those at which their pictures were rendered."""
    for epoch in project.file.epochs:
        survey = load_survey(project, epoch)
        path = folder / TRUTH / f"{epoch}_eo.csv"
        table = read_exterior_orientation(path, crs_kind="projected", angles="omega-phi-kappa", angle_unit="deg")
        assert sorted(table.image_ids) == sorted(image.image_id for image in survey.epoch.images)
    rendered = {f"{i.campaign}_{i.station:04d}.jpg/{i.head.name}": i for i in world.images_of("panorama")}
    path = folder / TRUTH / "panorama_eo.csv"
    table = read_exterior_orientation(path, crs_kind="projected", angles="omega-phi-kappa", angle_unit="deg")
    for name, position in zip(table.image_ids, world.frame.world_from_crs(table.positions_in_crs), strict=True):
        assert position == pytest.approx(rendered[name].world_from_cam.translation, abs=2e-5)


def test_references_are_off_by_what_the_project_states(project: Project, world: EvaluationWorld) -> None:
    """Against the exact poses as the smooth error of the reference moves them; heads with their panorama."""
    survey = load_survey(project, "vehicle")
    moved = {i.image_id: world.deformation.moved_pose(i.world_from_cam) for c in REFERENCES for i in world.images_of(c)}
    shift = survey.world.world_from_crs(world.frame.crs_from_world(np.zeros((1, 3))))[0]  # two origins, one street
    turn = survey.world.crs_axes_from_world(world.frame.crs_from_world(np.zeros((1, 3))))[0]
    own = world.frame.crs_axes_from_world(world.frame.crs_from_world(np.zeros((1, 3))))[0]
    positions, rotations = [], []
    for image in survey.reference.images:
        if image.epoch in PANORAMAS:
            continue
        pose, exact = image.world_from_cam, moved[Path(image.image_id).name]
        assert pose is not None
        positions.append((own.T @ turn) @ (pose.translation - shift) - exact.translation)
        rotations.append(np.degrees(log_so3(exact.rotation.T @ (own.T @ turn) @ pose.rotation)))
    assert 0.003 < np.sqrt(np.mean(np.square(positions))) < 0.008  # 5 mm
    assert 0.006 < np.sqrt(np.mean(np.square(rotations))) < 0.016  # 0.01 deg


@pytest.mark.parametrize("campaign", PANORAMAS)
def test_heads_cut_from_a_panorama_are_the_pictures_it_was_made_of(
    world: EvaluationWorld, folder: Path, campaign: str
) -> None:
    """Parallax between the heads included: it is what the radius of stitching undoes."""
    rig = world.rigs[campaign]
    product = next(p for p in products(world) if p.epoch == campaign)
    panorama = read_image(folder / product.file)
    projection, size = panorama_layout(campaign, panorama_heads(rig))
    assert (panorama.shape[1], panorama.shape[0]) == size
    for whole, head in zip(panorama_heads(rig), declared_heads(rig), strict=True):
        rendered = world.render_image(f"{campaign}_0000_{head.name}.jpg").astype(float)
        left = round(whole.camera.cx - head.camera.cx)
        kept = rendered[4:-4, left + 2 : left + head.camera.width - 2]
        cut = cut_head(panorama, projection, head).astype(float)[4:-4, 2:-2]
        assert np.corrcoef(cut.ravel(), kept.ravel())[0, 1] > 0.97
        aside = rendered[4:-4, left : left + head.camera.width - 4]
        assert np.abs(cut - kept).mean() < np.abs(cut - aside).mean()  # two pixels aside fit worse


def test_the_stitched_seams_stand_outside_of_the_declared_heads(world: EvaluationWorld) -> None:
    rig = world.rigs["panorama"]
    for number, head in enumerate(declared_heads(rig)):
        c = head.camera
        middle = np.array([[0.0, c.cy], [c.width, c.cy]])
        ways = directions_from_head(head, middle)
        own = ways @ panorama_heads(rig)[number].pano_from_head.rotation[:, 2]
        others = [ways @ h.pano_from_head.rotation[:, 2] for k, h in enumerate(panorama_heads(rig)) if k != number]
        assert np.all(own > np.max(others, axis=0))
        assert np.isfinite(head_from_directions(head, ways)).all()


def test_the_phone_says_its_focal_length_to_a_millimetre_and_nothing_else(world: EvaluationWorld, folder: Path) -> None:
    product = next(p for p in products(world) if p.epoch == "phone")
    lens = world.images[product.image_id].lens
    assert lens.camera is not None
    focal = size_and_focal(folder / product.file)[1]
    assert focal == pytest.approx(lens.camera.fx, rel=0.03)
    assert focal != pytest.approx(lens.camera.fx, rel=1e-4)
    assert not (folder / "cameras_phone.csv").exists()
    assert size_and_focal(folder / next(p.file for p in products(world) if p.epoch == "vehicle"))[1] is None


def test_an_interrupted_writing_goes_on(world: EvaluationWorld, folder: Path) -> None:
    lost = folder / next(p.file for p in products(world) if p.epoch == "fisheye")
    before = lost.read_bytes()
    lost.unlink()
    assert write_evaluation_images(world, folder) == [lost.relative_to(folder).as_posix()]
    assert lost.read_bytes() == before
    assert write_evaluation_images(world, folder) == []
    with pytest.raises(InputError, match="other options"):
        write_evaluation_tables(EvaluationWorld(replace(SMALL, seed=3)), folder)


def test_the_rig_is_off_by_what_its_table_states_and_its_images_have_stations(
    project: Project, world: EvaluationWorld
) -> None:
    survey = load_survey(project, "vehicle")
    heads = {world.rigs["vehicle"].lenses[head.name].name: head for head in world.rigs["vehicle"].heads}
    middle = Rigid3(RIG_FROM_PANO, np.zeros(3))
    for image in survey.epoch.images:
        mounting = survey.epoch.mountings[image.image_id]
        assert mounting.cov is not None
        error = heads[mounting.camera].rig_from_cam.local(middle @ mounting.rig_from_cam)
        assert 0.2 < error @ np.linalg.solve(mounting.cov, error) / 6 < 4.0
    stations = {image.station for image in survey.epoch.images}
    assert len(stations) == SMALL.new_stations
    assert len(survey.epoch.images) == 2 * len(stations)


def test_tables_of_an_older_version_are_written_again(world: EvaluationWorld, tmp_path: Path) -> None:
    write_evaluation_tables(world, tmp_path / "data")
    done = tmp_path / "data" / TRUTH / "complete.json"
    done.write_text('{"fingerprint": "of before"}', encoding="utf-8")
    rig, positions = (tmp_path / "data" / name for name in ("rig.csv", "vehicle_gnss.csv"))
    before = positions.read_text(encoding="utf-8")
    rig.unlink()
    write_evaluation_tables(world, tmp_path / "data")
    assert rig.is_file()
    assert positions.read_text(encoding="utf-8") == before


def test_the_project_in_the_repository_is_the_one_that_is_written() -> None:
    written = (Path(__file__).parents[2] / "projects" / "evaluation" / "project.toml").read_text(encoding="utf-8")
    assert written == project_toml(EvaluationWorld(evaluation_options(0)))


def test_a_view_straight_down_has_an_empty_heading(world: EvaluationWorld) -> None:
    rotations = [rotation_from_yaw_pitch_roll(np.radians([30.0, pitch_deg, 0.0])) for pitch_deg in (0.0, -90.0)]
    poses = [Rigid3(rotation, np.zeros(3)) for rotation in rotations]
    system = next(iter(PRIORS.values()))
    positions, headings = drawn_positions(world, poses, system, "down")
    text = position_table(dict(zip("ab", positions, strict=True)), system.sigmas_m, headings, {}, world.frame)
    level, down = text.splitlines()[-2:]
    assert float(level.rsplit(",", 1)[1]) == pytest.approx(headings[0], abs=0.01)
    assert down.endswith(",")
