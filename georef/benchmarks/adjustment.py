"""The adjustment of a simulated drive beside pycolmap's (Ceres): the same observations, start, datum and stop."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from georef.benchmarks.adjustment_ceres import LinearSolver, Solved, solve_with_ceres
from georef.benchmarks.adjustment_problem import TRUTH_FILE, Size, image_cost, read_problem, write_problem
from georef.benchmarks.measure import Cost, measured, table
from georef.estimation.adjustment.block import Block, State
from georef.geometry.poses import Poses
from georef.geometry.rigid import Array

COST_TOLERANCE, MAX_ITERATIONS = 1e-10, 60
_OURS, _CERES = "georef", "Ceres"
_WARM_UP = Size(20, 5, 1000)


@dataclass(frozen=True, eq=False)
class _Found:
    """What a process found, and its cost."""

    way: str
    process: Cost[dict[str, Any]]
    world_from_rig: Poses
    points: Array
    cameras: Array


def run(size: Size, folder: Path, *, linear: LinearSolver = "direct", ceres: bool = True) -> dict[str, Any]:
    """Simulates a drive and adjusts it both ways, each step in a process of its own; arrays lie in `folder`.

    linear: how Ceres solves the reduced equations. ceres: False leaves pycolmap out, where memory is short.
    """
    simulated = measured(write_problem, folder, size)
    ways = [_found(_OURS, measured(_solve_ours, folder, size), folder)]
    if ceres:
        ways.append(_found(_CERES, measured(_solve_ceres, folder, size, linear), folder))
    block = read_problem(folder, size)
    truth = np.load(folder / TRUTH_FILE)
    rows = {found.way: _figures(found, block, truth) for found in ways}
    return {
        "stations": size.stations,
        "images": len(block.image_ids),
        "points": len(block.points),
        "observations": len(block.observations),
        "calibrations": "free" if size.free_calibrations else "held",
        "held_stations": len(size.held),
        "linear": linear,
        "simulation": {"cpu_s": simulated.cpu_s, "peak_mb": simulated.peak_mb},
        "start_cost": image_cost(block, block.start()),
        "ways": rows,
        "between": _between(*ways) if ceres else None,
        "ratios": _ratios(rows[_CERES], rows[_OURS]) if ceres else None,
    }


def describe(result: dict[str, Any]) -> list[str]:
    """The table for a terminal."""
    title = (
        f"{result['stations']:,} stations, {result['images']:,} images, {result['points']:,} points, "
        f"{result['observations']:,} observations; calibrations {result['calibrations']}, "
        f"{result['held_stations']} stations held, one thread; Ceres' linear solver: {result['linear']}"
    )
    header = ("adjustment", "iterations", "CPU-s each", "solve CPU-s", "setup CPU-s", "peak MB", "cost", "RMSE mm")
    rows = []
    for name, way in result["ways"].items():
        seconds = (f"{way[key]:,.2f}" for key in ("iteration_s", "solve_s", "setup_s"))
        stop = "" if way["converged"] else " (not converged)"
        figures = (f"{way['peak_mb']:,.0f}", f"{way['cost']:.3f}", f"{1e3 * way['rmse_m']:.3f}")
        rows.append((name, f"{way['iterations']}{stop}", *seconds, *figures))
    lines = [title, "", *table(header, rows)]
    if result["between"] is None:
        return lines
    between, ratios = result["between"], result["ratios"]
    lines += [
        "",
        f"largest difference of poses {1e3 * between['position_m']:.4f} mm, {between['rotation_deg']:.2g} degrees",
        f"Ceres over georef: {ratios['iteration']:.1f} an iteration, {ratios['solve']:.1f} the solve, "
        f"{ratios['total']:.1f} with setup, {ratios['memory']:.1f} memory",
    ]
    return lines


def _solve_ours(folder: Path, size: Size) -> dict[str, Any]:
    from georef.estimation.adjustment.prepared import Prepared
    from georef.estimation.adjustment.solver import SolverOptions, solve_block

    options = SolverOptions(max_iterations=MAX_ITERATIONS, cost_tolerance=COST_TOLERANCE)
    _warm_up(folder, size, options)
    block = read_problem(folder, size)
    begin = time.process_time()
    prepared = Prepared.of(block)
    ready = time.process_time()
    done = solve_block(block, options=options, prepared=prepared)
    solved = time.process_time()
    found = Solved(done.state, done.iterations, ready - begin, solved - ready, done.converged)
    return _kept(_OURS, found, folder)


def _warm_up(folder: Path, size: Size, options: Any) -> None:
    """Compiles what is compiled, or loads it, with a small problem of the same kind."""
    from georef.estimation.adjustment.solver import solve_block

    small = folder / "warm_up"
    small.mkdir(exist_ok=True)
    alike = replace(_WARM_UP, cameras=size.cameras, free_calibrations=size.free_calibrations)
    write_problem(small, alike)
    solve_block(read_problem(small, alike), options=replace(options, max_iterations=2))


def _solve_ceres(folder: Path, size: Size, linear: LinearSolver) -> dict[str, Any]:
    block = read_problem(folder, size)
    limits = {"max_iterations": MAX_ITERATIONS, "cost_tolerance": COST_TOLERANCE}
    return _kept(_CERES, solve_with_ceres(block, size, **limits, linear=linear), folder)


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
