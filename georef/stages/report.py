"""Stage `report`: poses in the project's CRS, report.json with its HTML, and the recording."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.linalg import block_diag

from georef import __version__
from georef.evaluation.check_points import CheckPointReport, evaluate_check_points
from georef.evaluation.forward_intersection import PosedImages
from georef.geometry.camera import Camera
from georef.geometry.rigid import Array, Rigid3
from georef.io.files import copy_atomically, write_text_atomically
from georef.io.pose_records import PoseRecord, PosesFrame
from georef.io.poses import write_poses
from georef.report.build import ReportInput, build_report
from georef.report.html import render_html
from georef.report.plan import Placed
from georef.report.text import render_text
from georef.stages.adjusted_epoch import AdjustedEpoch, read_adjusted
from georef.stages.base import StageContext, StageSummary
from georef.stages.network import RESULT as NETWORK_RESULT
from georef.stages.stations import final_outcomes
from georef.stages.survey import Survey
from georef.types.constraints import CheckKind
from georef.types.results import Localized, Outcome, Rejected, with_estimated_cameras
from georef.viewer.scene import Scene

POSES, LOCALIZATION, REPORT, HTML, RECORDING, TEXT = (
    "poses.csv",
    "localization.csv",
    "report.json",
    "report.html",
    "recording.rrd",
    "adjustment.txt",
)
TABLES = "adjustment_*.csv"


def run(context: StageContext) -> StageSummary:
    """Publishes the epoch: poses before and after the adjustment, the report, the recording."""
    folder = context.project.published(context.epoch)
    outcomes = list(final_outcomes(context))
    survey = replace(context.survey, epoch=with_estimated_cameras(context.survey.epoch, outcomes))
    context = replace(context, survey=survey)
    adjusted = read_adjusted(context.before["adjust"])
    frame = poses_frame(survey)
    write_poses(_localized_records(outcomes, survey), folder / LOCALIZATION, frame)
    write_poses(_adjusted_records(outcomes, adjusted, survey), folder / POSES, frame)
    report = build_report(_report_input(context, outcomes, adjusted))
    write_text_atomically(json.dumps(report, indent=1, allow_nan=False), folder / REPORT)
    write_text_atomically(render_html(report), folder / HTML)
    write_text_atomically(render_text(report), folder / TEXT)
    _copy_tables(Path(context.before["adjust"]), folder)
    if context.config.report.recording:
        from georef.viewer.recording import write_recording

        write_recording(_scene(context, outcomes, adjusted, report), context.config.report, folder / RECORDING)
    return StageSummary(_line(report), _headline(report), 1, 1)


def _copy_tables(adjusted: Path, folder: Path) -> None:
    """The tables of the adjustment; those of an earlier one go."""
    for old in folder.glob(TABLES):
        old.unlink()
    for table in adjusted.glob(TABLES):
        copy_atomically(table, folder / table.name)


def outputs_exist(context: StageContext) -> bool:
    """Whether all that is published is there, and of this very run (others may have been published since)."""
    folder = context.project.published(context.epoch)
    names = (POSES, LOCALIZATION, HTML, TEXT, *((RECORDING,) if context.config.report.recording else ()))
    if not all((folder / name).is_file() for name in names):
        return False
    path = folder / REPORT
    try:
        stored = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    return stored.get("fingerprint") == context.folder.name


def poses_frame(survey: Survey) -> PosesFrame:
    world = survey.world.describe()
    origin = ", ".join(f"{value:.3f}" for value in survey.world.origin_in_crs)
    definition = survey.world.definition
    return PosesFrame(world["kind"], definition.horizontal, definition.height, f"{origin} of this CRS")


def _records(
    ids: Sequence[str], poses: Sequence[Rigid3], covs: Sequence[Array], survey: Survey
) -> dict[str, PoseRecord]:
    """Poses in the world as records in the CRS."""
    if not ids:
        return {}
    positions = survey.world.crs_from_world(np.array([pose.translation for pose in poses]))
    turns = survey.world.crs_axes_from_world(positions)
    return {
        name: PoseRecord(
            image_id=name,
            status="localized",
            position_in_crs=position,
            axes_from_cam=turn @ pose.rotation,
            cov=cov,
        )
        for name, pose, cov, position, turn in zip(ids, poses, covs, positions, turns, strict=True)
    }


def _localized_records(outcomes: Sequence[Outcome], survey: Survey) -> list[PoseRecord]:
    localized = [o for o in outcomes if isinstance(o, Localized)]
    records = _records(
        [o.image_id for o in localized],
        [o.world_from_cam for o in localized],
        [o.world_from_cam_cov for o in localized],
        survey,
    )
    records = {o.image_id: replace(records[o.image_id], intrinsics=o.intrinsic_sigmas) for o in localized}
    return [records.get(o.image_id) or _rejected(o) for o in outcomes]


def _adjusted_records(outcomes: Sequence[Outcome], adjusted: AdjustedEpoch, survey: Survey) -> list[PoseRecord]:
    covs = [adjusted.cov(i) for i in range(len(adjusted.image_ids))]
    records = _records(adjusted.image_ids, adjusted.world_from_cams, covs, survey)
    return [records.get(o.image_id) or _rejected(o) for o in outcomes]


def _rejected(outcome: Outcome) -> PoseRecord:
    assert isinstance(outcome, Rejected)
    return PoseRecord(outcome.image_id, f"rejected: {outcome.reason.value}")


def _report_input(context: StageContext, outcomes: Sequence[Outcome], adjusted: AdjustedEpoch) -> ReportInput:
    survey = context.survey
    network = json.loads((context.before["network"] / NETWORK_RESULT).read_text(encoding="utf-8"))
    return ReportInput(
        project=context.project.file.name,
        epoch=context.epoch,
        version=__version__,
        fingerprint=context.folder.name,
        config=context.config.model_dump(),
        world=survey.world.describe(),
        outcomes=tuple(outcomes),
        adjustment=adjusted.data,
        network=network,
        check_before=_by_kind(survey, lambda kind: _posed_after_pnp(outcomes, survey, kind)),
        check_after=_by_kind(survey, lambda kind: _posed_adjusted(adjusted, survey, kind)),
        axes_from_world=_axes_at_points(survey),
        placed=_placed(adjusted, survey),
        surveyed_control=context.config.adjust.surveyed_control,
        control_ids=tuple(point.point_id for point in survey.control),
        timings=_timings(context),
    )


def _by_kind(survey: Survey, posed: Callable[[CheckKind], PosedImages]) -> dict[CheckKind, CheckPointReport]:
    """Absolute points against poses with the errors of the reference, relative ones against the reference as it is."""
    kinds = [kind for kind in CheckKind if any(point.kind is kind for point in survey.check)]
    return {kind: evaluate_check_points([p for p in survey.check if p.kind is kind], posed(kind)) for kind in kinds}


def _posed_after_pnp(outcomes: Sequence[Outcome], survey: Survey, kind: CheckKind) -> PosedImages:
    """Single-image poses; what they share through the reference is not known: their errors count as independent."""
    localized = [o for o in outcomes if isinstance(o, Localized)]
    absolute = kind is CheckKind.ABSOLUTE
    covs = [o.world_from_cam_cov if absolute else o.relative_cov for o in localized]
    ids = tuple(o.image_id for o in localized)
    cameras = tuple(survey.epoch[name].camera for name in ids)
    poses = tuple(o.world_from_cam for o in localized)
    return PosedImages(
        ids, cameras, poses, lambda indices: np.asarray(block_diag(*(covs[i] for i in indices)), dtype=np.float64)
    )


def _posed_adjusted(adjusted: AdjustedEpoch, survey: Survey, kind: CheckKind) -> PosedImages:
    estimated = {c["camera_id"]: _camera(c) for c in adjusted.data.get("calibrations", ())}
    own = (survey.epoch[name].camera for name in adjusted.image_ids)
    cameras = tuple(estimated.get(camera.camera_id, camera) for camera in own)
    joint = adjusted.joint if kind is CheckKind.ABSOLUTE else adjusted.relative_joint
    return PosedImages(adjusted.image_ids, cameras, adjusted.world_from_cams, joint)


def _camera(data: dict[str, Any]) -> Camera:
    """A camera as the adjustment estimated and stored it."""
    return Camera(**{**data, "distortion": tuple(data["distortion"]), "estimate": tuple(data["estimate"])})


def _axes_at_points(survey: Survey) -> dict[str, Array]:
    """The turn from world axes to those of the CRS at each check and control point."""
    points = [*survey.check, *survey.control]
    if not points:
        return {}
    positions = survey.world.crs_from_world(np.array([p.point_in_world for p in points]))
    turns = survey.world.crs_axes_from_world(positions)
    return {point.point_id: turn for point, turn in zip(points, turns, strict=True)}


def _placed(adjusted: AdjustedEpoch, survey: Survey) -> Placed:
    poses = list(zip(adjusted.image_ids, adjusted.world_from_cams, strict=True))
    turned = {name: p.rotation @ adjusted.cov(i)[3:, 3:] @ p.rotation.T for i, (name, p) in enumerate(poses)}
    return Placed(
        world=survey.world,
        new=dict(poses),
        position_covs=turned,
        gnss_covs={i.image_id: i.gnss.cov for i in survey.epoch.images if i.gnss is not None}
        | {name: fix.cov for name, fix in survey.epoch.fixes.items()},
        reference={i.image_id: i.world_from_cam for i in survey.reference.images if i.world_from_cam is not None},
        check=survey.check,
        control=survey.control,
    )


def _scene(
    context: StageContext, outcomes: Sequence[Outcome], adjusted: AdjustedEpoch, report: dict[str, Any]
) -> Scene:
    survey, placed = context.survey, _placed(adjusted, context.survey)
    turns = _axes_at_points(survey)  # the report's residuals are along the axes of the CRS
    points = [*report["plan"]["check"], *report["plan"]["control"]]
    residuals = {p["point_id"]: np.array(p["residual_m"]) for p in points if p["residual_m"] is not None}
    if report["plan"]["frame"] == "crs":
        residuals = {name: turns[name].T @ residual for name, residual in residuals.items()}
    return Scene(
        title=f"{report['project']}, {context.epoch}",
        run=f"{report['project']}-{context.epoch}-{context.folder.name}",
        reference=[(i, i.world_from_cam) for i in survey.reference.images if i.world_from_cam is not None],
        new=survey.epoch.images,
        adjusted=placed.new,
        localized={o.image_id: o.world_from_cam for o in outcomes if isinstance(o, Localized)},
        rejected=[o for o in outcomes if isinstance(o, Rejected)],
        position_covs=placed.position_covs,
        points=adjusted.points,
        colors_rgb=adjusted.colors_rgb,
        check=survey.check,
        control=survey.control,
        residuals=residuals,
        report=report,
    )


def _timings(context: StageContext) -> dict[str, Any]:
    """What each stage before this one cost when it was computed."""
    out = {}
    for name, folder in context.before.items():
        path = Path(folder) / "stage.json"
        if path.is_file():
            record = json.loads(path.read_text(encoding="utf-8"))
            out[name] = {
                **record["timing"],
                "computed": record["computed"],
                "total": record["total"],
                "finished": record["finished"],
            }
    return out


def _headline(report: dict[str, Any]) -> dict[str, Any]:
    undecidable = bool(report["adjustment"]["undecidable"])
    return {"images": report["images"], "check_points": report["check_points"], "undecidable": undecidable}


def _line(report: dict[str, Any]) -> str:
    check = report["check_points"]
    if not check["count"]:
        return "no check points"
    return (
        f"{check['count']} {check['kind']} check points: RMSE E {1e3 * check['rmse_e_m']:.1f}, "
        f"N {1e3 * check['rmse_n_m']:.1f}, H {1e3 * check['rmse_h_m']:.1f}, 3D {1e3 * check['rmse_3d_m']:.1f} mm"
    )
