"""One solution of a block in words: variance components, control, GNSS, check points, shared unknowns, warnings."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

_NAMES = ("E", "N", "H")


def variant_lines(title: str, variant: dict[str, Any]) -> list[str]:
    """A solution in lines."""
    control = ", ".join(variant["control"]) or "none"
    state = "" if variant["converged"] else ", NOT CONVERGED"
    lines = [
        f"{title}: control {control}; sigma0 {variant['sigma0']:.3f} of redundancy {variant['redundancy']:.0f}, "
        f"{variant['iterations']} iterations{state}"
    ]
    lines += [f"  {line}" for line in _component_lines(variant["components"])]
    lines += [f"  rejected: {rejected_words(entry)}" for entry in variant["rejected"]]
    lines += [f"  rejected: {_mark_words(mark)}" for mark in variant["rejected_marks"]]
    lines += [f"  {line}" for line in (*_control_lines(variant), *_gnss_lines(variant))]
    lines += [f"  {line}" for line in (*_distance_lines(variant), *_partial_lines(variant))]
    for kind, summary in variant["check"].items():
        rmse = [summary[f"rmse_{axis}_m"] for axis in "enh"]
        lines.append(f"  {summary['count']} {kind} check points, RMSE {cm(rmse)}, mean {cm(summary['mean_m'])}")
        lines.append(f"  {nees_words(summary['nees'])}")
    lines += [f"  check point {e['point_id']} not determined: {e['reason']}" for e in variant["not_determined"]]
    lines += [f"  {_unknown(unknown)}" for unknown in variant["shared_unknowns"]]
    return lines + [
        f"  WARNING {c['first']} and {c['second']} correlate by {c['value']:+.3f}" for c in variant["correlations"]
    ]


def rejected_words(entry: dict[str, Any]) -> str:
    """What was rejected, with its test."""
    test = "no test" if entry["statistic"] is None else f"chi-square {entry['statistic']:.1f}"
    return f"{entry['kind']} {entry['name']} ({test} of {entry['dof']} degrees of freedom)"


def nees_words(nees: dict[str, Any]) -> str:
    """Mean NEES beside its two-sided interval."""
    if nees["mean_ratio"] is None:
        return "no NEES"
    low, high = nees["interval_95"]
    return (
        f"NEES over its degrees of freedom {nees['mean_ratio']:.2f} (95 % of true covariances: {low:.2f} to {high:.2f})"
    )


def cm(values_m: Sequence[float | None]) -> str:
    """Metres as centimetres, a dash for what there is not."""
    return " / ".join("-" if value is None else f"{100 * value:.2f}" for value in values_m) + " cm"


def _mark_words(mark: dict[str, Any]) -> str:
    x, y = mark["residual_px"]
    return f"mark of {mark['point_id']} in {mark['image_id']} ({x:+.1f}, {y:+.1f} px, {mark['sigmas']:.0f} sigmas)"


def _component_lines(components: dict[str, Any]) -> Iterator[str]:
    yield f"{'variance components':<22}{'observations':>13}{'redundancy':>12}  estimated over stated sigma"
    for name, part in components.items():
        known = part["factor"] is not None
        factor = f"{part['factor']:.2f} +- {part['factor_sigma']:.2f}" if known else "too little checks it"
        yield f"{name:<22}{part['observations']:>13}{part['redundancy']:>12.1f}  {factor}"


def _control_lines(variant: dict[str, Any]) -> Iterator[str]:
    if not variant["control_points"]:
        return
    yield f"residuals of control, RMS   {cm(variant['control_rms_m'])}"
    yield "control        residual E/N/H cm        redundancy E/N/H    w E/N/H              detectable E/N/H cm"
    for row in variant["control_points"]:
        residual, bias = _numbers(row["residual_m"], 100.0, "+.1f"), _numbers(row["detectable_m"], 100.0, ".1f")
        redundancy, w = _numbers(row["redundancy"], 1.0, ".2f"), _numbers(row["w"], 1.0, "+.1f")
        yield f"{row['point_id']:<14} {residual:<24} {redundancy:<19} {w:<20} {bias}"


def _gnss_lines(variant: dict[str, Any]) -> Iterator[str]:
    gnss = variant["gnss"]
    if gnss is None:
        return
    low, middle, high = (cm(values) for values in gnss["detectable_m"])
    worst = f"largest w {gnss['largest_w']:.1f} at {gnss['largest_w_of']}"
    yield f"residuals of GNSS, RMS      {cm(gnss['residual_rms_m'])}; {worst}"
    yield f"detectable in GNSS E/N/H    smallest {low}, median {middle}, largest {high}"


def _distance_lines(variant: dict[str, Any]) -> Iterator[str]:
    for row in variant["distances"]:
        checked = (
            "nothing checks it" if row["w"] is None else f"w {row['w']:+.1f}, detectable {cm([row['detectable_m']])}"
        )
        yield (
            f"distance {row['a']} to {row['b']}: {row['distance_m']:.4f} m, residual {cm([row['residual_m']])}, "
            f"redundancy {row['redundancy']:.2f}, {checked}"
        )


def _partial_lines(variant: dict[str, Any]) -> Iterator[str]:
    for row in variant["partial_check_points"]:
        yield (
            f"check point {row['point_id']}, known in part: E/N/H {cm(row['difference_m'])}, "
            f"predicted 1-sigma {cm(row['predicted_sigma_m'])}"
        )


def _numbers(values: Sequence[float | None], factor: float, form: str) -> str:
    return " / ".join("-" if value is None else format(factor * value, form) for value in values)


def _unknown(unknown: dict[str, Any]) -> str:
    value, sigma, unit = unknown["value"], unknown["sigma"], unknown["unit"]
    if unit == "m":
        return f"{unknown['name']:<28} {100 * value:+9.2f} +- {100 * sigma:.2f} cm"
    return f"{unknown['name']:<28} {value:12.6g} +- {sigma:.2g} {unit}".rstrip()
