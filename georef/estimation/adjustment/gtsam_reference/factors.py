"""Factors of GTSAM for what a block observes, one by one: native ones where GTSAM has them, else Python functions.

Derivatives of the latter are chained from those of gtsam.Pose3 and of the camera, independently of the vectorised
ones. A mounting or lever arm is a key where it is unknown, its value where it is held.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import gtsam
import gtsam_unstable
import numpy as np

from georef.estimation.adjustment.equations.constraint_terms import root
from georef.geometry.camera import Camera, intrinsic_derivatives
from georef.geometry.rigid import Array

Evaluate = Callable[[gtsam.Values], tuple[Array, list[Array]]]  # residual (m,), derivatives (m, s) in order of keys
Difference = Callable[[gtsam.Values], tuple[Array, Array]]  # from what was given (s,), its derivative (s, s)
Noise = gtsam.noiseModel.Base
_CALIBRATIONS = {"pinhole": gtsam.Cal3_S2, "brown": gtsam.Cal3DS2, "fisheye": gtsam.Cal3Fisheye}
_ON_RIG = {
    "pinhole": gtsam.GenericProjectionFactorCal3_S2,
    "brown": gtsam.GenericProjectionFactorCal3DS2,
    "fisheye": gtsam.GenericProjectionFactorCal3Fisheye,
}
_ON_UNKNOWN_MOUNTING = {
    "pinhole": gtsam_unstable.ProjectionFactorPPPCal3_S2,
    "brown": gtsam_unstable.ProjectionFactorPPPCal3DS2,
    "fisheye": gtsam_unstable.ProjectionFactorPPPCal3Fisheye,
}


@dataclass(frozen=True)
class Lens:
    """A camera, or one whose named parameters are the vector of steps from it that a key stands for."""

    start: Camera
    key: int | None = None

    @property
    def unknown(self) -> tuple[str, ...]:
        return () if self.key is None else self.start.estimate

    def at(self, values: gtsam.Values) -> Camera:
        return self.start if self.key is None else self.start.changed(self.unknown, values.atVector(self.key))

    def by_step(self, camera: Camera, in_cam: Array) -> Array:
        """Derivatives (2, q) of a pixel by the vector of steps, at a camera that these have led to."""
        by_next = intrinsic_derivatives(camera, in_cam[None], self.unknown)[0]
        return by_next * [step_rate(self.start, camera, name) for name in self.unknown]


def step_rate(start: Camera, camera: Camera, name: str) -> float:
    """How far one unit more of the steps from one camera moves another, in its own steps."""
    return 1.0 if name in ("focal", "aspect") else start.unit(name) / camera.unit(name)


def custom(keys: Sequence[int], noise: Noise, evaluate: Evaluate) -> gtsam.CustomFactor:
    """A factor of a function that gives the residual and the derivatives by what its keys stand for."""

    def error(_factor: object, values: gtsam.Values, jacobians: list[Array] | None) -> Array:
        residual, by_key = evaluate(values)
        if jacobians is not None:
            for place, by in enumerate(by_key):
                jacobians[place] = np.asfortranarray(by)
        return residual

    return gtsam.CustomFactor(noise, list(keys), error)


# --- image observations ---------------------------------------------------------------------------


def has_native(camera: Camera, depth: float) -> bool:
    """Whether GTSAM has the camera, for a point at a depth along its axis (of unit distance)."""
    if camera.model == "fisheye":
        return depth > 0.25  # GTSAM's fisheye is exact in front of the camera only, and points may move
    return camera.model == "pinhole" or (camera.model == "brown" and camera.coefficients[4] == 0.0)


def native_calibration(camera: Camera) -> gtsam.Cal3_S2 | gtsam.Cal3DS2 | gtsam.Cal3Fisheye:
    plain = (camera.fx, camera.fy, 0.0, camera.cx, camera.cy)
    coefficients = () if camera.model == "pinhole" else (float(k) for k in camera.coefficients[:4])
    return _CALIBRATIONS[camera.model](*plain, *coefficients)


def native_observation(
    pixel: Array, noise: Noise, station: int, mounting: int | gtsam.Pose3, camera: Camera, point: int
) -> gtsam.NonlinearFactor:
    calibration = native_calibration(camera)
    if isinstance(mounting, gtsam.Pose3):
        return _ON_RIG[camera.model](pixel, noise, station, point, calibration, mounting)
    return _ON_UNKNOWN_MOUNTING[camera.model](pixel, noise, station, mounting, point, calibration)


def custom_observation(
    pixel: Array, noise: Noise, station: int, mounting: int | gtsam.Pose3, lens: Lens, point: int
) -> gtsam.CustomFactor:
    """Where the lens no longer shows the point the observation says nothing."""

    def evaluate(values: gtsam.Values) -> tuple[Array, list[Array]]:
        world_from_cam, by_station, by_mounting = _composed(values, station, mounting)
        by_pose, by_point = np.zeros((3, 6), order="F"), np.zeros((3, 3), order="F")
        in_cam = world_from_cam.transformTo(values.atPoint3(point), by_pose, by_point)
        camera = lens.at(values)
        image, by_cam, _ = camera.lens.derivatives(in_cam[None], camera.coefficients, np.asarray(camera.limit))
        focal = np.array([camera.fx, camera.fy])
        by_cam = by_cam[0] * focal[:, None]
        derivatives = [by_cam @ by_pose @ by_station]
        if isinstance(mounting, int):
            derivatives.append(by_cam @ by_pose @ by_mounting)
        if lens.key is not None:
            derivatives.append(lens.by_step(camera, in_cam))
        derivatives.append(by_cam @ by_point)
        residual = image[0] * focal + [camera.cx, camera.cy] - pixel
        if not np.isfinite(residual).all():
            return np.zeros(2), [np.zeros_like(d) for d in derivatives]
        return residual, derivatives

    middle = [mounting] if isinstance(mounting, int) else []
    return custom([station, *middle, *([] if lens.key is None else [lens.key]), point], noise, evaluate)


def _composed(values: gtsam.Values, station: int, mounting: int | gtsam.Pose3) -> tuple[gtsam.Pose3, Array, Array]:
    """world_from_cam and its derivatives (6, 6) by the station and by the mounting."""
    by_station, by_mounting = np.zeros((6, 6), order="F"), np.zeros((6, 6), order="F")
    rig_from_cam = values.atPose3(mounting) if isinstance(mounting, int) else mounting
    return values.atPose3(station).compose(rig_from_cam, by_station, by_mounting), by_station, by_mounting


# --- poses ----------------------------------------------------------------------------------------


def _difference(given: gtsam.Pose3, pose: gtsam.Pose3) -> tuple[Array, Array]:
    """log(given^-1 pose) and its derivative (6, 6) by the pose."""
    by_first, by_pose, by_between = (np.zeros((6, 6), order="F") for _ in range(3))
    residual = gtsam.Pose3.Logmap(given.between(pose, by_first, by_pose), by_between)
    return residual, by_between @ by_pose


def pose_prior(given: gtsam.Pose3, noise: Noise, station: int, mounting: int | gtsam.Pose3) -> gtsam.CustomFactor:
    """GTSAM's own prior takes its derivative for the identity, which is true at the prior only."""

    def evaluate(values: gtsam.Values) -> tuple[Array, list[Array]]:
        pose, by_station, by_mounting = _composed(values, station, mounting)
        residual, by_pose = _difference(given, pose)
        return residual, [by_pose @ by_station, *([by_pose @ by_mounting] if isinstance(mounting, int) else [])]

    return custom([station, *([mounting] if isinstance(mounting, int) else [])], noise, evaluate)


def relative_pose(a_from_b: gtsam.Pose3, noise: Noise, a: int, b: int) -> gtsam.CustomFactor:
    def evaluate(values: gtsam.Values) -> tuple[Array, list[Array]]:
        by_a, by_b = np.zeros((6, 6), order="F"), np.zeros((6, 6), order="F")
        between = values.atPose3(a).between(values.atPose3(b), by_a, by_b)
        residual, by_between = _difference(a_from_b, between)
        return residual, [by_between @ by_a, by_between @ by_b]

    return custom([a, b], noise, evaluate)


# --- positions ------------------------------------------------------------------------------------


def antenna_position(
    position: Array, noise: Noise, station: int, lever_m: int | Array, drift: Sequence[tuple[int, float]]
) -> gtsam.NonlinearFactor:
    """drift: keys of nodes, each with its weight."""
    if not drift and isinstance(lever_m, int):
        return gtsam.GPSFactorArmCalib(station, lever_m, position, noise)
    if not drift:
        return gtsam.GPSFactorArm(station, position, lever_m, noise)

    def evaluate(values: gtsam.Values) -> tuple[Array, list[Array]]:
        by_station, by_lever = np.zeros((3, 6), order="F"), np.zeros((3, 3), order="F")
        lever = values.atPoint3(lever_m) if isinstance(lever_m, int) else lever_m
        antenna = values.atPose3(station).transformFrom(lever, by_station, by_lever)
        shift = np.sum([weight * values.atPoint3(node) for node, weight in drift], axis=0)
        middle = [by_lever] if isinstance(lever_m, int) else []
        return antenna + shift - position, [by_station, *middle, *(weight * np.eye(3) for _, weight in drift)]

    middle = [lever_m] if isinstance(lever_m, int) else []
    return custom([station, *middle, *(node for node, _ in drift)], noise, evaluate)


# --- weights about given values -------------------------------------------------------------------


def weighted(
    key: int, information: Array, difference: Difference, robust: Callable[[Noise], Noise]
) -> gtsam.CustomFactor | None:
    """A weight of any rank on a difference from what was given; None of rank 0."""
    weight = root(information[None])[0]
    weight = weight[np.abs(weight).max(axis=1) > 0.0]
    if not len(weight):
        return None

    def evaluate(values: gtsam.Values) -> tuple[Array, list[Array]]:
        residual, by_key = difference(values)
        return weight @ residual, [weight @ by_key]

    return custom([key], robust(gtsam.noiseModel.Unit.Create(len(weight))), evaluate)


def from_vector(key: int, given: Array) -> Difference:
    return lambda values: (values.atPoint3(key) - given, np.eye(3))


def from_pose(key: int, given: gtsam.Pose3) -> Difference:
    return lambda values: _difference(given, values.atPose3(key))


def from_camera(lens: Lens, given: Camera) -> Difference:
    def difference(values: gtsam.Values) -> tuple[Array, Array]:
        rates = [step_rate(lens.start, given, name) for name in lens.unknown]
        return lens.at(values).steps_since(given, lens.unknown), np.diag(rates)

    return difference
