"""The report of a block in words: what a terminal shows and report.txt holds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from scipy.stats import chi2

from georef.evaluation.calibrations import compare_calibrations
from georef.geometry.camera import Camera

_SIGNIFICANT = float(chi2.ppf(0.999, 3))


def comparison(ours: Camera, theirs: Camera, program: str) -> dict[str, Any]:
    """A calibration beside that of another program."""
    names = [name for name in ours.estimate if name in ("focal", "cx", "cy") or name in theirs.lens.parameters]
    return {
        "program": program,
        "parameters": [{"name": n, "value": ours.value(n), "other": theirs.value(n)} for n in names],
        **asdict(compare_calibrations(ours, theirs)),
    }


def text_of(report: dict[str, Any]) -> list[str]:
    """The report in lines."""
    data = report["data"]
    lines = [
        f"block {report['block']}: {data['images']} images, {data['tie_points']} tie points, "
        f"{data['image_observations']} observations ({data['rejected_observations']} rejected), "
        f"{data['gnss_positions']} GNSS positions, {data['surveyed_points']} surveyed points, {data['marks']} marks",
        f"sigma of image observations: {data['image_sigma_scale']:.3f} times the stated one",
    ]
    for title, variant in report["variants"].items():
        lines += ["", *_variant_lines(title, variant)]
    if "offset" in report:
        lines += ["", *_offset_lines(report["offset"])]
    if "hold_out" in report:
        lines += ["", *_hold_out_lines(report["hold_out"])]
    if "comparison" in report:
        lines += ["", *_comparison_lines(report["comparison"])]
    return lines


def _variant_lines(title: str, variant: dict[str, Any]) -> list[str]:
    control = ", ".join(variant["control"]) or "none"
    state = "" if variant["converged"] else ", NOT CONVERGED"
    lines = [f"{title}: control {control}; sigma0 {variant['sigma0']:.3f}, {variant['iterations']} iterations{state}"]
    if variant["control_rms_m"]:
        lines.append(f"  residuals of control, RMS   {_cm(variant['control_rms_m'])}")
    if variant["gnss_residual_rms_m"]:
        lines.append(f"  residuals of GNSS, RMS      {_cm(variant['gnss_residual_rms_m'])}")
    for kind, summary in variant["check"].items():
        rmse = [summary[f"rmse_{axis}_m"] for axis in "enh"]
        lines.append(f"  {summary['count']} {kind} check points, RMSE {_cm(rmse)}, mean {_cm(summary['mean_m'])}")
        lines.append(f"  {_nees(summary['nees'])}")
    lines += [f"  {_unknown(unknown)}" for unknown in variant["shared_unknowns"]]
    return [*lines, *_warnings(variant["correlations"])]


def _offset_lines(offset: dict[str, Any]) -> list[str]:
    significant = offset["statistic"] > _SIGNIFICANT
    what = "significant" if significant else "not significant"
    return [
        f"GNSS alone against {offset['points']} surveyed points, no control:",
        f"  offset, block less surveyed points E/N/H {_cm(offset['offset_m'])}, 1-sigma {_cm(offset['sigma_m'])}",
        f"  {what}: chi-square {offset['statistic']:.1f} of 3 degrees of freedom (99.9 %: {_SIGNIFICANT:.1f}); "
        f"what is left over the offset: {offset['left_over']:.2f} times what was predicted",
        *(
            f"  {c['first']} and the {c['second']} correlate by {c['value']:+.3f}"
            + (": the height part of the offset may be the focal length's" if abs(c["value"]) > 0.7 else "")
            for c in offset["height_correlations"]
        ),
    ]


def _hold_out_lines(hold_out: dict[str, Any]) -> list[str]:
    splits = hold_out["splits"]
    first = splits[0]
    return [
        f"{len(splits)} splits into {len(first['control'])} control and {len(first['check'])} check points:",
        f"  RMSE of check points E/N/H, median {_cm(hold_out['median_rmse_m'])}, "
        f"largest {_cm(hold_out['largest_rmse_m'])}",
        f"  the first one, adjusted, differs by {1e3 * hold_out['first_split_adjusted_differs_m']:.2f} mm or less",
        f"  {_nees(hold_out['nees'])}",
    ]


def _comparison_lines(comparison: dict[str, Any]) -> list[str]:
    parameters = "; ".join(f"{p['name']} {p['value']:.6g} ({p['other']:.6g})" for p in comparison["parameters"])
    return [
        f"calibration beside {comparison['program']}'s (in brackets): {parameters}",
        f"  pixels of the same directions differ by {comparison['rms_px']:.2f} px RMS; by "
        f"{comparison['rms_shape_px']:.2f} px (at most {comparison['largest_shape_px']:.2f}) after a turn and a scale",
    ]


def _warnings(correlations: Sequence[dict[str, Any]]) -> list[str]:
    return [f"  WARNING {c['first']} and {c['second']} correlate by {c['value']:+.3f}" for c in correlations]


def _unknown(unknown: dict[str, Any]) -> str:
    value, sigma, unit = unknown["value"], unknown["sigma"], unknown["unit"]
    if unit == "m":
        return f"{unknown['name']:<22} {100 * value:+9.2f} +- {100 * sigma:.2f} cm"
    return f"{unknown['name']:<22} {value:12.6g} +- {sigma:.2g} {unit}".rstrip()


def _nees(nees: dict[str, Any]) -> str:
    if nees["mean_ratio"] is None:
        return "no NEES"
    low, high = nees["interval_95"]
    return (
        f"NEES over its degrees of freedom {nees['mean_ratio']:.2f} (95 % of true covariances: {low:.2f} to {high:.2f})"
    )


def _cm(values_m: Sequence[float | None]) -> str:
    return " / ".join("-" if value is None else f"{100 * value:.2f}" for value in values_m) + " cm"
