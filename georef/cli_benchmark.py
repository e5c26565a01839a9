"""The verbs `benchmark vectors`, `benchmark features`, `benchmark extraction` and `benchmark adjustment`."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import App, Parameter, validators

from georef.terminal import say

benchmark = App(
    name="benchmark", help="Measure stores at the size of a city, extractors and the adjustment; takes minutes."
)

Scratch = Annotated[Path | None, Parameter(help="Where to put gigabytes while measuring; else the system's own place.")]
Output = Annotated[Path | None, Parameter(name=["--output", "-o"], help="JSON file with all figures.")]
Count = Annotated[int, Parameter(validator=validators.Number(gte=1))]


@benchmark.command
def vectors(
    *,
    rows: Annotated[Count, Parameter(help="Images in the index.")] = 1_000_000,
    size: Annotated[Count, Parameter(help="Values of a descriptor.")] = 512,
    queries: Annotated[Count, Parameter(help="Searches of each kind.")] = 100,
    scratch: Scratch = None,
    output: Output = None,
) -> int:
    """The vector index against brute force: writing, searches by box, recall, memory, disk; 8 GB of scratch."""
    from georef.benchmarks import vectors as bench

    return _measure(lambda folder: bench.run(rows, size, queries, folder), bench.describe, scratch, output)


@benchmark.command
def features(
    *,
    images: Annotated[Count, Parameter(help="Images in the store.")] = 2000,
    keypoints: Annotated[Count, Parameter(help="Features of each.")] = 6144,
    scratch: Scratch = None,
    output: Output = None,
) -> int:
    """The feature store against exact storage and numpy's archives: rates, memory, disk; 7 GB of scratch."""
    from georef.benchmarks import features as bench

    return _measure(lambda folder: bench.run(images, keypoints, folder), bench.describe, scratch, output)


@benchmark.command
def extraction(
    images: Annotated[tuple[Path, ...], Parameter(help="Photographs to extract features from.")],
    *,
    threads: Annotated[Count, Parameter(help="Of each extractor.")] = 1,
) -> int:
    """Every extractor whose weights are here at two levels, and ALIKED beside the module that kornia ships."""
    from georef.benchmarks.extraction import as_table, compared_with_kornia, extraction_costs

    say(*as_table(list(extraction_costs(images, threads=threads))), "")
    compared = compared_with_kornia(images, 2048)
    say(*as_table([compared.own, compared.shipped]), f"keypoints that are the same: {100 * compared.same_share:.2f} %")
    return 0


@benchmark.command
def adjustment(
    *,
    stations: Annotated[
        Count | None,
        Parameter(help="Stations of the simulated drive; else three sizes, of 1, 2.5 and 5 million observations."),
    ] = None,
    cameras: Annotated[Literal[5, 11], Parameter(help="Cameras of its rig.")] = 5,
    observations: Annotated[Count | None, Parameter(help="Image observations; else 200 an image.")] = None,
    calibrations: Annotated[Literal["held", "free"], Parameter(help="Interior orientations.")] = "held",
    ceres: Annotated[bool, Parameter(help="Adjust with pycolmap as well.")] = True,
    linear: Annotated[
        Literal["direct", "iterative", "both"], Parameter(help="How Ceres solves the reduced equations.")
    ] = "direct",
    ceres_iterations: Annotated[Count, Parameter(help="Iterations that Ceres is given at most.")] = 60,
    picture: Annotated[Path | None, Parameter(help="PNG file: growth of time and memory.")] = None,
    scratch: Scratch = None,
    output: Output = None,
) -> int:
    """The bundle adjustment of simulated drives beside pycolmap's: CPU-seconds, memory, cost, poses."""
    from georef.benchmarks import adjustment as bench
    from georef.benchmarks import adjustment_report as report
    from georef.benchmarks.adjustment_problem import Size

    linears: tuple[Literal["direct", "iterative"], ...] = ("direct", "iterative") if linear == "both" else (linear,)
    ways = tuple(bench.Ceres(kind, ceres_iterations) for kind in linears) if ceres else ()

    def measure(folder: Path) -> dict[str, Any]:
        if stations is None:
            return bench.run_all(folder, ways)
        size = Size(stations, cameras, observations or 200 * stations * cameras, calibrations == "free")
        return bench.run(size, folder, ways)

    def describe(result: dict[str, Any]) -> list[str]:
        if picture is not None:
            report.picture(result, picture)
        return report.describe(result)

    return _measure(measure, describe, scratch, output)


def _measure(
    run: Callable[[Path], dict[str, Any]],
    describe: Callable[[dict[str, Any]], list[str]],
    scratch: Path | None,
    output: Path | None,
) -> int:
    """Measures in a folder of its own, which is gone afterwards."""
    from georef.io.files import write_text_atomically

    if scratch is not None:
        scratch.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="georef-benchmark-", dir=scratch) as folder:
        result = run(Path(folder))
    say(*describe(result))
    if output is not None:
        write_text_atomically(json.dumps(result, indent=1) + "\n", output)
        say(f"written     {output}")
    return 0
