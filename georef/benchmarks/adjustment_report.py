"""What the benchmark of the adjustment found: tables for a terminal, and a picture of how costs grow."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from georef.benchmarks.adjustment import OURS
from georef.benchmarks.measure import table


def describe(result: dict[str, Any]) -> list[str]:
    """The table of one size, or those of several and how ours grows."""
    if "sizes" not in result:
        return _describe(result)
    lines: list[str] = []
    for one in result["sizes"]:
        lines += [*_describe(one), ""]
    return [*lines, *_growth(result["sizes"])]


def _describe(result: dict[str, Any]) -> list[str]:
    title = (
        f"{result['stations']:,} stations, {result['images']:,} images, {result['points']:,} points, "
        f"{result['observations']:,} observations; calibrations {result['calibrations']}, "
        f"{result['held_stations']} stations held, one thread"
    )
    header = ("adjustment", "iterations", "CPU-s each", "solve CPU-s", "setup CPU-s", "peak MB", "cost", "RMSE mm")
    rows = []
    for name, way in result["ways"].items():
        seconds = (f"{way[key]:,.2f}" for key in ("iteration_s", "solve_s", "setup_s"))
        stop = "" if way["converged"] else " (stopped)"
        figures = (f"{way['peak_mb']:,.0f}", f"{way['cost']:.3f}", f"{1e3 * way['rmse_m']:.3f}")
        rows.append((name, f"{way['iterations']}{stop}", *seconds, *figures))
    ours = result["ways"][OURS]
    lines = [title, "", *table(header, rows), ""]
    lines.append(
        f"of georef's CPU-s an iteration {ours['points_s']:.2f} points, {ours['reduced_s']:.2f} reduced equations"
    )
    for name, ratio in result["ratios"].items():
        lines.append(
            f"{name}, over georef: {ratio['iteration']:.1f} an iteration, {ratio['solve']:.1f} the solve, "
            f"{ratio['total']:.1f} with setup, {ratio['memory']:.1f} memory"
        )
    for name, between in result["between"].items():
        lines.append(
            f"{name}: poses differ by {1e3 * between['position_m']:.4f} mm and {between['rotation_deg']:.2g} degrees "
            f"at most, points by {1e3 * between['point_median_m']:.4f} mm in the median"
        )
    return lines


def _growth(sizes: list[dict[str, Any]]) -> list[str]:
    """The exponent of observations that the time of georef's points grows with, between the first and each later."""
    first, lines = sizes[0], []
    for other in sizes[1:]:
        more = np.log(other["observations"] / first["observations"])
        rate = {
            key: np.log(other["ways"][OURS][key] / first["ways"][OURS][key]) / more
            for key in ("points_s", "iteration_s", "peak_mb")
        }
        lines.append(
            f"{first['observations']:,} to {other['observations']:,} observations, power that georef grows with: "
            f"points {rate['points_s']:.2f}, iteration {rate['iteration_s']:.2f}, memory {rate['peak_mb']:.2f}"
        )
    return lines


def picture(result: dict[str, Any], path: Path) -> None:
    """CPU-seconds an iteration and peak memory over observations, both axes logarithmic, as a PNG file."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    sizes = result.get("sizes", [result])
    figure = Figure(figsize=(10.0, 4.2), layout="constrained")
    FigureCanvasAgg(figure)
    seconds, memory = figure.subplots(1, 2)
    names = dict.fromkeys(name for one in sizes for name in one["ways"])
    for name in names:
        there = [one for one in sizes if name in one["ways"]]
        counts = [one["observations"] for one in there]
        seconds.plot(counts, [one["ways"][name]["iteration_s"] for one in there], "o-", label=name)
        memory.plot(counts, [one["ways"][name]["peak_mb"] / 1e3 for one in there], "o-", label=name)
    counts = np.array([one["observations"] for one in sizes], dtype=np.float64)
    points = [one["ways"][OURS]["points_s"] for one in sizes]
    seconds.plot(counts, points, "s:", label="georef, points alone")
    seconds.plot(counts, points[0] * counts / counts[0], color="0.6", linewidth=1.0, label="linear")
    for axes, label in ((seconds, "CPU-seconds an iteration"), (memory, "peak memory, GB")):
        axes.set(xscale="log", yscale="log", xlabel="image observations", ylabel=label)
        axes.grid(True, which="both", alpha=0.3)
    seconds.legend()
    figure.savefig(path, dpi=130)
