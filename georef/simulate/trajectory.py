"""Trajectories: where a rig truly was at each trigger, and what its GNSS and IMU say.

Smooth processes are sums of sinusoids of random frequency (random Fourier features of the squared-exponential kernel,
Rahimi and Recht 2007): Gaussian over seeds, evaluated at any place without a history, with an exact derivative.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from georef.geometry.rigid import Array, Rigid3, exp_so3
from georef.simulate.axis import Axis
from georef.simulate.rigs import Rig

_WAVES = 64
SPEED_MPS, WALKING_MPS = 8.0, 1.3


@dataclass(frozen=True, eq=False)
class SmoothProcess:
    """Smooth Gaussian errors (dimensions) along a street: 1-sigma each, correlated over a length."""

    amplitude: Array  # (D, K)
    frequency: Array  # (D, K) rad/m
    phase: Array  # (D, K)

    @staticmethod
    def draw(rng: np.random.Generator, sigmas: Array | list[float], length_m: float) -> SmoothProcess:
        sigma = np.asarray(sigmas, dtype=np.float64)
        shape = (len(sigma), _WAVES)
        amplitude = sigma[:, None] * rng.rayleigh(1.0, shape) / np.sqrt(_WAVES)
        return SmoothProcess(amplitude, rng.normal(size=shape) / length_m, rng.uniform(0.0, 2.0 * np.pi, shape))

    def at(self, s_m: Array) -> Array:
        """Values (N, D) at places (N,) along the street."""
        turns = np.asarray(s_m)[:, None, None] * self.frequency + self.phase
        return np.sum(self.amplitude * np.cos(turns), axis=2)

    def slope(self, s_m: Array) -> Array:
        """Derivatives (N, D) by the place, per metre."""
        turns = np.asarray(s_m)[:, None, None] * self.frequency + self.phase
        return -np.sum(self.amplitude * self.frequency * np.sin(turns), axis=2)


@dataclass(frozen=True, eq=False)
class Trajectory:
    """True poses of a rig at its triggers."""

    rig: Rig
    s_m: Array  # (N,) along the axis of the street
    time_s: Array  # (N,)
    world_from_rigs: tuple[Rigid3, ...]

    def __len__(self) -> int:
        return len(self.s_m)


@dataclass(frozen=True)
class Wander:
    """How a rig strays from its path: 1-sigma and correlation length of each motion."""

    lateral: tuple[float, float] = (0.12, 25.0)  # m, m
    bounce: tuple[float, float] = (0.012, 6.0)
    yaw_deg: tuple[float, float] = (0.4, 12.0)
    pitch_deg: tuple[float, float] = (0.5, 7.0)
    roll_deg: tuple[float, float] = (0.6, 9.0)
    spacing_m: float = 0.08  # of each trigger, 1-sigma


WALKING = Wander((0.15, 4.0), (0.03, 1.2), (5.0, 3.0), (2.5, 2.0), (2.0, 2.0), 0.1)


@dataclass(frozen=True, eq=False)
class Motion:
    """The true way of a rig, at every place along the street."""

    axis: Axis
    rig: Rig
    lateral: SmoothProcess
    bounce: SmoothProcess
    turns_deg: tuple[SmoothProcess, SmoothProcess, SmoothProcess]  # yaw, pitch, roll

    @staticmethod
    def draw(axis: Axis, rig: Rig, rng: np.random.Generator) -> Motion:
        wander = WALKING if rig.handheld else Wander()
        motions = (wander.lateral, wander.bounce, wander.yaw_deg, wander.pitch_deg, wander.roll_deg)
        lateral, bounce, yaw, pitch, roll = (SmoothProcess.draw(rng, [sigma], length) for sigma, length in motions)
        return Motion(axis, rig, lateral, bounce, (yaw, pitch, roll))

    def at(self, s_m: Array) -> tuple[Array, Array]:
        """Positions (N, 3) and heading, pitch, roll (N, 3) in radians at places (N,)."""
        position = self.axis.beside(s_m, self.rig.lateral_m + self.lateral.at(s_m)[:, 0], self.bounce.at(s_m)[:, 0])
        swerve = np.arctan(self.lateral.slope(s_m)[:, 0])  # the rig looks where it goes
        grade = np.arctan((self.axis.at(s_m + 0.5) - self.axis.at(s_m - 0.5))[:, 2])
        yaw, pitch, roll = (np.radians(process.at(s_m)[:, 0]) for process in self.turns_deg)
        return position, np.column_stack([self.axis.heading_rad(s_m) + swerve + yaw, grade + pitch, roll])

    def poses(self, s_m: Array) -> tuple[Rigid3, ...]:
        """world_from_rig at places (N,)."""
        positions, angles = self.at(s_m)
        return tuple(Rigid3(turn, place) for turn, place in zip(rig_rotations(angles), positions, strict=True))

    @property
    def speed_mps(self) -> float:
        return WALKING_MPS if self.rig.handheld else SPEED_MPS


def drive(axis: Axis, rig: Rig, rng: np.random.Generator) -> Trajectory:
    """The true trajectory of a rig along the whole street."""
    motion = Motion.draw(axis, rig, rng)
    spread = (WALKING if rig.handheld else Wander()).spacing_m
    count = int((axis.length_m - 2.0 * rig.start_m) / rig.spacing_m + 1e-9) + 1
    s = rig.start_m + rig.spacing_m * np.arange(count) + spread * np.clip(rng.normal(size=count), -3, 3)
    return Trajectory(rig, s, s / motion.speed_mps, motion.poses(s))


def rig_rotations(angles_rad: Array) -> Array:
    """world_from_rig (N, 3, 3): heading clockwise from north, pitch nose up, roll right side down (N, 3)."""
    (sh, sp, sr), (ch, cp, cr) = np.sin(angles_rad).T, np.cos(angles_rad).T
    right = np.stack([ch * cr + sh * sp * sr, ch * sp * sr - sh * cr, -cp * sr], axis=-1)
    forward = np.stack([sh * cp, ch * cp, sp], axis=-1)
    return np.stack([right, forward, np.cross(right, forward)], axis=-1)


@dataclass(frozen=True)
class GnssImu:
    """What a position and attitude system is worth; factors rise by outage_factor in outages."""

    drift_m: tuple[float, float, float] = (0.15, 0.15, 0.25)  # 1-sigma of the slow part, east, north, up
    drift_length_m: float = 60.0
    white_m: tuple[float, float, float] = (0.03, 0.03, 0.05)
    roll_pitch_deg: float = 0.03
    heading_deg: float = 0.15
    outage_share: float = 0.2  # of the street, under trees
    outage_length_m: float = 25.0
    outage_factor: float = 4.0

    @property
    def sigma_m(self) -> Array:
        """1-sigma (3,) of a position under open sky."""
        return np.hypot(self.drift_m, self.white_m)


@dataclass(frozen=True, eq=False)
class Measured:
    """Poses as GNSS and IMU give them, reduced from the antenna to the origin of the rig."""

    world_from_rigs: tuple[Rigid3, ...]
    antenna_in_world: Array  # (N, 3)
    sigma_m: Array  # (N, 3) of the antenna, east, north, up, as the receiver states it
    heading_sigma_deg: float


def measure(
    trajectory: Trajectory, system: GnssImu, rng: np.random.Generator, shaded_m: Array | None = None
) -> Measured:
    """GNSS with slowly drifting and white errors, larger in outages (and said to be), and an IMU's attitude.

    shaded_m: places along the street where outages may be (under trees); None: anywhere.
    """
    rig, count = trajectory.rig, len(trajectory)
    factor = outage_factors(trajectory.s_m, system, rng, shaded_m)
    drift = gauss_markov(trajectory.s_m, np.array(system.drift_m), system.drift_length_m, rng)
    error = factor[:, None] * (drift + np.array(system.white_m) * rng.normal(size=(count, 3)))
    antenna = np.array([pose.apply(rig.antenna) for pose in trajectory.world_from_rigs]).reshape(-1, 3) + error
    attitude_sigma = np.radians([system.roll_pitch_deg, system.roll_pitch_deg, system.heading_deg])
    turns = gauss_markov(trajectory.s_m, attitude_sigma, 4.0 * system.drift_length_m, rng)
    poses = []
    for truth, turn, position in zip(trajectory.world_from_rigs, turns, antenna, strict=True):
        rotation = truth.rotation @ exp_so3(turn)  # about the axes of the rig: right, forward, up
        poses.append(Rigid3(rotation, position - rotation @ rig.antenna))
    return Measured(tuple(poses), antenna, factor[:, None] * system.sigma_m, system.heading_deg)


def gauss_markov(s_m: Array, sigma: Array, length_m: float, rng: np.random.Generator) -> Array:
    """A first-order Gauss-Markov process (N, D) at rising places (N,): correlation exp(-distance / length)."""
    steps = rng.normal(size=(len(s_m), len(sigma)))
    keep = np.exp(-np.diff(s_m, prepend=s_m[:1]) / length_m) if len(s_m) else np.zeros(0)
    out = steps.copy()
    for i in range(1, len(s_m)):
        out[i] = keep[i] * out[i - 1] + np.sqrt(max(0.0, 1.0 - keep[i] ** 2)) * steps[i]
    return out * sigma


def outage_factors(s_m: Array, system: GnssImu, rng: np.random.Generator, shaded_m: Array | None = None) -> Array:
    """Factors (N,) on all errors of position: 1 under open sky, up to outage_factor in outages, smooth between."""
    factor = np.ones(len(s_m))
    if not len(s_m) or system.outage_share <= 0.0:
        return factor
    low, high = float(s_m.min()), float(s_m.max())
    count = max(1, round(system.outage_share * (high - low) / system.outage_length_m))
    shaded = None if shaded_m is None else shaded_m[(shaded_m >= low) & (shaded_m <= high)]
    middles = rng.uniform(low, high, count) if shaded is None or not len(shaded) else rng.choice(shaded, count)
    for middle in middles:
        inside = np.clip(1.0 - np.abs(s_m - middle) / (system.outage_length_m / 2.0), 0.0, 1.0)
        factor = np.maximum(factor, 1.0 + (system.outage_factor - 1.0) * np.sin(0.5 * np.pi * inside) ** 2)
    return factor
