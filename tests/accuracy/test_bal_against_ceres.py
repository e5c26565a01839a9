"""Problem files of Bundle Adjustment in the Large: the final cost is that of pycolmap's Ceres from the same start."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from georef.geometry.poses import exp_so3
from georef.geometry.rigid import Array
from georef.io.bal import BalProblem, read_bal, write_bal
from georef.stages.bal import run_bal

pycolmap = pytest.importorskip("pycolmap")


def _ceres_cost(problem: BalProblem) -> float:
    """Half the sum of squared residuals (px^2) where Ceres ends: own focal length, k1, k2 of each camera."""
    model, pixels, (width, height) = pycolmap.Reconstruction(), problem.pixels, problem.size
    from_world = problem.world_from_cam.inverse()
    place = np.empty(len(problem.camera), np.int64)
    for index, values in enumerate(problem.cameras):
        rows = np.flatnonzero(problem.camera == index)
        place[rows] = np.arange(len(rows))
        params = [values[6], width / 2.0, height / 2.0, values[7], values[8]]
        model.add_camera_with_trivial_rig(
            pycolmap.Camera(camera_id=index + 1, model="RADIAL", width=width, height=height, params=params)
        )
        image = pycolmap.Image(str(index), pixels[rows], index + 1, index + 1)
        pose = np.column_stack([from_world.rotation[index], from_world.translation[index]])
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose))
    for index, xyz in enumerate(problem.points):
        rows = np.flatnonzero(problem.point == index)
        track = [pycolmap.TrackElement(int(problem.camera[i]) + 1, int(place[i])) for i in rows]
        model.add_point3D(xyz, pycolmap.Track(track))
    options, config = pycolmap.BundleAdjustmentOptions(), pycolmap.BundleAdjustmentConfig()
    options.print_summary = options.refine_principal_point = False
    options.refine_focal_length = options.refine_extra_params = True
    solver = options.ceres.solver_options
    solver.num_threads, solver.max_num_iterations, solver.function_tolerance = 1, 200, 1e-10
    for index in range(len(problem.cameras)):
        config.add_image(index + 1)
    summary = pycolmap.create_default_ceres_bundle_adjuster(options, config, model).solve()
    return float(summary.ceres_summary.final_cost)


def _generated(seed: int) -> BalProblem:
    """Twelve cameras on an arc before 400 points, keypoints of 0.7 px, approximate values some way off."""
    rng = np.random.default_rng(seed)
    count, points = 12, rng.uniform(-1.0, 1.0, (400, 3)) * [6.0, 4.0, 3.0]
    angle = np.linspace(-0.7, 0.7, count)
    turn = np.column_stack([0.05 * rng.normal(size=count), -angle, 0.05 * rng.normal(size=count)])
    shift = np.column_stack([0.3 * rng.normal(size=(count, 2)), np.full(count, -20.0)])
    inner = np.column_stack([rng.uniform(900.0, 1100.0, count), np.full(count, -0.05), np.full(count, 0.01)])
    cameras = np.concatenate([turn, shift, inner], axis=1)
    camera, point = (index.ravel() for index in np.indices((count, len(points))))
    seen = (rng.random(len(camera)) < 0.5) | (camera % 6 == 0)  # two cameras see all
    camera, point = camera[seen], point[seen]
    xy = _pixels(cameras[camera], points[point]) + 0.7 * rng.normal(size=(len(camera), 2))
    off = rng.normal(size=cameras.shape) * [*[0.01] * 3, *[0.1] * 3, 20.0, 0.01, 0.002]
    return BalProblem(camera, point, xy, cameras + off, points + 0.1 * rng.normal(size=points.shape))


def _pixels(cameras: Array, points: Array) -> Array:
    p = np.einsum("nij,nj->ni", exp_so3(cameras[:, :3]), points) + cameras[:, 3:6]
    slope = -p[:, :2] / p[:, 2:]
    square = np.sum(np.square(slope), axis=1, keepdims=True)
    return cameras[:, 6:7] * (1.0 + cameras[:, 7:8] * square + cameras[:, 8:9] * square**2) * slope


@pytest.mark.parametrize("seed", [1, 2])
def test_a_generated_file(tmp_path: Path, seed: int) -> None:
    path = tmp_path / "problem.txt"
    write_bal(_generated(seed), path)
    ours, theirs = run_bal(path, None), _ceres_cost(read_bal(path))
    assert ours.converged
    assert ours.first_cost > 100.0 * ours.cost
    assert 0.99 * theirs < ours.cost <= 1.001 * theirs
    redundancy = 2 * len(ours.problem.camera) - 3 * len(ours.problem.points) - 9 * len(ours.problem.cameras) + 7
    assert ours.cost == pytest.approx(0.5 * redundancy * 0.7**2, rel=0.1)


def test_dubrovnik(georef_data: Path) -> None:
    """16 cameras, 22,106 points, 83,718 observations."""
    path = georef_data / "bal" / "problem-16-22106-pre.txt"
    ours, theirs = run_bal(path, None), _ceres_cost(read_bal(path))
    assert ours.converged
    assert 0.99 * theirs < ours.cost <= 1.001 * theirs
