"""What the report says of an adjustment, as plain values: counts, gates, variance components, residuals."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from georef.crs import WorldFrame
from georef.estimation.adjustment.adjust_block import AdjustedBlock
from georef.estimation.adjustment.block import KINDS_OF_POINT, KINDS_OF_POSE, Block
from georef.estimation.adjustment.blunders.coherent import CoherentBlock
from georef.estimation.adjustment.blunders.gates import RejectedConstraint
from georef.estimation.adjustment.equations.constraint_terms import (
    DISTANCES,
    POSITION_PRIORS,
    RELATIVE_POSES,
    position_residuals,
)
from georef.estimation.adjustment.equations.eliminate import IMAGE_OBSERVATIONS
from georef.estimation.adjustment.quality.correlations import shared_unknowns, strong_correlations
from georef.estimation.adjustment.quality.reliability import NO_WEIGHT, Reliability, reliability
from georef.estimation.adjustment.quality.weak_focal import weak_focals
from georef.geometry.rigid import Array
from georef.stages.reliability_data import UNCHECKED, reliability_rows, reliability_summary

GROUPS = {
    IMAGE_OBSERVATIONS: "image_observations",
    "automatic": "automatic_gcps",
    "localized": "pose_priors",
    "orientation": "given_orientations",
    POSITION_PRIORS: "gnss",
    "control": "control_points",
    RELATIVE_POSES: "relative_poses",
    DISTANCES: "distances",
}
"""Names in reports of what a block calls its groups of observations."""
WITH_RELIABILITY = ("control", "automatic", "localized", POSITION_PRIORS)
_NAMED_REJECTED, _NAMED_CORRELATIONS = 50, 30
_FIRST = -1  # in place of a mounting: the first image of a station


def adjustment_data(given: Block, adjusted: AdjustedBlock, checked: Mapping[str, Reliability]) -> dict[str, Any]:
    """Counts, gates, variance components, reliability, correlations and residuals. checked: of `all_reliability`."""
    block, solution = adjusted.block, adjusted.solution
    in_gcps = len(points_of(block, "automatic"))
    return {
        "images": len(block.image_ids),
        "stations": len(block.station_ids),
        "automatic_gcps": in_gcps,
        "tie_points": len(scene_points(adjusted)) - in_gcps,
        "image_observations": len(block.observations),
        "gnss_positions": len(block.position_priors),
        "pose_priors": len(block.pose_priors),
        "gates": _gates(given, adjusted),
        "coherent_blocks": [_coherent(wrong) for wrong in adjusted.wrong],
        "undecidable": adjusted.undecidable,
        "variance_components": {
            GROUPS[name]: c.to_dict() for name, c in adjusted.quality.components.items() if name in GROUPS
        },
        "redundancy": _redundancy(adjusted),
        "reliability": {GROUPS[name]: reliability_summary(found) for name, found in checked.items() if len(found)},
        "rejected_constraints": rejected_data(adjusted.rejected),
        **_shared(adjusted),
        "image_sigma_scale": adjusted.sigma_scale,
        "iterations": solution.iterations,
        "converged": solution.converged,
        "calibrations": [asdict(camera) for camera in solution.state.cameras if camera.estimate],
        "images_used": _per_image(adjusted),
        "control": _control(given, adjusted, checked),
    }


def adjustment_line(data: dict[str, Any]) -> str:
    scale = data["variance_components"]["image_observations"]["factor"]
    gate = data["gates"]["image_observations"]
    return (
        f"{data['images']} images, {data['automatic_gcps']} automatic GCPs, {data['tie_points']} tie points, "
        f"{data['image_observations']} observations ({gate['rejected']} rejected), "
        f"sigma0 {'-' if scale is None else f'{scale:.2f}'}"
        + ("" if data["converged"] else ", NOT CONVERGED")
        + (", UNDECIDABLE which localized poses are wrong" if data["undecidable"] else "")
    )


def scene_points(adjusted: AdjustedBlock) -> NDArray[np.int64]:
    """Tie points and automatic GCPs that the adjustment determined."""
    determined = np.flatnonzero(np.isfinite(adjusted.quality.images.points).all(axis=(1, 2)))
    return np.setdiff1d(determined, points_of(adjusted.block, "control"))


def points_of(block: Block, kind: str) -> NDArray[np.int64]:
    priors = block.point_priors
    return priors.point[priors.kind == KINDS_OF_POINT.index(kind)]


def all_reliability(adjusted: AdjustedBlock, world: WorldFrame) -> dict[str, Reliability]:
    """Reliability of control, automatic GCPs, pose priors and GNSS positions along the axes of the CRS."""
    block, state = adjusted.block, adjusted.solution.state

    def axes(places: Array) -> Array:
        return world.crs_axes_from_world(world.crs_from_world(places)) if len(places) else np.zeros((0, 3, 3))

    tests = {test.name: test for test in adjusted.quality.constraints}
    return {name: reliability(block, state, tests[name], axes) for name in WITH_RELIABILITY if name in tests}


def _redundancy(adjusted: AdjustedBlock) -> dict[str, Any]:
    """Of all observations together: their number, unknowns, redundancy and sigma0 a posteriori."""
    groups = adjusted.quality.components.values()
    observations, redundancy = sum(g.observations for g in groups), sum(g.redundancy for g in groups)
    squares = sum(g.squares for g in groups)
    return {
        "observations": observations,
        "unknowns": round(observations - redundancy),
        "redundancy": redundancy,
        "sigma0": float(np.sqrt(squares / redundancy)) if redundancy >= 1.0 else None,
        "image_redundancy_number": _image_redundancy(adjusted),
    }


def _image_redundancy(adjusted: AdjustedBlock) -> dict[str, float] | None:
    """Redundancy numbers of the coordinates of image observations: mean of both, over all observations."""
    images = adjusted.quality.images
    numbers = 0.5 * images.redundancy[images.dof >= 0]
    if not len(numbers):
        return None
    return {"median": float(np.median(numbers)), "unchecked": float(np.mean(numbers < UNCHECKED))}


def _shared(adjusted: AdjustedBlock) -> dict[str, Any]:
    """Unknowns that stations share, what they trade off with, and what to be warned of."""
    block, state, found = adjusted.block, adjusted.solution.state, adjusted.quality.cofactors
    pairs = strong_correlations(block, state, found)
    weak = weak_focals(block, state, found.layout, found.border)
    return {
        "shared_unknowns": [asdict(unknown) for unknown in shared_unknowns(block, state, found)],
        "correlations": [asdict(pair) for pair in pairs[:_NAMED_CORRELATIONS]],
        "correlations_in_all": len(pairs),
        "weak_focals": [asdict(focal) | {"text": str(focal)} for focal in weak],
    }


def rejected_data(rejected: Sequence[RejectedConstraint]) -> list[dict[str, Any]]:
    """What failed its test, the most significant first, at most so many of each kind as one looks at."""
    listed: Counter[str] = Counter()
    out = []
    for one in sorted(rejected, key=lambda r: -r.statistic / max(r.dof, 1)):
        listed[one.kind] += 1
        if listed[one.kind] <= _NAMED_REJECTED:
            kind = GROUPS.get(one.kind, one.kind.replace(" ", "_"))
            out.append({"kind": kind, "name": one.name, "statistic": one.statistic, "dof": one.dof})
    return out


def _gates(given: Block, adjusted: AdjustedBlock) -> dict[str, Any]:
    """How many of each group were tested, and which were rejected; of automatic GCPs the number alone."""
    kinds = np.array(KINDS_OF_POINT)[given.point_priors.kind]
    tested = {
        IMAGE_OBSERVATIONS: len(given.observations),
        KINDS_OF_POSE[0]: len(given.pose_priors),
        POSITION_PRIORS: len(given.position_priors),
        **({RELATIVE_POSES: len(given.relative_poses)} if len(given.relative_poses) else {}),
        **({DISTANCES: len(given.distances)} if len(given.distances) else {}),
        **{kind: int((kinds == kind).sum()) for kind in KINDS_OF_POINT},
    }
    names = {kind: [r.name for r in adjusted.rejected if r.kind == kind] for kind in tested}
    rejected = {kind: len(found) for kind, found in names.items()} | {IMAGE_OBSERVATIONS: adjusted.dropped}
    names["automatic"] = []
    return {
        GROUPS[kind]: {"tested": count, "rejected": rejected[kind], "rejected_ids": names[kind]}
        for kind, count in tested.items()
    }


def _coherent(wrong: CoherentBlock) -> dict[str, Any]:
    """Neighbouring stations whose localized poses are off by one shift: given minus adjusted, world axes."""
    return {
        "stations": list(wrong.station_ids),
        "shift_m": wrong.shift_m.tolist(),
        "sigma_m": np.sqrt(np.diag(wrong.cov)).tolist(),
        "statistic": wrong.statistic,
    }


def _per_image(adjusted: AdjustedBlock) -> dict[str, Any]:
    """Number of observations, residual RMS in pixels and offset from GNSS of each image."""
    block, state = adjusted.block, adjusted.solution.state
    obs = block.observations
    square = np.square(block.views(state).project(obs.view, state.points[obs.point]) - obs.pixel).mean(axis=1)
    count = np.bincount(obs.view, minlength=len(block.image_ids))
    total = np.bincount(obs.view, weights=square, minlength=len(count))
    out: dict[str, Any] = {
        name: {"observations": int(n), "residual_rms_px": float(np.sqrt(t / n)) if n else None}
        for name, n, t in zip(block.image_ids, count, total, strict=True)
    }
    priors, residuals = block.position_priors, position_residuals(block, state)
    places = zip(block.station.tolist(), block.mounting.tolist(), strict=True)
    image_at = dict(zip(places, block.image_ids, strict=True))
    for image, station in zip(reversed(block.image_ids), reversed(block.station.tolist()), strict=True):
        image_at[station, _FIRST] = image
    for station, antenna, offset in zip(priors.station.tolist(), priors.antenna.tolist(), residuals, strict=True):
        image = image_at.get((station, antenna), image_at[station, _FIRST])  # of an antenna: the station's first
        out[image]["gnss_residual_m"] = offset.tolist()
    return out


def _control(given: Block, adjusted: AdjustedBlock, checked: Mapping[str, Reliability]) -> list[dict[str, Any]]:
    """Residuals of the control points that took part, in world axes: estimated minus given; their reliability along
    the axes of the CRS."""
    own = checked.get("control")
    numbers = {} if own is None else dict(zip(own.ids, reliability_rows(own), strict=True))
    priors = adjusted.block.point_priors
    marks = np.bincount(given.observations.point, minlength=len(given.points))
    return [
        {
            "point": priors.point_ids[row],
            "residual_m": (adjusted.solution.state.points[priors.point[row]] - priors.position[row]).tolist(),
            "sigma_m": [sigma if weighted else None for sigma, weighted in _sigmas(priors.information[row])],
            "images": int(marks[priors.point[row]]),
            **numbers.get(priors.point_ids[row], {}),
        }
        for row in np.flatnonzero(priors.kind == KINDS_OF_POINT.index("control"))
    ]


def _sigmas(information: Array) -> list[tuple[float, bool]]:
    """1-sigma along each axis of an information matrix (3, 3) of any rank, and whether there is one."""
    sigma = np.sqrt(np.diag(np.linalg.pinv(information, hermitian=True)))
    weighted = np.diag(information) > NO_WEIGHT * np.diag(information).max(initial=0.0)
    return [(float(s), bool(w)) for s, w in zip(sigma, weighted, strict=True)]
