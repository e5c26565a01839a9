"""pycolmap's bundle adjustment (Ceres) of a block: one pose a station by its rigs and frames, one thread."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal, cast

import numpy as np

from georef.benchmarks.adjustment_problem import Size
from georef.estimation.adjustment.block import Block, State
from georef.geometry.camera import Camera
from georef.geometry.poses import Poses
from georef.geometry.rigid import Rigid3

if TYPE_CHECKING:
    import pycolmap

LinearSolver = Literal["direct", "iterative"]
"""Of the reduced equations: a sparse factor of the Schur complement, or conjugate gradients with its blocks of single
stations as preconditioner."""
_MODELS = {"brown": "RADIAL", "fisheye": "RADIAL_FISHEYE"}  # f, cx, cy, k1, k2
_RIG = 1


@dataclass(frozen=True, eq=False)
class Solved:
    """A solution and what it cost; seconds are CPU-seconds."""

    state: State
    iterations: int
    setup_s: float
    solve_s: float
    converged: bool


def solve_with_ceres(
    block: Block, size: Size, *, max_iterations: int, cost_tolerance: float, linear: LinearSolver
) -> Solved:
    """Adjusts all poses but the held ones and all points. Setup is the building of both the model and the problem."""
    import pycolmap

    begin = time.process_time()
    model = _model(block)
    config = pycolmap.BundleAdjustmentConfig()
    for image in range(len(block.image_ids)):
        config.add_image(image + 1)
    for station in size.held:
        config.set_constant_rig_from_world_pose(int(station) + 1)
    adjuster = pycolmap.create_default_ceres_bundle_adjuster(
        _options(size, max_iterations, cost_tolerance, linear), config, model
    )
    ready = time.process_time()
    done = cast("pycolmap.CeresBundleAdjustmentSummary", adjuster.solve()).ceres_summary
    solved = time.process_time()
    iterations = done.num_successful_steps + done.num_unsuccessful_steps - 1  # the start counts as a step
    converged = done.termination_type.name == "CONVERGENCE"
    return Solved(_state(block, model), iterations, ready - begin, solved - ready, converged)


def _options(
    size: Size, max_iterations: int, tolerance: float, linear: LinearSolver
) -> pycolmap.BundleAdjustmentOptions:
    import pycolmap

    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = options.refine_sensor_from_rig = False
    options.refine_focal_length = options.refine_principal_point = options.refine_extra_params = size.free_calibrations
    solver = options.ceres.solver_options
    solver.num_threads, solver.max_num_iterations, solver.function_tolerance = 1, max_iterations, tolerance
    options.ceres.auto_select_solver_type = False
    kind, preconditioner = type(solver.linear_solver_type), type(solver.preconditioner_type)
    solver.linear_solver_type = kind.SPARSE_SCHUR if linear == "direct" else kind.ITERATIVE_SCHUR
    if linear == "iterative":
        solver.preconditioner_type = preconditioner.SCHUR_JACOBI
    return options


def _model(block: Block) -> pycolmap.Reconstruction:
    """The block as pycolmap has it: the frame of the rig is that of its first camera."""
    import pycolmap

    model, heads = pycolmap.Reconstruction(), len(block.mountings)
    rig = pycolmap.Rig(rig_id=_RIG)
    first = block.mountings[0].rig_from_cam
    for number, (mounting, calibration) in enumerate(zip(block.mountings, block.calibrations, strict=True), start=1):
        camera = _camera(calibration.camera, number)
        model.add_camera(camera)
        if number == 1:
            rig.add_ref_sensor(camera.sensor_id)
        else:
            rig.add_sensor(camera.sensor_id, _rigid(mounting.rig_from_cam.inverse() @ first))
    model.add_rig(rig)
    _add_images(block, model, heads, first)
    _add_points(block, model)
    return model


def _add_images(block: Block, model: pycolmap.Reconstruction, heads: int, first: Rigid3) -> None:
    import pycolmap

    seen = block.observations
    order = np.argsort(seen.view, kind="stable")
    begins = np.searchsorted(seen.view[order], np.arange(len(block.image_ids) + 1))
    for station in range(len(block.station_ids)):
        frame = pycolmap.Frame(frame_id=station + 1, rig_id=_RIG)
        numbers = range(station * heads, (station + 1) * heads)
        for image in numbers:
            frame.add_data_id(
                pycolmap.data_t(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, image % heads + 1), image + 1)
            )
        frame.rig_from_world = _rigid((block.world_from_rig[station] @ first).inverse())
        model.add_frame(frame)
        for image in numbers:
            rows = order[begins[image] : begins[image + 1]]
            added = pycolmap.Image(block.image_ids[image], seen.pixel[rows], image % heads + 1, image + 1)
            added.frame_id = station + 1
            model.add_image(added)
        model.register_frame(station + 1)


def _add_points(block: Block, model: pycolmap.Reconstruction) -> None:
    """Points in their order, so that point i has number i + 1."""
    import pycolmap

    seen = block.observations
    order = np.argsort(seen.view, kind="stable")
    begins = np.searchsorted(seen.view[order], np.arange(len(block.image_ids) + 1))
    place = np.empty(len(order), np.int64)
    place[order] = np.arange(len(order)) - begins[seen.view[order]]
    rows = np.argsort(seen.point, kind="stable")
    ends = np.searchsorted(seen.point[rows], np.arange(len(block.points) + 1))
    for point, xyz in enumerate(block.points):
        mine = rows[ends[point] : ends[point + 1]]
        elements = [
            pycolmap.TrackElement(int(image) + 1, int(at))
            for image, at in zip(seen.view[mine], place[mine], strict=True)
        ]
        number = model.add_point3D(xyz, pycolmap.Track(elements))
        assert number == point + 1, "pycolmap numbers points in their order"


def _camera(camera: Camera, number: int) -> pycolmap.Camera:
    import pycolmap

    assert camera.fx == camera.fy, "pycolmap's model has one focal length"
    assert not np.any(camera.coefficients[2:]), "and two coefficients"
    values = [camera.fx, camera.cx, camera.cy, *camera.coefficients[:2]]
    model = _MODELS[camera.model]
    return pycolmap.Camera(camera_id=number, model=model, width=camera.width, height=camera.height, params=values)


def _state(block: Block, model: pycolmap.Reconstruction) -> State:
    first = block.mountings[0].rig_from_cam.inverse()
    placed = [model.frames[i + 1].rig_from_world for i in range(len(block.station_ids))]
    poses = [_from_colmap(pose).inverse() @ first for pose in placed if pose is not None]
    points = np.array([model.points3D[i + 1].xyz for i in range(len(block.points))])
    cameras = []
    for number, calibration in enumerate(block.calibrations, start=1):
        f, cx, cy, k1, k2 = (float(v) for v in model.cameras[number].params)
        cameras.append(replace(calibration.camera, fx=f, fy=f, cx=cx, cy=cy, distortion=(k1, k2, 0.0, 0.0)))
    return replace(block.start(), world_from_rig=Poses.of(poses), points=points, cameras=tuple(cameras))


def _rigid(pose: Rigid3) -> pycolmap.Rigid3d:
    import pycolmap

    return pycolmap.Rigid3d(pycolmap.Rotation3d(pose.rotation), pose.translation)


def _from_colmap(pose: pycolmap.Rigid3d) -> Rigid3:
    return Rigid3(np.asarray(pose.rotation.matrix()), np.asarray(pose.translation))
