"""The report of a block in words: what a terminal shows and report.txt holds."""

from __future__ import annotations

from typing import Any

from scipy.stats import chi2

from georef.stages.block_solution_words import cm, nees_words, rejected_words, variant_lines

_SIGNIFICANT = float(chi2.ppf(0.999, 3))


def text_of(report: dict[str, Any]) -> list[str]:
    """The report in lines."""
    data = report["data"]
    lines = [
        f"block {report['block']}: {data['images']} images of {data['cameras']} cameras, {data['stations']} exposures, "
        f"{data['tie_points']} tie points, {data['image_observations']} observations "
        f"({data['rejected_observations']} rejected), {data['gnss_positions']} GNSS positions, "
        f"{data['surveyed_points']} surveyed points, {data['marks']} marks",
        f"sigma of image observations: {data['image_sigma_scale']:.3f} times the stated one",
        *(f"rejected: {rejected_words(entry)}" for entry in report["rejected"]),
    ]
    for title, variant in report["variants"].items():
        lines += ["", *variant_lines(title, variant)]
    if report.get("offset"):
        lines += ["", *_offset_lines(report["offset"])]
    for hold_out in report["hold_outs"]:
        lines += ["", *_hold_out_lines(hold_out)]
    for comparison in report.get("comparisons", []):
        lines += ["", *_comparison_lines(comparison)]
    return lines


def _offset_lines(offset: dict[str, Any]) -> list[str]:
    significant = offset["statistic"] > _SIGNIFICANT
    what = "significant" if significant else "not significant"
    without = f", without {', '.join(offset['left_out'])}, which contradict the others" if offset["left_out"] else ""
    return [
        f"GNSS alone against {offset['points']} surveyed points, no control{without}:",
        f"  offset, block less surveyed points E/N/H {cm(offset['offset_m'])}, 1-sigma {cm(offset['sigma_m'])}",
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
    first, names = splits[0], hold_out["left_out"]
    without = f", without {', '.join(names)}, which contradict the others" if names else ""
    return [
        f"{len(splits)} splits into {len(first['control'])} control and {len(first['check'])} check points{without}:",
        f"  RMSE of check points E/N/H, median {cm(hold_out['median_rmse_m'])}, "
        f"largest {cm(hold_out['largest_rmse_m'])}",
        f"  the first one, adjusted, differs by {1e3 * hold_out['first_split_adjusted_differs_m']:.2f} mm or less",
        f"  {nees_words(hold_out['nees'])}",
    ]


def _comparison_lines(comparison: dict[str, Any]) -> list[str]:
    parameters = "; ".join(f"{p['name']} {p['value']:.6g} ({p['other']:.6g})" for p in comparison["parameters"])
    return [
        f"calibration of {comparison['camera']} beside {comparison['program']}'s (in brackets): {parameters}",
        f"  pixels of the same directions differ by {comparison['rms_px']:.2f} px RMS; by "
        f"{comparison['rms_shape_px']:.2f} px (at most {comparison['largest_shape_px']:.2f}) after a turn and a scale",
    ]
