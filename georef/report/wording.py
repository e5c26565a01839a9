"""What the numbers of a report mean, in words: kinds of check points, verdicts, and what asks for attention."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

MEANING = {
    "absolute": "Surveyed independently of the reference. These figures state the accuracy in the CRS, as far as the "
    "check points themselves are accurate.",
    "relative": "Derived from the reference, not surveyed independently. These figures state how well the new images "
    "fit the reference (co-registration). A shift, turn or scale of the whole reference does not show in them: they "
    "are no statement of absolute accuracy.",
}
BRIEF = {
    "absolute": "Surveyed independently of the reference: accuracy in the CRS.",
    "relative": "Derived from the reference: fit to the reference (co-registration), not absolute accuracy.",
}
GROUPS = {
    "image_observations": "Image observations",
    "automatic_gcps": "Automatic ground control (reference points)",
    "gnss": "GNSS positions",
    "pose_priors": "Poses from localization",
    "control_points": "Surveyed control points",
    "given_orientations": "Given orientations",
    "relative_poses": "Measured motions",
    "distances": "Measured distances",
    "reference_position": "Reference positions",
    "reference_rotation": "Reference rotations",
}
REASONS = {
    "unreadable": "the file cannot be read",
    "wrong_size": "its size is not that of its camera",
    "no_prior": "no position is known, and a search of the whole reference was not allowed",
    "few_features": "too few features",
    "no_candidates": "no reference image sees the same place",
    "few_matches": "too few matches with the reference",
    "few_inliers": "too few matches agree on one pose",
    "degenerate": "the geometry does not fix the pose",
    "prior_contradicts": "the images and the position prior contradict each other",
    "internal": "an unexpected error in the computation",
}
_FEW_POINTS = 10


@dataclass(frozen=True)
class Verdict:
    """A judgement with the level that the page marks it by: ok, warn, none."""

    level: str
    title: str
    text: str


def nees_verdict(nees: dict[str, Any]) -> Verdict:
    """Whether the predicted sigmas are as large as the residuals show."""
    ratio, interval = nees.get("mean_ratio"), nees.get("interval_95")
    if ratio is None or interval is None:
        return Verdict("none", "Predicted sigmas not testable", "No check point has a predicted covariance.")
    expected = f"{interval[0]:.2f} to {interval[1]:.2f} (95\N{NO-BREAK SPACE}%)"
    measured = f"Mean NEES/3 is {ratio:.2f}; {expected} was to be expected."
    times = ratio**0.5
    if nees["consistent"]:
        return Verdict("ok", "Predicted sigmas agree with the residuals", measured)
    if ratio > interval[1]:
        text = f"{measured} Residuals are {times:.1f} times what the sigmas predict: they promise too much."
        return Verdict("warn", "Predicted sigmas are too small", text)
    text = f"{measured} Residuals are {times:.2f} times what the sigmas predict: they are on the safe side."
    return Verdict("warn", "Predicted sigmas are too large", text)


def component_reading(component: dict[str, Any]) -> str:
    """A variance factor in words."""
    factor, sigma = component.get("factor"), component.get("factor_sigma")
    if factor is None:
        return "redundancy too small to tell"
    if abs(factor - 1.0) <= max(2.0 * (sigma or 0.0), 0.02):
        return "as stated"
    if factor > 1:
        return f"residuals {100 * (factor - 1):.0f} % larger than stated"
    return f"residuals {100 * (1 - factor):.0f} % smaller than stated"


def attention(report: dict[str, Any]) -> list[str]:
    """What a reader must know before using the numbers, most important first."""
    own = [*_of_adjustment(report), *_of_datum(report), *_of_images(report), *_of_reliability(report)]
    return [*own, *_of_points(report), *_of_reference(report)]


def _of_datum(report: dict[str, Any]) -> list[str]:
    """What the comparison of map, GNSS and control found beforehand and the user accepted, or what is but suspected."""
    return [
        f"{found['text']} {'Accepted (adjust.accept_datum).' if found['accepted'] else found['remedy']}"
        for pair in report.get("datum", {}).get("comparisons", ())
        for found in pair["findings"]
    ]


def _of_reliability(report: dict[str, Any]) -> list[str]:
    """Unknowns that the observations hardly tell apart, and control that nothing checks."""
    section = report.get("reliability", {})
    out = [focal["text"].replace("\n", " ") for focal in section.get("weak_focals", ())]
    pairs = section.get("correlations", ())
    if pairs:
        first = "; ".join(f"{p['first']} with {p['second']} ({p['value']:+.3f})" for p in pairs[:3])
        more = section["correlations_in_all"] - 3
        out.append(f"Hardly to be told apart (correlation): {first}{f'; {more} more' if more > 0 else ''}.")
    control = section.get("groups", {}).get("control_points")
    if control and control["unchecked"]:
        out.append(f"{_count(control['unchecked'], 'control point')} that nothing checks: an error in it stays unseen.")
    return out


def _of_adjustment(report: dict[str, Any]) -> list[str]:
    if report["images"]["localized"] == 0:
        return ["No image was localized: there are no results."]
    if report["adjustment"].get("converged") is False:
        return [f"The adjustment did not converge in {report['adjustment']['iterations']} iterations: do not use it."]
    return []


def _of_images(report: dict[str, Any]) -> list[str]:
    out, images = [], report["images"]["by_image"]
    rejected = [i["image"] for i in images if i["status"] == "rejected"]
    if rejected:
        out.append(f"{_count(len(rejected), 'image')} rejected, without a pose: {_names(rejected)}.")
    unused = [i["image"] for i in images if i["status"] == "localized" and i["adjustment"] is None]
    if unused and len(unused) < len(images):
        out.append(f"Localized but not in the adjustment: {_names(unused)}.")
    offset = [i["image"] for i in images if i.get("gnss_rejected")]
    if offset:
        out.append(f"GNSS position set aside at localization, in contradiction to the images: {_names(offset)}.")
    for group in ("gnss", "pose_priors", "control_points"):
        gate = report["gates"].get(group, {})
        if gate.get("rejected"):
            out.append(f"{GROUPS[group]} rejected by the gate of the adjustment: {_names(gate['rejected_ids'])}.")
    return [*out, *_coherent(report["adjustment"])]


def _coherent(adjustment: dict[str, Any]) -> list[str]:
    """Stretches of localized poses that are off by one shift."""
    out = []
    for wrong in adjustment.get("coherent_blocks") or ():
        shift, sigma = (" / ".join(f"{1e3 * v:.0f}" for v in wrong[key]) for key in ("shift_m", "sigma_m"))
        where = _names(wrong["stations"])
        out.append(
            f"Localized poses off by one shift, set aside: {where}, by {shift} mm east/north/up (1-sigma {sigma})."
        )
    if adjustment.get("undecidable"):
        out.append("Which of these stretches is wrong and which is right, nothing but their number tells: add control.")
    return out


def _of_points(report: dict[str, Any]) -> list[str]:
    check = report["check_points"]
    if not check["by_kind"]:
        return ["There are no check points: the accuracy is not verified."]
    out = []
    if "absolute" not in check["by_kind"]:
        out.append("All check points are relative: nothing in this report verifies the absolute accuracy.")
    for kind, summary in check["by_kind"].items():
        if 0 < summary["count"] < _FEW_POINTS:
            out.append(f"Only {_count(summary['count'], f'{kind} check point')}: the 95 % intervals are wide.")
        if summary["nees"].get("consistent") is False and summary["nees"]["mean_ratio"] > 1:
            out.append(f"{nees_verdict(summary['nees']).title} for the {kind} check points.")
    if check["not_determined"]:
        missing = [entry["point_id"] for entry in check["not_determined"]]
        out.append(f"{_count(len(missing), 'check point')} could not be determined: {_names(missing)}.")
    return out


def _of_reference(report: dict[str, Any]) -> list[str]:
    suspects = report["reference"].get("suspects") or []
    if not suspects:
        return []
    return [f"Reference images set aside, their exterior orientation contradicts the others: {_names(suspects)}."]


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def _names(names: list[str], most: int = 8) -> str:
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more
