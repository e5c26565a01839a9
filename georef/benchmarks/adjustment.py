"""The adjustment of simulated drives beside pycolmap's (Ceres): the same observations, start, datum and stop."""

from __future__ import annotations

import time
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from georef.benchmarks.adjustment_ceres import LinearSolver, Solved, solve_with_ceres
from georef.benchmarks.adjustment_problem import TRUTH_FILE, Size, image_cost, read_problem, write_problem
from georef.benchmarks.measure import Cost, measured
from georef.estimation.adjustment.block import Block, State
from georef.geometry.poses import Poses
from georef.geometry.rigid import Array

if TYPE_CHECKING:
    from georef.estimation.adjustment.solver import SolverOptions

COST_TOLERANCE, MAX_ITERATIONS = 1e-10, 60
SIZES = (Size(1000, 5, 1_000_000), Size(5000, 5, 2_500_000), Size(4027, 11, 5_000_000))
OURS = "georef"
_WARM_UP = Size(20, 5, 1000)


@dataclass(frozen=True)
class Ceres:
    """A way through Ceres: how it solves the reduced equations, and how many iterations it is given."""

    linear: LinearSolver
    most_iterations: int = MAX_ITERATIONS

    @property
    def name(self) -> str:
        return f"Ceres, {self.linear}"


@dataclass(frozen=True, eq=False)
class _Found:
    """What a process found, and its cost."""

    way: str
    process: Cost[dict[str, Any]]
    world_from_rig: Poses
    points: Array
    cameras: Array


def run(size: Size, folder: Path, ceres: Iterable[Ceres] = (Ceres("direct"),)) -> dict[str, Any]:
    """Simulates a drive and adjusts it all ways, each step in a process of its own; arrays lie in `folder`.

    Differences to Ceres are told where it converged.
    """
    simulated = measured(write_problem, folder, size)
    ours = _found(OURS, measured(_solve_ours, folder, size), folder)
    theirs = [_found(way.name, measured(_solve_ceres, folder, size, way), folder) for way in ceres]
    block, truth = read_problem(folder, size), np.load(folder / TRUTH_FILE)
    rows = {found.way: _figures(found, block, truth) for found in (ours, *theirs)}
    return {
        "stations": size.stations,
        "images": len(block.image_ids),
        "points": len(block.points),
        "observations": len(block.observations),
        "calibrations": "free" if size.free_calibrations else "held",
        "held_stations": len(size.held),
        "simulation": {"cpu_s": simulated.cpu_s, "peak_mb": simulated.peak_mb},
        "start_cost": image_cost(block, block.start()),
        "ways": rows,
        "between": {f.way: _between(ours, f) for f in theirs if f.process.result["converged"]},
        "ratios": {f.way: _ratios(rows[f.way], rows[OURS]) for f in theirs},
    }


def run_all(folder: Path, ceres: Iterable[Ceres], sizes: Iterable[Size] = SIZES) -> dict[str, Any]:
    """Several sizes one after the other, and how costs grow with them."""
    found = []
    for number, size in enumerate(sizes):
        here = folder / f"size_{number}"
        here.mkdir()
        found.append(run(size, here, ceres))
        for file in here.rglob("*.np[yz]"):
            file.unlink()  # gigabytes that the next size may need
    return {"sizes": found}


def _solve_ours(folder: Path, size: Size) -> dict[str, Any]:
    from georef.benchmarks.adjustment_parts import TimedEquations
    from georef.estimation.adjustment.equations.block_equations import BlockEquations
    from georef.estimation.adjustment.equations.prepared import Prepared
    from georef.estimation.adjustment.solver import SolverOptions, solve_block

    options = SolverOptions(max_iterations=MAX_ITERATIONS, cost_tolerance=COST_TOLERANCE)
    _warm_up(folder, size, options)
    block = read_problem(folder, size)
    begin = time.process_time()
    prepared = Prepared.of(block)
    assert prepared.pattern.stations == size.stations
    equations = TimedEquations(BlockEquations(block, prepared=prepared))
    ready = time.process_time()
    done = solve_block(block, options=options, equations=equations)
    solved = time.process_time()
    found = Solved(done.state, done.iterations, ready - begin, solved - ready, done.converged)
    each = max(done.iterations, 1)
    return _kept(OURS, found, folder) | {
        "points_s": equations.points_s / each,
        "reduced_s": (solved - ready - equations.points_s) / each,
    }


def _warm_up(folder: Path, size: Size, options: SolverOptions) -> None:
    """Compiles what is compiled, or loads it, with a small problem of the same kind."""
    from georef.estimation.adjustment.equations.eliminate import normal_equations
    from georef.estimation.adjustment.equations.prepared import Prepared
    from georef.estimation.adjustment.equations.reduced_solve import product
    from georef.estimation.adjustment.solver import solve_block

    small = folder / "warm_up"
    small.mkdir(exist_ok=True)
    alike = replace(_WARM_UP, cameras=size.cameras, free_calibrations=size.free_calibrations)
    write_problem(small, alike)
    block = read_problem(small, alike)
    prepared = Prepared.of(block)
    solve_block(block, options=replace(options, max_iterations=2), prepared=prepared)
    product(normal_equations(block, block.start(), prepared=prepared).reduced, np.zeros(prepared.layout.size))


def _solve_ceres(folder: Path, size: Size, way: Ceres) -> dict[str, Any]:
    block = read_problem(folder, size)
    limits = {"max_iterations": way.most_iterations, "cost_tolerance": COST_TOLERANCE}
    return _kept(way.name, solve_with_ceres(block, size, **limits, linear=way.linear), folder)


def _kept(way: str, solved: Solved, folder: Path) -> dict[str, Any]:
    """Figures of a solution, whose state goes into the folder."""
    state = solved.state
    np.savez(
        folder / f"{way}.npz",
        rotation=state.world_from_rig.rotation,
        translation=state.world_from_rig.translation,
        points=state.points,
        cameras=np.array([camera.parameters for camera in state.cameras]),
    )
    return {
        "iterations": solved.iterations,
        "setup_s": solved.setup_s,
        "solve_s": solved.solve_s,
        "iteration_s": solved.solve_s / max(solved.iterations, 1),
        "converged": solved.converged,
    }


def _found(way: str, cost: Cost[dict[str, Any]], folder: Path) -> _Found:
    with np.load(folder / f"{way}.npz", allow_pickle=False) as arrays:
        poses = Poses(arrays["rotation"], arrays["translation"])
        return _Found(way, cost, poses, arrays["points"], arrays["cameras"])


def _figures(found: _Found, block: Block, truth: Array) -> dict[str, Any]:
    cameras = tuple(
        replace(c.camera, fx=row[0], fy=row[1], cx=row[2], cy=row[3], distortion=tuple(row[4:8]))
        for c, row in zip(block.calibrations, found.cameras, strict=True)
    )
    start = block.start()
    state = State(found.world_from_rig, start.rig_from_cam, cameras, start.lever_arms_m, start.drift_m, found.points)
    errors = np.linalg.norm(found.world_from_rig.translation - truth, axis=1)
    return found.process.result | {
        "peak_mb": found.process.peak_mb,
        "cost": image_cost(block, state),
        "rmse_m": float(np.sqrt(np.mean(np.square(errors)))),
    }


def _between(a: _Found, b: _Found) -> dict[str, float]:
    """Largest differences of two solutions in one datum."""
    xi = a.world_from_rig.local(b.world_from_rig)
    return {
        "position_m": float(np.linalg.norm(xi[:, 3:], axis=1).max()),
        "rotation_deg": float(np.degrees(np.linalg.norm(xi[:, :3], axis=1).max())),
        "point_median_m": float(np.median(np.linalg.norm(a.points - b.points, axis=1))),
    }


def _ratios(ceres: dict[str, Any], ours: dict[str, Any]) -> dict[str, float]:
    total = (ceres["setup_s"] + ceres["solve_s"]) / (ours["setup_s"] + ours["solve_s"])
    return {
        "iteration": ceres["iteration_s"] / ours["iteration_s"],
        "solve": ceres["solve_s"] / ours["solve_s"],
        "total": total,
        "memory": ceres["peak_mb"] / ours["peak_mb"],
    }
