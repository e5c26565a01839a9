"""The verb `evaluate`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from georef.cli_options import AS_DECLARED, Choice, Crs, Data, Epoch, Height, executor_of
from georef.terminal import say, say_table


def evaluate(
    project: Annotated[Path | None, Parameter(help="Project folder, or its project.toml; or name --poses.")] = None,
    *,
    truth: Annotated[Path | None, Parameter(help="True exterior orientation of the same images.")] = None,
    truth_sigma: Annotated[
        str | None, Parameter(help="How well the truth is known: POSITION_M,ROTATION_DEG, 1-sigma per axis.")
    ] = None,
    tables: Annotated[str | None, Parameter(help="Of a project: these tables alone, e.g. features,models.")] = None,
    variants: Annotated[
        Path | None, Parameter(help="Of a project: a TOML file of tables; else configs/evaluation/default.toml.")
    ] = None,
    leave_one_out: Annotated[
        bool, Parameter(negative=(), help="Of a project, no truth needed: its reference images against each other.")
    ] = False,
    references: Annotated[
        str | None, Parameter(help="With --leave-one-out: images of this reference epoch alone.")
    ] = None,
    count: Annotated[
        int | None, Parameter(help="With --leave-one-out: at most so many images, evenly spread; else all.")
    ] = None,
    data: Data = None,
    epoch: Epoch = None,
    choice: Choice = AS_DECLARED,
    poses: Annotated[
        Path | None, Parameter(help="A file of poses alone: as georef writes them, or a plain exterior orientation.")
    ] = None,
    crs: Crs = None,
    height: Height = None,
    output: Annotated[
        Path | None,
        Parameter(name=["--output", "-o"], help="Of a project: where all results go. Of poses: the JSON file."),
    ] = None,
) -> int:
    """Compare with the truth: variants of a project as tables, curves and a page, or one file of poses.

    With --leave-one-out each reference image is localized against the others and compared with its own given pose.
    """
    from georef.stages.evaluate import describe, evaluate, parse_truth_sigma, what_to_compare, write_evaluation

    what_to_compare(
        project, poses, truth, leave_one_out=leave_one_out, chosen=references is not None or count is not None
    )
    if leave_one_out:
        assert project is not None
        return _leave_one_out(project, references, count, data, output, epoch, choice)
    sigmas = None if truth_sigma is None else parse_truth_sigma(truth_sigma)
    assert truth is not None
    if poses is not None:
        result = evaluate(poses, truth, crs=crs, height=height, truth_sigmas=sigmas)
        say(*describe(result), f"written     {write_evaluation(result, output)}")
        return 0
    assert project is not None
    from georef.comparison.evaluate import compare, write_comparison
    from georef.comparison.run import Source

    source = Source(project, data, output, epoch, choice.preset, choice.set_)
    wanted = [name.strip() for name in (tables or "").split(",") if name.strip()]
    executor = executor_of(source.open()[0])
    comparison = compare(source, truth, sigmas, variants=variants, wanted=wanted, executor=executor, say=say)
    for table in comparison.tables:
        say_table(table.to_dict())
    say("", *(f"written     {path}" for path in write_comparison(comparison)))
    return 0


def _leave_one_out(
    project: Path,
    references: str | None,
    count: int | None,
    data: Path | None,
    output: Path | None,
    epoch: str | None,
    choice: Choice,
) -> int:
    from georef.comparison.leave_one_out import leave_out, write_leave_one_out
    from georef.comparison.run import Source
    from georef.project import open_project
    from georef.stages.leave_one_out import Choice as Chosen

    opened = open_project(project, data=data, output=output, preset=choice.preset, settings=choice.set_)
    source = Source(project, data, output, epoch or next(iter(opened.file.epochs)), choice.preset, choice.set_)
    found = leave_out(source, Chosen(references, count), executor=executor_of(opened), say=say)
    say_table(found.table.to_dict())
    say("", *(f"written     {path}" for path in write_leave_one_out(found)))
    return 0
