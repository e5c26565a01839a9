"""report.json: what a surveyor asks of an adjustment, as plain values. Residuals are estimated minus reference."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.linalg import block_diag

from georef.evaluation.check_points import CheckPointError, CheckPointErrors, CheckPointReport
from georef.geometry.rigid import Array
from georef.report.plan import Placed, placed_in_plan, plan_section
from georef.types.constraints import CheckKind
from georef.types.results import Localized, Outcome, Rejected

SCHEMA = 1
_NO_CHECK = {"count": 0, "kind": None, "rmse_e_m": None, "rmse_n_m": None, "rmse_h_m": None, "rmse_3d_m": None}

_SHARED = ("shared_unknowns", "correlations", "correlations_in_all", "weak_focals")
_RELIABILITY = ("redundancy", "rejected_constraints", *_SHARED)
_ADJUSTMENT = ("iterations", "converged", "image_sigma_scale", "coherent_blocks", "undecidable")


@dataclass(frozen=True, eq=False)
class ReportInput:
    """All that the report is made of."""

    project: str
    epoch: str
    version: str
    fingerprint: str
    config: dict[str, Any]
    world: dict[str, Any]
    outcomes: tuple[Outcome, ...]
    adjustment: dict[str, Any]
    network: dict[str, Any]
    check_before: Mapping[CheckKind, CheckPointReport]  # with the poses straight after PnP
    check_after: Mapping[CheckKind, CheckPointReport]
    axes_from_world: Mapping[str, Array]  # by point id: (3, 3) world axes to CRS axes
    placed: Placed
    surveyed_control: bool
    control_ids: tuple[str, ...]
    timings: dict[str, Any]


def build_report(given: ReportInput) -> dict[str, Any]:
    """The report of one epoch as JSON values, free of NaN and infinity."""
    localized = [o for o in given.outcomes if isinstance(o, Localized)]
    after = _check_section(given.check_after, given)
    return {
        "schema": SCHEMA,
        "project": given.project,
        "epoch": given.epoch,
        "georef_version": given.version,
        "fingerprint": given.fingerprint,
        "crs": given.world,
        "images": {
            "total": len(given.outcomes),
            "localized": len(localized),
            "rejected": len(given.outcomes) - len(localized),
            "by_image": _images(given),
        },
        "reference": given.network,
        "constraints": {
            "kind": given.config["adjust"]["constraints"],
            "automatic_gcps": given.adjustment.get("automatic_gcps", 0),
            "tie_points": given.adjustment.get("tie_points", 0),
            "image_observations": given.adjustment.get("image_observations", 0),
            "gnss_positions": given.adjustment.get("gnss_positions", 0),
            "pose_priors": given.adjustment.get("pose_priors", 0),
            "surveyed_control_used": given.surveyed_control,
        },
        "check_points": after,
        "check_points_after_pnp": _check_section(given.check_before, given),
        "control_points": _control_section(given),
        "gates": given.adjustment.get("gates", {}),
        "variance_components": given.adjustment.get("variance_components", {}),
        "adjustment": {key: given.adjustment.get(key) for key in _ADJUSTMENT},
        "reliability": {key: given.adjustment[key] for key in _RELIABILITY if key in given.adjustment}
        | {"groups": _reliability_groups(given)},
        "datum": given.adjustment.get("datum", {}),
        "plan": _plan(given),
        "timings": given.timings,
        "config": given.config,
    }


def _images(given: ReportInput) -> list[dict[str, Any]]:
    turns = given.placed.axes_at({o.image_id: o.world_from_cam for o in given.outcomes if isinstance(o, Localized)})
    return [
        _localized(o, turns[o.image_id], given) if isinstance(o, Localized) else _rejected(o) for o in given.outcomes
    ]


def _rejected(outcome: Rejected) -> dict[str, Any]:
    return {
        "image": outcome.image_id,
        "status": "rejected",
        "reason": outcome.reason.value,
        "detail": outcome.detail,
        "notes": list(outcome.notes),
    }


def _localized(outcome: Localized, turn: Array, given: ReportInput) -> dict[str, Any]:
    """Sigmas and residuals are along the axes of the CRS, to which `turn` leads."""
    return {
        "image": outcome.image_id,
        "status": "localized",
        "correspondences": outcome.correspondence_count,
        "references": len(outcome.matches),
        "sigma0": outcome.sigma0,
        "pnp_sigma_m": _sigma(outcome.world_from_cam_cov[3:, 3:], turn @ outcome.world_from_cam.rotation),
        "gnss_rejected": outcome.gnss_rejected,
        "gnss_offset_m": outcome.gnss_offset_m,
        "notes": list(outcome.notes),
        "cpu_s": outcome.cpu_s,
        "adjustment": _adjusted(outcome.image_id, turn, given),
    }


def _adjusted(name: str, turn: Array, given: ReportInput) -> dict[str, Any] | None:
    used = given.adjustment.get("images_used", {}).get(name)
    if used is None:
        return None
    out = {**used, "sigma_m": _sigma(given.placed.position_covs[name], turn)}
    if "gnss_residual_m" in used:
        out["gnss_residual_m"] = (turn @ used["gnss_residual_m"]).tolist()
        out["gnss_sigma_m"] = _sigma(given.placed.gnss_covs[name], turn)
    return out


def _sigma(cov: Array, turn: Array) -> list[float]:
    """1-sigma (3,) of a covariance, along the axes that `turn` leads to."""
    return np.sqrt(np.diag(turn @ cov @ turn.T)).tolist()


def _plan(given: ReportInput) -> dict[str, Any]:
    check = {e.point_id: e.difference_m for report in given.check_after.values() for e in report.errors.determined}
    control = {c["point"]: np.array(c["residual_m"]) for c in given.adjustment.get("control", [])}
    return plan_section(given.placed, check, control)


def _reliability_groups(given: ReportInput) -> dict[str, Any]:
    """Summaries of the groups; the places of their members in the frame of the plan."""
    out = {}
    for name, group in given.adjustment.get("reliability", {}).items():
        members = group["in_plan"]
        places = placed_in_plan(given.placed, [member["place_m"] for member in members])
        moved = [{**member, "position_m": place} for member, place in zip(members, places, strict=True)]
        out[name] = {**group, "in_plan": [{k: v for k, v in m.items() if k != "place_m"} for m in moved]}
    return out


def _check_section(reports: Mapping[CheckKind, CheckPointReport], given: ReportInput) -> dict[str, Any]:
    """Each kind apart; the first levels repeat the absolute kind if there is one, else the relative."""
    if not reports:
        return {**_NO_CHECK, "by_kind": {}, "points": [], "not_determined": []}
    by_kind, points, not_determined = {}, [], []
    for kind, report in reports.items():
        errors = _in_crs_axes(report.errors, given.axes_from_world)
        estimated = (report.summaries_estimated or {}).get(kind)
        by_kind[kind.value] = {
            **errors.summarize()[kind].to_dict(),
            "mark_sigma": report.component.to_dict(),
            "nees_with_estimated_mark_sigma": None if estimated is None else estimated.nees.to_dict(),
        }
        points += [error.to_dict() for error in errors.determined]
        not_determined += [entry.to_dict() for entry in errors.not_determined]
    main = next(kind for kind in (CheckKind.ABSOLUTE, CheckKind.RELATIVE) if kind in reports)
    return {
        **by_kind[main.value],
        "by_kind": by_kind,
        "points": points,
        "not_determined": not_determined,
        "residual": "estimated minus reference, along the axes of the CRS",
    }


def _in_crs_axes(errors: CheckPointErrors, axes: Mapping[str, Array]) -> CheckPointErrors:
    determined = tuple(_turned(error, axes[error.point_id]) for error in errors.determined)
    joint = errors.joint_cov
    if joint is not None and determined:
        turns = np.asarray(block_diag(*(axes[error.point_id] for error in determined)), dtype=np.float64)
        joint = turns @ joint @ turns.T
    return replace(errors, determined=determined, joint_cov=joint)


def _turned(error: CheckPointError, turn: Array) -> CheckPointError:
    cov = None if error.predicted_cov is None else turn @ error.predicted_cov @ turn.T
    return replace(error, difference_m=turn @ error.difference_m, predicted_cov=cov)


def _control_section(given: ReportInput) -> dict[str, Any]:
    """Control apart from check: residuals of the points that took part, in CRS axes."""
    points = []
    for entry in given.adjustment.get("control", []):
        turned = (given.axes_from_world[entry["point"]] @ entry["residual_m"]).tolist()
        known = [
            r if sigma is not None else None for r, sigma in zip(turned, entry.get("sigma_m", turned), strict=True)
        ]
        points.append({**entry, "residual_m": known})
    residuals = np.array([p["residual_m"] for p in points], dtype=np.float64).reshape(-1, 3)
    section: dict[str, Any] = {
        "used": given.surveyed_control,
        "available": len(given.control_ids),
        "count": len(points),
        "points": points,
    }
    if len(points):
        count = np.maximum(np.isfinite(residuals).sum(axis=0), 1)
        square = np.nansum(np.square(residuals), axis=0) / count
        e, n, h = np.sqrt(square).tolist()
        section |= {"rmse_e_m": e, "rmse_n_m": n, "rmse_h_m": h, "rmse_3d_m": float(np.sqrt(square.sum()))}
    return section
