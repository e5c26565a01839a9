"""Verb `adjust` for a problem file of Bundle Adjustment in the Large: no datum, own intrinsics of each camera."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from georef.estimation.adjustment.block import Block, Calibration, RigCamera
from georef.estimation.adjustment.campaign.checkpoints import Resumable
from georef.estimation.adjustment.solver import Iteration, SolverOptions, solve_block
from georef.geometry.rigid import Rigid3
from georef.io.bal import BalProblem, read_bal, write_bal
from georef.stages.solve_files import SolveFiles
from georef.types.scene import Observations

_OPTIONS = SolverOptions(max_iterations=200, damping=1e-4, cost_tolerance=1e-8, free_gauge=True)


@dataclass(frozen=True, eq=False)
class BalRun:
    """An adjusted problem; costs are half the sum of squared residuals in px."""

    problem: BalProblem
    first_cost: float
    cost: float
    iterations: int
    converged: bool
    written: Path | None

    @property
    def lines(self) -> tuple[str, ...]:
        problem, rms = self.problem, np.sqrt(2.0 * self.cost / max(2 * len(self.problem.camera), 1))
        state = "" if self.converged else ", NOT CONVERGED"
        return (
            f"{len(problem.cameras)} cameras, {len(problem.points)} points, {len(problem.camera)} observations",
            f"cost {self.first_cost:.6g} -> {self.cost:.6g} px^2 in {self.iterations} iterations{state}; "
            f"{rms:.3f} px RMS of a coordinate",
        )


def run_bal(path: Path, output: Path | None, say: Callable[[str], None] = lambda _: None) -> BalRun:
    """Adjusts a problem and, where an output folder is named, writes it there: what is interrupted then goes on from
    its last iteration. Raises InputError, GeorefError."""
    problem = read_bal(path)
    block = block_of_bal(problem)
    start = block.start()
    first = 0.5 * float(np.sum(np.square(_residuals(block, problem))))

    def told(iteration: Iteration) -> None:
        say(f"iteration {iteration.number}: cost {iteration.cost:.6g}")

    files = None if output is None else SolveFiles(output / f"{path.name}.solves")
    solve = solve_block if files is None else Resumable(files)
    solution = solve(block, options=_OPTIONS, start=start, on_iteration=told)
    state = solution.state
    adjusted = problem.with_values(state.world_from_rig, state.cameras, state.points)
    written = None if output is None else output / path.name
    if written is not None:
        write_bal(adjusted, written)
    if files is not None:
        files.clear()
    return BalRun(adjusted, first, solution.cost, solution.iterations, solution.converged, written)


def block_of_bal(problem: BalProblem) -> Block:
    """Each camera a station; focal length, k1 and k2 of each are free, observations have a sigma of 1 px."""
    count = len(problem.cameras)
    names = tuple(str(i) for i in range(count))
    index = np.arange(count)
    observed = len(problem.camera)
    return Block(
        station_ids=names,
        image_ids=names,
        station=index,
        mounting=np.zeros(count, np.int64),
        calibration=index,
        mountings=(RigCamera("camera", Rigid3.identity()),),
        calibrations=tuple(Calibration(camera, np.zeros((3, 3))) for camera in problem.house_cameras()),
        world_from_rig=problem.world_from_cam,
        points=problem.points,
        observations=Observations(
            *(problem.point, problem.camera, problem.pixels, np.ones(observed), np.full(observed, -1))
        ),
    )


def _residuals(block: Block, problem: BalProblem) -> np.ndarray:
    obs = block.observations
    return np.nan_to_num(block.views(block.start()).project(obs.view, problem.points[obs.point]) - obs.pixel)
